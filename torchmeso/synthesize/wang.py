"""Wang tiles of BTFs and pictures: sets of squares that go on in one another, cut from an exemplar.

leung2007tileable, section 3.2. Its four steps keep cuts short:

1. Corner samples of h x h texels, one for each colour, chosen among many so that the cuts between their quarters are
   cheap (`corners`).
2. Edges of w x h texels, one for each colour of a side (or pair of colours of its corners): between half a sample at
   either end w - h texels are filled with patches, cut by graph cuts and laid again until little shows (`filling`).
3. Frames: of each of its four edges a tile takes the inner half. Where two of them overlap, h/2 x h/2 texels at each
   corner, a cut runs from the tile's corner inwards.
4. The inside is filled like an edge. The outermost texels stay: across them lies the edge's other half.

Three kinds of sets: "edges", all combinations of c colours of the sides on which tiles meet one above the other and c
of those on which they meet side by side, c^4; "corners", all combinations of c colours of corners, c^4, where tiles
that meet at a corner only match too (lagae2006alternative); "any", for surfaces of any topology: two colours of each of
two classes, on any two of the four sides, 6 x 2^4 = 96. Any closed mesh of quads can be coloured for it: its dual is
4-regular and so falls into two 2-factors, which give each quad two sides of either class.

Errors, cuts and choices are whole numbers: the same seed gives the same bits.

Test: tests/synthesize/test_wang.py
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from typing import Literal, NamedTuple, get_args

import torch
from jaxtyping import Bool, Int, Shaped
from torch import Tensor

from torchmeso.backends import BackendChoice, opencl
from torchmeso.data import tile_set
from torchmeso.data.tile_set import Marks, TileSet
from torchmeso.errors import ConfigError, check_range
from torchmeso.synthesize import seam_graphcut
from torchmeso.synthesize.filling import Filler, Parts, place, seam_errors
from torchmeso.synthesize.patch_error import Exemplar, Search, one_thread
from torchmeso.synthesize.seam_graphcut import FREE, NEW, OLD, Cut, differences

Kind = Literal["edges", "corners", "any"]

TRIES = 24
"""First corner samples that are tried, and"""

CUT_TRIES = 4
"""of the best of them, those whose cuts are made."""

FAR = 1 << 60
"""Error of a placement that is out of the question."""

CORNERS = ((False, False), (False, True), (True, False), (True, True))
"""Of a tile: whether on its south, and on its east."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WangOptions:
    """How to make tiles.

    Attributes:
        size: side of a tile in texels, w; None = the exemplar's shorter side.
        band: height of an edge, h, even: about the size of a feature; None = about a quarter of a tile.
        kind: see above.
        colours: c; "any" has two of each class.
        patch: side of the patches that fill; None = half a tile, or as much of the exemplar.
        candidates: patches that are cut for each that is laid.
        refine: most patches laid over the worst seams of each edge and tile.
        toroidal: whether the exemplar repeats, so that patches may run over its border.
    """

    size: int | None = None
    band: int | None = None
    kind: Kind = "edges"
    colours: int = 2
    patch: int | None = None
    candidates: int = 8
    refine: int = 12
    toroidal: bool = False

    def __post_init__(self) -> None:
        """Raise ConfigError for dials out of range."""
        if self.kind not in get_args(Kind):
            raise ConfigError(f"wang.kind: expected 'edges', 'corners' or 'any', got '{self.kind}'")
        check_range("wang.colours", self.colours, 1, 4)
        check_range("wang.candidates", self.candidates, 1, 256)
        check_range("wang.refine", self.refine, 0, 10_000)
        if self.kind == "any" and self.colours != 2:
            raise ConfigError(f"wang.colours: expected 2 for a set of kind 'any', got {self.colours}")
        for name, value, least in (("size", self.size, 8), ("band", self.band, 4), ("patch", self.patch, 4)):
            if value is not None:
                check_range(f"wang.{name}", value, least, 4096)
        if self.band is not None and self.band % 2:
            raise ConfigError(f"wang.band: expected an even number of texels, got {self.band}")


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Feature:
    """A part of the exemplar that is put somewhere and stays (leung2007tileable, section 3.3).

    Attributes:
        on: a horizontal edge, between tiles one above the other; a vertical one; or the inside of a tile.
        number: which one, in the order in which `grow` makes them.
        at: first row and column there; an edge's pictures are h x w (horizontal) or w x h.
        taken: first row and column in the exemplar.
        mask: (rows, columns) which texels.
    """

    on: Literal["horizontal", "vertical", "tile"]
    number: int
    at: tuple[int, int]
    taken: tuple[int, int]
    mask: Bool[Tensor, "rows columns"]


class Wang(NamedTuple):
    """Tiles and how they came about.

    Attributes:
        set: the tiles.
        errors: (T, w, w) what seams cost at each texel, see `filling`.
        corners: (n, 2) first row and column of each corner sample in the exemplar.
    """

    set: TileSet
    errors: Int[Tensor, "T w w"]
    corners: Int[Tensor, "n 2"]


class _Plan(NamedTuple):
    """What a set is made of: corner samples at both ends of each edge, and the edges of each tile."""

    samples: int
    horizontal: list[tuple[int, ...]]  # on its left, on its right
    vertical: list[tuple[int, ...]]  # above, below
    tiles: list[tuple[int, ...]]  # north, east, south, west
    colours: list[tuple[int, ...]]


def plan(kind: Kind, colours: int) -> _Plan:
    """Return the edges and tiles of a set; see the module's text."""
    if kind == "corners":
        pairs = list(product(range(colours), repeat=2))
        corners = list(product(range(colours), repeat=4))
        each = [
            (pairs.index((nw, ne)), pairs.index((ne, se)), pairs.index((sw, se)), pairs.index((nw, sw)))
            for nw, ne, se, sw in corners
        ]
        return _Plan(colours, pairs, pairs, each, corners)
    if kind == "edges":
        tiles = list(product(range(colours), repeat=4))
        one, other = ([(first + k,) * 2 for k in range(colours)] for first in (0, colours))
        return _Plan(2 * colours, one, other, tiles, tiles)
    tiles = [sides for sides in product(range(4), repeat=4) if sum(side < 2 for side in sides) == 2]
    each = [(k, k) for k in range(4)]
    return _Plan(4, each, each, tiles, tiles)


def grow(
    source: Exemplar,
    options: WangOptions | None = None,
    *,
    rng: torch.Generator,
    corners: Int[Tensor, "n 2"] | None = None,
    features: tuple[Feature, ...] = (),
    backend: BackendChoice = "torch",
    progress: Callable[[float], None] = lambda share: None,
) -> Wang:
    """Return a set of Wang tiles.

    Args:
        source: see `patch_error.exemplar`.
        options: dials.
        rng: what choices are drawn with.
        corners: first row and column of each corner sample, chosen by hand.
        features: what is put somewhere and stays.
        backend: where cuts are found; both find the same.
        progress: called with the share done.

    Raises:
        ConfigError: sizes do not fit the exemplar or each other, or a feature has no room.
    """
    options = options or WangOptions()
    side, band, patch = _sizes(source, options)
    wanted = plan(options.kind, options.colours)
    _check_features(features, wanted)
    chosen: Literal["torch", "opencl"] = opencl.resolve(backend)
    with one_thread():
        search = Search(source, toroidal=options.toroidal)
        filler = Filler(
            search=search, parts=Parts(search, patch), patch=patch, candidates=options.candidates,
            refine=options.refine, calm=_calm(source), rng=rng, backend=chosen,
        )  # fmt: skip
        if corners is None:
            corners = _corners(search, band, wanted.samples, rng, chosen)
        elif corners.shape != (wanted.samples, 2):
            raise ConfigError(f"wang.corners: expected {wanted.samples} places, got {tuple(corners.shape)}")
        samples = place(source, corners[:, 0], corners[:, 1], band, band)
        jobs = len(wanted.horizontal) + len(wanted.vertical) + len(wanted.tiles)
        steps = iter(range(1, jobs + 1))

        def filled(index: Tensor, held: Tensor) -> Tensor:
            found = filler.fill(index, held)
            progress(next(steps) / jobs)
            return found

        strips, kept = [], []
        for on, pairs in (("horizontal", wanted.horizontal), ("vertical", wanted.vertical)):
            made = [_strip(samples[first], samples[last], side, on) for first, last in pairs]
            locks = [
                _put(source, index, held, [f for f in features if (f.on, f.number) == (on, k)])
                for k, (index, held) in enumerate(made)
            ]
            filled_ones = [filled(index, held | lock) for (index, held), lock in zip(made, locks, strict=True)]
            strips.append(torch.stack(filled_ones))
            kept.append(torch.stack(locks))
        frames = _frames(source, strips[0], strips[1], wanted.tiles, chosen)
        locked = _laid(kept[0], kept[1], wanted.tiles)
        tiles = []
        for k, (index, lock) in enumerate(zip(frames, locked, strict=True)):
            held = torch.nn.functional.pad(lock[1:-1, 1:-1], (1, 1, 1, 1), value=True)
            lock = _put(source, index, held, [f for f in features if (f.on, f.number) == ("tile", k)])
            tiles.append(filled(index, held | lock))
    errors = torch.stack([seam_errors(source, index, toroidal=options.toroidal) for index in tiles])
    marks: Marks = "corners" if options.kind == "corners" else "edges"
    colours = torch.tensor(wanted.colours)
    return Wang(tile_set.of_texels(torch.stack(tiles), source.texels, colours, marks), errors, corners)


def _sizes(source: Exemplar, options: WangOptions) -> tuple[int, int, int]:
    """Return the sides of a tile, of a corner sample and of a patch."""
    short = min(source.texels)
    side = short if options.size is None else options.size
    band = max(side // 8 * 2, 4) if options.band is None else options.band
    patch = max(min(side, short) // 2, 4) if options.patch is None else options.patch
    if max(band, patch) > short:
        raise ConfigError(
            f"wang: expected corner samples and patches of at most the exemplar's shorter side, {short} texels, got "
            f"{band} and {patch}; use smaller ones or a larger exemplar"
        )
    if 2 * band > side:
        raise ConfigError(f"wang.band: expected at most half a tile of {side} texels, got {band}")
    return side, band, patch


def _calm(source: Exemplar) -> int:
    """Return the mean difference of neighbours in the exemplar: a seam that shows no more needs no patch."""
    codes = source.codes
    pairs = [(codes[:, 1:], codes[:, :-1]), (codes[1:], codes[:-1])]
    found = torch.cat([differences(a, b).flatten() for a, b in pairs])
    return int(found.sum()) // max(len(found), 1)


def _corners(
    search: Search, band: int, count: int, rng: torch.Generator, backend: Literal["torch", "opencl"]
) -> Int[Tensor, "count 2"]:
    """Return corner samples whose quarters are cut apart for little: the best of several first ones and their like."""
    rows, columns = search.placements(band, band)
    tries = []
    whole = torch.ones(band, band, dtype=torch.bool)
    for first in torch.randperm(rows * columns, generator=rng)[:TRIES].tolist():
        row, column = (torch.tensor([k]) for k in divmod(first, columns))
        texels = place(search.source, row, column, band, band)[0]
        errors = search.errors(search.source.codes.flatten(0, 1)[texels], whole)
        found, cost = _alike(errors, count, band // 2)
        tries.append((cost, first, found))
    best = [found for _, _, found in sorted(tries, key=lambda x: x[:2])[:CUT_TRIES]]
    costs = [_cut_cost(search.source, found, band, backend) for found in best]
    return best[costs.index(min(costs))]


def _alike(errors: Int[Tensor, "rows columns"], count: int, apart: int) -> tuple[Int[Tensor, "count 2"], int]:
    """Return the placements of least error that are `apart`, and the sum of their errors."""
    rows, columns = errors.shape
    left, found, total = errors.clone(), [], 0
    y, x = torch.arange(rows)[:, None], torch.arange(columns)
    for _ in range(count):
        while True:
            row, column = divmod(int(left.flatten().argmin()), columns)
            if int(left[row, column]) < FAR or apart <= 1:
                break
            apart //= 2  # no room for so many
            left = errors.clone()
            for r, c in found:
                left[((y - r).abs() < apart) & ((x - c).abs() < apart)] = FAR
        found.append((row, column))
        total += int(errors[row, column])
        left[((y - row).abs() < apart) & ((x - column).abs() < apart)] = FAR
    return torch.tensor(found), total


def _cut_cost(source: Exemplar, corners: Tensor, band: int, backend: Literal["torch", "opencl"]) -> int:
    """Return what all cuts between the quarters of corner samples cost."""
    samples, q = place(source, corners[:, 0], corners[:, 1], band, band), band // 2
    total = 0
    for south, east in CORNERS:
        quarters = samples[:, :q] if south else samples[:, q:]
        quarters = _turned(quarters[..., :q] if east else quarters[..., q:], south, east)
        total += int(_cuts(source, quarters, quarters, backend).cost.sum())
    return total


def _cuts(
    source: Exemplar, across: Int[Tensor, "m q q"], down: Int[Tensor, "n q q"], backend: Literal["torch", "opencl"]
) -> Cut:
    """Return the cuts between quarters of all pairs of edges at the upper left corner of tiles, m n of them.

    From the corner inwards; `down`, of the vertical edge, is what is old.
    """
    q = across.shape[-1]
    side = torch.full((q, q), FREE)
    side[1:, 0] = side[-1, :-1] = OLD
    side[0, 1:] = side[:-1, -1] = NEW
    codes = source.codes.flatten(0, 1)
    e = differences(codes[across][:, None], codes[down][None]).flatten(0, 1)
    return seam_graphcut.cut(e, side, backend=backend)


def _turned(x: Tensor, south: bool, east: bool) -> Tensor:
    """Return squares so that the corner of the tile is the upper left one."""
    return x.flip([k for k, flip in ((-2, south), (-1, east)) if flip])


def _strip(
    first: Int[Tensor, "h h"], last: Int[Tensor, "h h"], side: int, on: str
) -> tuple[Int[Tensor, "a b"], Bool[Tensor, "a b"]]:
    """Return an edge with the halves of its corner samples, empty between, and which texels are there."""
    band, q = len(first), len(first) // 2
    if on == "vertical":
        index, held = _strip(first.mT, last.mT, side, "horizontal")
        return index.mT.contiguous(), held.mT.contiguous()
    index = torch.full((band, side), -1)
    index[:, :q], index[:, side - q :] = first[:, q:], last[:, :q]
    return index, index >= 0


def _laid(
    horizontal: Shaped[Tensor, "m h w"], vertical: Shaped[Tensor, "n w h"], tiles: list[tuple[int, ...]]
) -> Shaped[Tensor, "T w w"]:
    """Return the inner halves of the edges of each tile, horizontal ones above, zeros elsewhere."""
    q, side = horizontal.shape[1] // 2, horizontal.shape[2]
    north, east, south, west = torch.tensor(tiles).unbind(1)
    found = horizontal.new_zeros(len(tiles), side, side)
    found[:, :, :q], found[:, :, side - q :] = vertical[west][:, :, q:], vertical[east][:, :, :q]
    found[:, :q], found[:, side - q :] = horizontal[north][:, q:], horizontal[south][:, :q]
    return found


def _frames(
    source: Exemplar,
    horizontal: Int[Tensor, "m h w"],
    vertical: Int[Tensor, "n w h"],
    tiles: list[tuple[int, ...]],
    backend: Literal["torch", "opencl"],
) -> Int[Tensor, "T w w"]:
    """Return the tiles with their edges, cut at the corners, and -1 inside."""
    q, side = horizontal.shape[1] // 2, horizontal.shape[2]
    found = _laid(horizontal, vertical, tiles)
    found[:, q : side - q, q : side - q] = -1
    north, east_, south_, west = torch.tensor(tiles).unbind(1)
    for south, east in CORNERS:
        across = horizontal[:, :q] if south else horizontal[:, q:]
        down = vertical[..., :q] if east else vertical[..., q:]
        rows = slice(side - q, side) if south else slice(q)
        columns = slice(side - q, side) if east else slice(q)
        across, down = _turned(across[..., columns], south, east), _turned(down[:, rows], south, east)
        old = _cuts(source, across, down, backend).old.unflatten(0, (len(across), len(down)))
        one, other = south_ if south else north, east_ if east else west
        quarter = torch.where(old[one, other], down[other], across[one])
        found[:, rows, columns] = _turned(quarter, south, east)
    return found


def _put(
    source: Exemplar, index: Int[Tensor, "a b"], held: Bool[Tensor, "a b"], features: list[Feature]
) -> Bool[Tensor, "a b"]:
    """Put features into an edge or a tile, in place, and return which texels they take."""
    taken = torch.zeros_like(held)
    rows, columns = source.texels
    for feature in features:
        y, x = feature.mask.nonzero().unbind(1)
        there = (y + feature.at[0], x + feature.at[1])
        size = index.shape
        inside = (there[0] >= 0) & (there[0] < size[0]) & (there[1] >= 0) & (there[1] < size[1])
        if not bool(inside.all()) or bool(held[there].any()):
            raise ConfigError(
                f"feature: expected to find room on {feature.on} {feature.number} beside what is held there, got "
                f"{tuple(feature.mask.shape)} texels at {feature.at}; move it, or make tiles larger"
            )
        from_y, from_x = y + feature.taken[0], x + feature.taken[1]
        if int(from_y.min()) < 0 or int(from_x.min()) < 0 or int(from_y.max()) >= rows or int(from_x.max()) >= columns:
            raise ConfigError(f"feature: expected texels of the exemplar, {columns} x {rows}, got {feature.taken}")
        index[there] = from_y * columns + from_x
        taken[there] = True
    return taken


def _check_features(features: tuple[Feature, ...], wanted: _Plan) -> None:
    """Raise ConfigError for a feature on nothing."""
    counts = {"horizontal": len(wanted.horizontal), "vertical": len(wanted.vertical), "tile": len(wanted.tiles)}
    for feature in features:
        if not 0 <= feature.number < counts.get(feature.on, 0) or not bool(feature.mask.any()):
            raise ConfigError(
                f"feature: expected some texels on one of {counts}, got {int(feature.mask.sum())} on "
                f"{feature.on} {feature.number}"
            )
