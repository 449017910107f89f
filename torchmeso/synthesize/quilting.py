"""Image quilting of BTFs: patches of an exemplar, laid over each other row by row, cut along seams.

kawasaki2005quilting, section 3.1, after efros2001image: the first patch is drawn at random; every further one is drawn
among the placements whose error over the overlap is within a tolerance, and cut along the seam that shows least
(`seam_dp`). What grows is a quilting map, never a large texture (section 3.2). Two rules say what is within tolerance:

    "rms"   d <= d_max = c sqrt(mean over the overlap of the placed texels' weighted squares), eq. (3);
    "best"  d <= (1 + c) times the least d of all placements, efros2001image.

Where no placement is within d_max the best one is taken. All errors are whole numbers (`patch_error`): the same seed
gives the same map on any number of threads and both backends.

A texture that tiles is laid on a torus: patches stand on a grid that divides it, overlap a little more where that is
needed, and those that close a row or column are cut on both sides.

Test: tests/synthesize/test_quilting.py
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import torch
from jaxtyping import Int
from torch import Tensor

from torchmeso.backends import BackendChoice, opencl
from torchmeso.data.quilting_map import QuiltingMap
from torchmeso.errors import ConfigError, check_range
from torchmeso.synthesize import seam_dp
from torchmeso.synthesize.patch_error import Exemplar, Search, one_thread

Rule = Literal["rms", "best"]

MOST_TEXELS = 1 << 28
"""Of a quilted texture: 1 GiB of map."""


@dataclass(frozen=True, slots=True, kw_only=True)
class QuiltingOptions:
    """How to quilt.

    Attributes:
        patch: side of a patch in texels, W; None = a third of the exemplar's shorter side.
        overlap: texels by which patches overlap, O, at most half a patch; None = a quarter of a patch.
        tolerance: c, not negative; 0 takes only what fits exactly, else the best.
        rule: what is within tolerance.
        tileable: whether the quilted texture is to repeat without a seam.
        toroidal: whether the exemplar itself does, so that patches may run over its border.
        verbatim: whether a patch may simply go on where its neighbour came from, which fits best and repeats most;
            None = not in a toroidal exemplar, where that would go on for ever.
    """

    patch: int | None = None
    overlap: int | None = None
    tolerance: float = 0.1
    rule: Rule = "rms"
    tileable: bool = False
    toroidal: bool = False
    verbatim: bool | None = None

    def __post_init__(self) -> None:
        """Raise ConfigError for dials out of range."""
        if self.patch is not None:
            check_range("quilting.patch", self.patch, 2, 1 << 15)
        if self.overlap is not None:
            check_range("quilting.overlap", self.overlap, 1, 1 << 14)
        check_range("quilting.tolerance", self.tolerance, 0, 1e6)
        if self.rule not in get_args(Rule):
            raise ConfigError(f"quilting.rule: expected 'rms' or 'best', got '{self.rule}'")


class Quilt(NamedTuple):
    """A quilted texture and how it came about.

    Attributes:
        map: what stands where.
        patch: (H, W) number of the patch that shows, in the order in which they were laid.
        within: share of the patches, but the first, that were within tolerance.
    """

    map: QuiltingMap
    patch: Int[Tensor, "H W"]
    within: float


def grow(
    source: Exemplar,
    size: tuple[int, int],
    options: QuiltingOptions | None = None,
    *,
    rng: torch.Generator,
    backend: BackendChoice = "torch",
    progress: Callable[[float], None] = lambda share: None,
) -> Quilt:
    """Return a texture of `size` quilted from an exemplar.

    Args:
        source: see `patch_error.exemplar`.
        size: height and width in texels.
        options: dials.
        rng: what placements are drawn with.
        backend: where seams are found; both find the same.
        progress: called with the share done.

    Raises:
        ConfigError: the patch is larger than the exemplar, the overlap than half the patch, or a texture that is to
            tile is smaller than the patch.
    """
    options = options or QuiltingOptions()
    side, overlap = _sizes(source, size, options)
    rows, columns = (_grid(n, side, overlap, tileable=options.tileable) for n in size)
    state = _State(source, options, side, rows, columns, rng, opencl.resolve(backend))
    total = len(rows.starts) * len(columns.starts)
    with one_thread():  # a patch is too little work for two
        for i in range(len(rows.starts)):
            for j in range(len(columns.starts)):
                state.lay(i, j)
                progress(len(state.places) / total)
    index, patch = (x[: size[0], : size[1]].int().contiguous() for x in (state.index, state.patch))
    quilted = QuiltingMap(index=index, source=source.texels, tileable=options.tileable)
    return Quilt(quilted, patch, state.within / (total - 1) if total > 1 else 1.0)


def _sizes(source: Exemplar, size: tuple[int, int], options: QuiltingOptions) -> tuple[int, int]:
    """Return the side of a patch and the overlap."""
    height, width = source.texels
    if min(size) < 1 or math.prod(size) > MOST_TEXELS:
        raise ConfigError(f"quilting.size: expected 1 to {MOST_TEXELS} texels, got {size[1]} x {size[0]}")
    side = max(min(height, width) // 3, 2) if options.patch is None else options.patch
    if side > min(height, width):
        raise ConfigError(
            f"quilting.patch: expected at most the exemplar's shorter side, {min(height, width)} texels, got {side}; "
            "use smaller patches or a larger exemplar"
        )
    overlap = max(side // 4, 1) if options.overlap is None else options.overlap
    if overlap > side // 2:
        raise ConfigError(f"quilting.overlap: expected at most half a patch of {side} texels, got {overlap}")
    if options.tileable and min(size) < side:
        raise ConfigError(
            f"quilting.size: a texture that tiles has to be as large as a patch of {side} texels, got "
            f"{size[1]} x {size[0]}"
        )
    return side, overlap


class _Grid(NamedTuple):
    """Where patches begin along one side, and by how much each overlaps what is there."""

    starts: list[int]
    before: list[int]  # overlap with the patch before
    after: list[int]  # with the one behind, of the one that closes a ring
    room: int  # texels laid


def _grid(size: int, side: int, overlap: int, *, tileable: bool) -> _Grid:
    step = side - overlap
    if not tileable:
        count = 1 + max(math.ceil((size - side) / step), 0)
        starts = [k * step for k in range(count)]
        return _Grid(starts, [0, *[overlap] * (count - 1)], [0] * count, starts[-1] + side)
    count = math.ceil(size / step)
    starts = [k * size // count for k in range(count)]
    before = [0, *(starts[k - 1] + side - starts[k] for k in range(1, count))]
    return _Grid(starts, before, [0] * (count - 1) + [starts[-1] + side - size], size)


class _State:
    """A quilt in the making."""

    def __init__(
        self,
        source: Exemplar,
        options: QuiltingOptions,
        side: int,
        rows: _Grid,
        columns: _Grid,
        rng: torch.Generator,
        backend: Literal["torch", "opencl"],
    ):
        self.source, self.options, self.side = source, options, side
        self.rows, self.columns, self.rng = rows, columns, rng
        self.backend: Literal["torch", "opencl"] = backend
        self.search = Search(source, toroidal=options.toroidal)
        self.index = torch.full((rows.room, columns.room), -1, dtype=torch.long)
        self.codes, self.power = source.codes.flatten(0, 1), source.power.flatten()
        self.verbatim = not options.toroidal if options.verbatim is None else options.verbatim
        self.places: dict[tuple[int, int], tuple[int, int]] = {}  # first row and column of the patch of each cell
        self.patch = torch.full_like(self.index, -1)
        self.within = 0

    def lay(self, i: int, j: int) -> None:
        """Choose the patch of row `i` and column `j` of the grid, cut it, and lay it."""
        y, x = self.rows.starts[i], self.columns.starts[j]
        along_y = (y + torch.arange(self.side)) % self.rows.room
        along_x = (x + torch.arange(self.side)) % self.columns.room
        there = self.index[along_y[:, None], along_x]
        overlap = there >= 0
        placed = self.codes[there.clamp(min=0)]
        self.places[i, j] = self._choose(there, placed, overlap, [] if self.verbatim else self._copies(i, j))
        patch = self._texels(*self.places[i, j])
        e = torch.where(overlap, (self.codes[patch] - placed).square().sum(-1), 0)
        shown = torch.ones_like(overlap)
        if bool(e.any()):  # seams that cost nothing need not be looked for
            shown = seam_dp.shown(
                e, left=self.columns.before[j], top=self.rows.before[i], right=self.columns.after[j],
                bottom=self.rows.after[i], backend=self.backend,
            ) | ~overlap  # fmt: skip
        self.index[along_y[:, None], along_x] = torch.where(shown, patch, there)
        self.patch[along_y[:, None], along_x] = torch.where(
            shown, len(self.places) - 1, self.patch[along_y[:, None], along_x]
        )

    def _copies(self, i: int, j: int) -> list[tuple[int, int]]:
        """Return the placements that go on where the patches on the left and above came from."""
        found = []
        for cell in ((i, j - 1), (i - 1, j)):
            if cell in self.places:
                row, column = self.places[cell]
                row += self.rows.starts[i] - self.rows.starts[cell[0]]
                column += self.columns.starts[j] - self.columns.starts[cell[1]]
                height, width = self.source.texels
                found.append((row % height, column % width) if self.options.toroidal else (row, column))
        return found

    def _choose(self, there: Tensor, placed: Tensor, overlap: Tensor, copies: list[tuple[int, int]]) -> tuple[int, int]:
        """Return first row and column of a placement within tolerance, or of the best; of `copies` only if it has to.

        Args:
            there: (P, P) texels of the exemplar that lie there, -1 = none.
            placed: (P, P, C) their codes.
            overlap: (P, P) where there are any.
            copies: what is left out.
        """
        rows, columns = self.search.placements(self.side, self.side)
        if not bool(overlap.any()):
            return divmod(self._draw(rows * columns), columns)
        errors = self.search.errors(placed, overlap)
        for row, column in copies if errors.numel() > len(copies) else []:
            if row < rows and column < columns:
                errors[row, column] = seam_dp.FAR
        best = int(errors.min())
        if self.options.rule == "rms":
            limit = self.options.tolerance**2 * int(self.power[there[overlap]].sum())
        else:
            limit = (1 + self.options.tolerance) ** 2 * best
        self.within += best <= limit
        allowed = (errors <= max(min(math.floor(limit), seam_dp.FAR - 1), best)).flatten().nonzero()[:, 0]
        chosen = self._draw(len(allowed)) if best <= limit else 0  # of equally good ones the first
        return divmod(int(allowed[chosen]), columns)

    def _draw(self, count: int) -> int:
        return int(torch.randint(count, (1,), generator=self.rng))

    def _texels(self, row: int, column: int) -> Int[Tensor, "P P"]:
        """Return the texels of the patch placed there."""
        height, width = self.source.texels
        along = torch.arange(self.side)
        return (row + along)[:, None] % height * width + (column + along) % width
