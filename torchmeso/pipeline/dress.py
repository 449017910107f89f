"""The job `torchmeso tile TILES MESH`: tiles and a mesh in, a surface out that any set of their kind dresses.

Test: tests/pipeline/test_dress.py
"""

import math
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.data import image, tile_set, tiled_surface
from torchmeso.data.tile_set import TileSet
from torchmeso.data.tiled_surface import TiledSurface
from torchmeso.errors import ConfigError
from torchmeso.geometry import quads
from torchmeso.geometry.rays import RayScene
from torchmeso.pipeline.bake import Report, silent
from torchmeso.synthesize import parameterize, quad_tiling
from torchmeso.synthesize.parameterize import SurfaceOptions

SHOWN = 400
"""Pixels along a side of debug pictures."""


def run(
    tiles: str | Path,
    mesh: str | Path,
    options: SurfaceOptions,
    out: str | Path,
    *,
    pictures: str | Path | None = None,
    report: Report = silent,
) -> TiledSurface:
    """Lay the tiles in a file (.tiles) on a mesh, and write the surface (.surface).

    Args:
        tiles: .tiles, of the kind that the surface is for.
        mesh: OBJ, glTF, PLY, OFF, ...
        options: how.
        out: .surface.
        pictures: folder for a picture of the quads, the way they are turned, and where frames jump.
        report: progress.

    Raises:
        MesoError: a file is missing or unreadable, or the mesh has no quads of the kind that is asked for.
    """
    if Path(out).suffix.lower() != ".surface":
        raise ConfigError(f"{out}: expected a name that ends in .surface")
    found = surface(mesh, tile_set.load(tiles), options, report)
    about = {"made from": Path(mesh).name, "quads by": parameterize.way(mesh, options), "seed": options.seed}
    tiled_surface.save(found, out, **about)
    if pictures is not None:
        image.write_png(Path(pictures) / "surface.png", draw(found))
    return found


def draw(surface: TiledSurface) -> Float[Tensor, "H W 3"]:
    """Return a picture of a surface from in front and from behind: red to the east and green to the north in each tile.

    White where frames turn across an edge.
    """
    n = SHOWN
    jumped = torch.zeros(len(surface.quads), quads.SIDES, dtype=torch.bool)
    jumped[surface.jumps[:, 0], surface.jumps[:, 1]] = True
    shade = 0.25 + 0.5 * torch.rand(len(surface.quads), generator=torch.Generator().manual_seed(0))
    scene = RayScene(surface.vertices.float(), surface.faces)
    low, high = surface.vertices.float().aminmax(dim=0)
    middle, size = (low + high) / 2, float((high - low).max())
    panels = []
    for azimuth in (0.5, 0.5 + math.pi):
        back = torch.tensor([math.sin(azimuth) * 0.95, 0.3, math.cos(azimuth) * 0.95])
        right = torch.nn.functional.normalize(torch.linalg.cross(torch.tensor([0.0, 1, 0]), back), dim=0)
        up = torch.linalg.cross(back, right)
        x, y = torch.meshgrid(torch.arange(n) / n - 0.5, 0.5 - torch.arange(n) / n, indexing="xy")
        start = middle + 1.3 * size * (x[..., None] * right + y[..., None] * up) + 2 * size * back
        hits = scene.first_hit(start.reshape(-1, 3), (-back).expand(n * n, 3).contiguous())
        face = hits.face.clamp(min=0)
        place = (hits.barycentric[..., None] * surface.place[face].float()).sum(1)
        cell = surface.cell[face]
        east, north = place.unbind(-1)
        near = torch.stack([north, 1 - east, 1 - north, east], -1) < 0.08
        rgb = torch.stack([0.2 + 0.6 * east, 0.2 + 0.6 * north, shade[cell]], -1)
        rgb = torch.where((near & jumped[cell]).any(-1, keepdim=True), 1.0, rgb)
        rgb = torch.where((hits.face < 0)[:, None], 0.05, rgb)
        panels.append(rgb.reshape(n, n, 3))
    return torch.cat(panels, 1)


def surface(mesh: str | Path, tiles: TileSet, options: SurfaceOptions, report: Report = silent) -> TiledSurface:
    """Return a mesh laid out for all sets of the kind of `tiles`, or the surface in a file; errors as for `run`."""
    if Path(mesh).suffix.lower() == ".surface":
        return tiled_surface.load(mesh)
    report("quads", 0)
    patches = parameterize.of_file(mesh, options)
    report("quads", 0.5)
    found = quad_tiling.arrange(patches, tiles, seed=options.seed)
    report("quads", 1)
    return found
