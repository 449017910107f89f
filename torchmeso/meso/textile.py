"""Mesostructures from textiles: yarns swept into tubes, repeated over one tile that repeats.

The sides of the tile (`meso.textile_period`) become 1 along u and v; z is scaled by the mean of both.

A yarn that goes on in its own copy is an open tube whose last ring is the first one of that copy, so that
`meso.solid` joins them through the tile's border; other yarns are closed at both ends.

Test: tests/meso/test_textile.py
"""

import warnings

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.data import texgen
from torchmeso.data.textile import Textile
from torchmeso.errors import GeometryError, check_memory, check_range
from torchmeso.meso.mesostructure import Mesostructure, Rgb, palette
from torchmeso.meso.parts import DARK, Triangles, assemble, floor, tube
from torchmeso.meso.textile_period import copies, goes_on, tile_of

STEPS = 1 << 20
"""Vertices lie on a grid of this many steps per tile, so that moving by whole tiles is exact."""

MOST_TILES = 32
"""How far one yarn may reach."""

MEMORY_LIMIT = 2 << 30


def from_tg3(
    *,
    path: str,
    h: float | None = None,
    colour: Rgb = (0.6, 0.57, 0.5),
    weft_colour: Rgb = (0.16, 0.28, 0.45),
    colours: list[Rgb] | None = None,
    roughness: float = 0.4,
    weft_roughness: float = 0.4,
    f0: float = 0.04,
    backing: bool = False,
    along: int = 48,
    segments: int = 32,
) -> Mesostructure:
    """Return one period of a TexGen weave (.tg3).

    Args:
        path: the file.
        h: slab depth in tile units; None = the extent of the yarns.
        colour: linear RGB of yarns that go along v or nowhere (the warp).
        weft_colour: linear RGB of yarns that go along u.
        colours: one linear RGB for each yarn of the file instead.
        roughness: GGX width of the warp's coat.
        weft_roughness: GGX width of the weft's coat.
        f0: reflectance of the coats at normal incidence.
        backing: whether a dark sheet closes the gaps at -h; without it rays pass through (no-hit entries).
        along: rings of a yarn per side of the tile.
        segments: facets around a yarn.

    Raises:
        FormatError: the file is missing or unreadable.
        GeometryError: the textile has no period that makes a tile.
        ConfigError: `colours` are not as many as yarns, or a dial is out of range.
        SizeError: the tile would have too many triangles.
    """
    textile = texgen.read(path)
    if colours is not None:
        check_range("textile.colours", len(colours), len(textile.yarns), len(textile.yarns))
    weft = [abs(float(y.way[0])) > abs(float(y.way[1])) for y in textile.yarns]
    kinds = colours or [weft_colour if w else colour for w in weft]
    coats = [(c, weft_roughness if w else roughness, f0) for c, w in zip(kinds, weft, strict=True)]
    return from_textile(textile, coats, h=h, backing=backing, along=along, segments=segments)


def from_textile(
    textile: Textile,
    coats: list[tuple[Rgb, float, float]],
    *,
    h: float | None = None,
    backing: bool = False,
    along: int = 48,
    segments: int = 32,
) -> Mesostructure:
    """Return one period of a textile; see `from_tg3`.

    Args:
        textile: yarns, in any unit.
        coats: (albedo, roughness, f0) of each yarn.
        h: slab depth in tile units; None = the extent of the yarns.
        backing: whether a dark sheet lies at -h.
        along: rings per side of the tile.
        segments: facets around a yarn.

    Raises:
        GeometryError: there is no period that makes a tile, or a yarn reaches over too many.
        ConfigError: the yarns are deeper than `h`, or a dial is out of range.
        SizeError: the tile would have too many triangles.
    """
    check_range("textile.along", along, 2, 4096)
    check_range("textile.segments", segments, 3, 4096)
    tile = tile_of(textile)
    if tile.anisotropy > 1 + 1e-3:
        warnings.warn(
            f"textile: the sides of the tile are {tile.sides[0]:.5g} and {tile.sides[1]:.5g}; "
            f"x and y are scaled apart by {tile.anisotropy:.3g}",
            stacklevel=2,
        )
    step, shifts = float(tile.sides.min()) / along, [copies(yarn, tile) for yarn in textile.yarns]
    quads = sum(len(s) * yarn.count(step) * segments for yarn, s in zip(textile.yarns, shifts, strict=True))
    check_memory("textile", 400.0 * quads, MEMORY_LIMIT, "lower along or segments")
    found: list[tuple[Float[Tensor, "ring around 3"], bool, int]] = []
    for k, yarn in enumerate(textile.yarns):
        rings = (yarn.rings(step, segments) - torch.nn.functional.pad(tile.low, (0, 1))) / tile.unit
        if float((rings.amax((0, 1)) - rings.amin((0, 1)))[:2].max()) > MOST_TILES:
            raise GeometryError(f"textile: expected yarns that reach over at most {MOST_TILES} tiles, got a longer one")
        for shift in shifts[k]:
            home = torch.nn.functional.pad((rings[0, 0] + shift)[:2].floor(), (0, 1))
            found.append((rings + shift - home, goes_on(yarn, tile), k))
    top = max(float(rings[..., 2].max()) for rings, _, _ in found)
    parts = []
    for rings, open_ended, k in found:
        rings = rings - rings.new_tensor([0, 0, top])
        if open_ended:
            rings = torch.cat([rings[:-1], rings[:1] + (textile.yarns[k].way / tile.unit).round(decimals=12)])
        parts.append((_surface((rings * STEPS).round().div(STEPS).float(), open_ended), k))
    depth = max(-float(vertices[:, 2].min()) for (vertices, _), _ in parts)
    if h is not None:
        check_range("textile.h", h, depth, 10)
        depth = h
    if backing:
        parts.append((floor(depth), len(coats)))
    return assemble(parts, palette(*coats, DARK), depth)


def _surface(rings: Float[Tensor, "ring around 3"], open_ended: bool) -> Triangles:
    """Return rings as a tube, its ends closed by fans unless they are open."""
    vertices, faces = tube(rings)
    if open_ended:
        return vertices, faces
    n, around = rings.shape[:2]
    corner = torch.arange(around)
    ends = [
        torch.stack([torch.full((around,), len(vertices) + k), first + corner, first + corner.roll(-1)], -1)
        for k, first in enumerate((0, (n - 1) * around))
    ]
    ends[0] = ends[0].flip(1)
    middles = rings[[0, -1]].double().mean(1)
    return torch.cat([vertices, ((middles * STEPS).round() / STEPS).float()]), torch.cat([faces, *ends])
