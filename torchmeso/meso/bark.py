"""Bark: plates parted by fissures, a height field.

Plates are the cells of a Voronoi diagram on the torus (one feature point in each cell of a regular grid), fissures lie
where the distance to its edges is small, and grain is value noise drawn out along v.

Test: tests/meso/test_bark.py
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchmeso.data.address import texel_centres
from torchmeso.data.height_field import HeightField
from torchmeso.errors import check_range
from torchmeso.meso import mesostructure
from torchmeso.meso.mesostructure import Mesostructure, Rgb


def bark(
    *,
    columns: int = 5,
    rows: int = 2,
    h: float = 0.14,
    fissure: float = 0.22,
    warp: float = 0.35,
    grain: float = 0.3,
    albedo: Rgb = (0.32, 0.22, 0.14),
    fissure_albedo: Rgb = (0.09, 0.055, 0.035),
    roughness: float = 0.8,
    f0: float = 0.0,
    texels: int = 128,
    seed: int = 0,
) -> Mesostructure:
    """Return bark that grows along v: a height field whose fissures reach -h and whose highest plate reaches 0.

    Args:
        columns: plates per tile along u.
        rows: plates per tile along v; fewer than columns for long plates.
        h: depth of the fissures.
        fissure: width of the slope from an edge up to a plate, in distances of plates.
        warp: how far edges wander from straight lines, in distances of plates.
        grain: depth of the grain and of the steps between plates as a share of `h`.
        albedo: linear RGB of the plates.
        fissure_albedo: linear RGB of the fissures.
        roughness: GGX width.
        f0: reflectance of the coat.
        texels: samples of the height field along each side.
        seed: chooses plates, warp and grain.

    Raises:
        ConfigError: a value is out of range.
    """
    check_range("bark.columns", columns, 1, 64)
    check_range("bark.rows", rows, 1, 64)
    check_range("bark.fissure", fissure, 1e-3, 1)
    check_range("bark.warp", warp, 0, 1)
    check_range("bark.grain", grain, 0, 0.9)
    check_range("bark.texels", texels, 4, 4096)
    rng = torch.Generator().manual_seed(seed)
    point = torch.rand(rows, columns, 2, generator=rng)
    level = torch.rand(rows, columns, generator=rng)
    place = texel_centres(texels, texels).reshape(-1, 2)
    shift = [_noise(place, 2 * columns, 2 * rows, rng) - 0.5 for _ in range(2)]
    lattice = place * torch.tensor([columns, rows]) + warp * torch.stack(shift, -1)
    edge, plate = _voronoi(lattice, point)
    t = (edge / fissure).clamp(max=1)
    rise = t.square() * (3 - 2 * t)
    rough = 0.6 * _noise(place, 8 * columns, 4 * rows, rng) + 0.4 * _noise(place, 20 * columns, 8 * rows, rng)
    height = rise * (1 - grain * (0.5 * level.flatten()[plate] + 0.5 * rough))
    height = height / height.max()
    colour = torch.lerp(torch.tensor(fissure_albedo), torch.tensor(albedo), rise[:, None])
    field = HeightField(
        height=((height - 1) * h).reshape(texels, texels),
        albedo=(colour * (1 - 0.5 * grain * rough)[:, None]).reshape(texels, texels, 3),
        h=h,
    )
    return mesostructure.from_height_field(field, albedo=(1.0, 1.0, 1.0), roughness=roughness, f0=f0)


def _voronoi(
    place: Float[Tensor, "n 2"], point: Float[Tensor, "rows columns 2"]
) -> tuple[Float[Tensor, "n"], Int[Tensor, "n"]]:
    """Return the distance to the nearest edge of the Voronoi diagram, and whose cell it is.

    Places are in lattice units; the feature point of cell (i, j) lies at (j, i) + point[i, j], and repeats.
    """
    rows, columns, _ = point.shape
    near = torch.cartesian_prod(torch.arange(-2, 3), torch.arange(-2, 3))
    cell = place.floor().long()[:, None] + near
    owner = cell[..., 1] % rows * columns + cell[..., 0] % columns
    site = cell + point.reshape(-1, 2)[owner] - place[:, None]
    d2 = site.square().sum(-1)
    nearest = d2.argmin(1, keepdim=True)
    own = site.gather(1, nearest[..., None].expand(-1, 1, 2))
    apart = (site - own).norm(dim=-1)
    to_edge = (d2 - d2.gather(1, nearest)) / (2 * apart.clamp(min=1e-9))
    to_edge.scatter_(1, nearest, torch.inf)
    return to_edge.amin(1), owner.gather(1, nearest)[:, 0]


def _noise(place: Float[Tensor, "n 2"], columns: int, rows: int, rng: torch.Generator) -> Float[Tensor, "n"]:
    """Return smooth noise in [0, 1] that repeats with the tile: random values on a grid, blended in between."""
    value = torch.rand(rows * columns, generator=rng)
    x = place * torch.tensor([columns, rows])
    cell = x.floor().long()
    f = x - cell
    f = f.square() * (3 - 2 * f)

    def corner(i: int, j: int) -> Tensor:
        return value[(cell[:, 1] + i) % rows * columns + (cell[:, 0] + j) % columns]

    low = torch.lerp(corner(0, 0), corner(0, 1), f[:, 0])
    return torch.lerp(low, torch.lerp(corner(1, 0), corner(1, 1), f[:, 0]), f[:, 1])
