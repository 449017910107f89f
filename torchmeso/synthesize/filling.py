"""Filling areas with patches of an exemplar, cut along graph cuts, again and again until what shows is little.

leung2007tileable, section 3.2, step 2 ("iterative filling"): patches are laid over what is empty and what is there
already, cut from it, and kept if that is an improvement; what the seams show is kept per texel.

Errors are read off the picture of places itself: where neighbours p and q show texels a and b of the exemplar that are
no neighbours there, the seam between them costs

    M(p, q) = ||A(a) - A(b - d)|| + ||A(a + d) - A(b)||,      d the step from p to q,

kwatra2003graphcut's cost between the two patches that meet, whatever else was laid since. Half of it counts at each
side. All numbers are whole, and choices are drawn from `rng`: the same seed fills the same way.

Test: tests/synthesize/test_filling.py
"""

import math
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from torchmeso.synthesize import seam_graphcut
from torchmeso.synthesize.patch_error import Exemplar, Search
from torchmeso.synthesize.seam_graphcut import FREE, MOST_ERROR, NEW, OLD, differences

NEIGHBOURS = 3
"""A patch is laid where at least one in so many of its texels lies over what is there."""

CRAMPED = 8
"""Empty texels that a window has to cover more for each row or column without room for a cut."""

FAR = 1 << 40

POOL = 4
"""Candidates are drawn from so many times as many of the best placements."""


PART = 2.5
"""Sides of a patch along a part of a large exemplar, see `Parts`."""


class Parts:
    """A large exemplar as squares that are searched one at a time, drawn at random.

    A search transforms all of what it looks at; a patch needs a choice of placements, not all of them. An exemplar of
    up to twice `PART` patches along a side is one part. Neighbours overlap by a patch, so that each placement lies in
    some part, but those over the border of a toroidal one.
    """

    def __init__(self, whole: Search, patch: int):
        """Divide what `whole` searches into parts for patches of this side."""
        self._whole, self._searches = whole, dict[tuple[int, int], Search]()
        side = math.ceil(PART * patch)
        self._starts: list[tuple[int, int]] = []
        if max(whole.source.texels) > 2 * side:
            rows, columns = (_starts(n, side, patch) for n in whole.source.texels)
            self._starts = [(row, column) for row in rows for column in columns]
        self._side = side

    def draw(self, rng: torch.Generator) -> tuple[int, int, Search]:
        """Return first row and column of a part, and its search."""
        if not self._starts:
            return 0, 0, self._whole
        row, column = self._starts[int(torch.randint(len(self._starts), (1,), generator=rng))]
        if (row, column) not in self._searches:
            rows, columns = (slice(first, first + self._side) for first in (row, column))
            source = self._whole.source
            part = replace(source, codes=source.codes[rows, columns], power=source.power[rows, columns])
            self._searches[row, column] = Search(part)
        return row, column, self._searches[row, column]


def _starts(size: int, side: int, overlap: int) -> list[int]:
    """Return where parts of a side begin that overlap by at least so much; the whole where it is shorter."""
    last = max(size - side, 0)
    count = math.ceil(last / max(side - overlap, 1))
    return [last * k // max(count, 1) for k in range(count + 1)]


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Filler:
    """What areas are filled from, and how.

    Attributes:
        search: the exemplar's spectra; whether it is toroidal.
        parts: what candidates are searched in, of a large exemplar.
        patch: side of a patch in texels.
        candidates: placements that are cut, of which the cheapest is laid.
        refine: most further patches over the worst seams of an area.
        calm: error of a texel that needs no further patch.
        rng: what candidates are drawn with.
        backend: where cuts are found; both find the same.
    """

    search: Search
    parts: Parts
    patch: int
    candidates: int
    refine: int
    calm: int
    rng: torch.Generator
    backend: Literal["torch", "opencl"]

    def fill(self, index: Int[Tensor, "H W"], held: Bool[Tensor, "H W"]) -> Int[Tensor, "H W"]:
        """Return an area with all its texels.

        Args:
            index: texels of the exemplar, -1 where there is none yet; some are there.
            held: texels that are there and stay.
        """
        index = index.clone()
        side = min(self.patch, *index.shape)
        while bool((index < 0).any()):
            self._lay(index, held, *_emptiest(index < 0, side), side)
        source, wrap = self.search.source, self.search.toroidal
        errors = seam_errors(source, index, toroidal=wrap)
        waiting = torch.ones_like(index, dtype=torch.bool)
        for _ in range(self.refine):
            sums = box_sums(torch.where(waiting & ~held, errors, 0), side)
            worst = int(torch.where(waiting & ~held, errors, 0).max())
            if worst <= self.calm:
                break
            y, x = divmod(int(sums.flatten().argmax()), sums.shape[1])
            trial = index.clone()
            self._lay(trial, held, y, x, side)
            after = seam_errors(source, trial, toroidal=wrap)
            if int(after.sum()) < int(errors.sum()):
                index, errors = trial, after
                waiting[:] = True
            else:
                waiting[y + side // 4 : y + side - side // 4, x + side // 4 : x + side - side // 4] = False
        return index

    def _lay(self, index: Tensor, held: Tensor, y: int, x: int, side: int) -> None:
        """Lay the best of some patches over the window at (y, x), in place."""
        window = index[y : y + side, x : x + side]
        there = window >= 0
        sides = _sides(index, held, y, x, side)
        source = self.search.source
        codes = source.codes.flatten(0, 1)
        placed = codes[window.clamp(min=0)]
        patches = self._candidates(placed, there, window)
        e = _continued(torch.where(there, differences(codes[patches], placed), 0), there)
        errors = seam_errors(source, window, toroidal=self.search.toroidal).clamp(max=MOST_ERROR)
        found = seam_graphcut.cut(e, sides, errors=torch.where(sides == FREE, errors, 0), backend=self.backend)
        best = int(found.cost.argmin())
        window[:] = torch.where(found.old[best], window, patches[best])

    def _candidates(self, placed: Tensor, there: Tensor, window: Tensor) -> Int[Tensor, "n side side"]:
        """Return patches drawn from the best over the overlap, but not what lies there already."""
        side = len(window)
        row, column, search = self.parts.draw(self.rng)
        errors = search.errors(placed, there).flatten()
        n = min(self.candidates, len(errors))
        pool = errors.topk(min(POOL * n, len(errors)), largest=False, sorted=False).indices.sort().values
        drawn = pool[torch.randperm(len(pool), generator=self.rng)[:n]]
        columns = search.placements(side, side).columns
        return place(self.search.source, row + drawn // columns, column + drawn % columns, side, side)


def _continued(e: Int[Tensor, "n side side"], there: Bool[Tensor, "side side"]) -> Int[Tensor, "n side side"]:
    """Return e with empty texels as different as what lies beside them: cuts along there would seem to cost half."""
    around = torch.nn.functional.pad(e, (1, 1, 1, 1))
    beside = torch.stack([around[:, :-2, 1:-1], around[:, 2:, 1:-1], around[:, 1:-1, :-2], around[:, 1:-1, 2:]])
    return torch.where(there, e, beside.amax(0))


def place(
    source: Exemplar, row: Int[Tensor, "n"], column: Int[Tensor, "n"], height: int, width: int
) -> Int[Tensor, "n height width"]:
    """Return the texels of patches that begin at these rows and columns; they may run over the border."""
    rows, columns = source.texels
    y = (row[:, None] + torch.arange(height)) % rows
    x = (column[:, None] + torch.arange(width)) % columns
    return y[:, :, None] * columns + x[:, None, :]


def seam_errors(source: Exemplar, index: Int[Tensor, "H W"], *, toroidal: bool) -> Int[Tensor, "H W"]:
    """Return what seams between neighbours cost, half at each side; empty texels have no seams.

    Beyond the exemplar's border, which only a `toroidal` one goes over, its last texel stands.
    """
    total = torch.zeros_like(index)
    height, width = index.shape
    for axis, size in ((1, width), (0, height)):
        if size < 2:
            continue
        a, b = index.narrow(axis, 0, size - 1), index.narrow(axis, 1, size - 1)
        cost = seam_costs(source, a, b, axis, toroidal=toroidal)
        total.narrow(axis, 0, size - 1).add_(cost)
        total.narrow(axis, 1, size - 1).add_(cost)
    return total // 2


def seam_costs(
    source: Exemplar, a: Int[Tensor, "*batch"], b: Int[Tensor, "*batch"], axis: int, *, toroidal: bool
) -> Int[Tensor, "*batch"]:
    """Return M of texels `b` of the exemplar right of (axis 1), or below, texels `a`; none where one is empty."""
    found = torch.zeros_like(a)
    following = _moved(source, a.clamp(min=0), axis, 1, toroidal=toroidal)
    apart = ((a >= 0) & (b >= 0) & (following != b)).nonzero(as_tuple=True)
    if len(apart[0]):
        codes, p, q = source.codes.flatten(0, 1), a[apart], b[apart]
        before = _moved(source, q, axis, -1, toroidal=toroidal)
        found[apart] = differences(codes[p], codes[before]) + differences(codes[following[apart]], codes[q])
    return found


def _moved(source: Exemplar, texel: Tensor, axis: int, step: int, *, toroidal: bool) -> Tensor:
    height, width = source.texels
    place = [texel // width, texel % width]
    moved, size = place[axis] + step, (height, width)[axis]
    place[axis] = moved % size if toroidal else moved.clamp(0, size - 1)
    return place[0] * width + place[1]


def box_sums(x: Int[Tensor, "H W"], side: int) -> Int[Tensor, "rows columns"]:
    """Return sums over all windows of a size, by the place of their first texel."""
    S = torch.nn.functional.pad(x.cumsum(0).cumsum(1), (1, 0, 1, 0))
    return S[side:, side:] - S[:-side, side:] - S[side:, :-side] + S[:-side, :-side]


def _emptiest(empty: Bool[Tensor, "H W"], side: int) -> tuple[int, int]:
    """Return the window that covers most empty texels and enough of what is there; the first of several.

    Where empty texels end close to a window's edge, or just there, no room is left for a cut: such windows come last.
    """
    found = box_sums(empty.long(), side)
    enough = found <= side * side - side * side // NEIGHBOURS
    score = found - CRAMPED * _cramped(empty, side)
    if bool((enough & (found > 0)).any()):
        score = torch.where(enough & (found > 0), score, -FAR)
    else:  # the one that has most around it
        score = torch.where(found > 0, -found, -FAR)
    return divmod(int(score.flatten().argmax()), found.shape[1])


def _cramped(empty: Bool[Tensor, "H W"], side: int) -> Int[Tensor, "rows columns"]:
    """Return how many rows and columns of each window go over from empty to filled close to its edge, outwards."""
    room = max(side // 4, 1)
    total = torch.zeros(empty.shape[0] - side + 1, empty.shape[1] - side + 1, dtype=torch.long)
    for flip in (False, True):
        for turn in (False, True):
            x = empty.mT if turn else empty
            x = x.flip(1) if flip else x
            ends = torch.nn.functional.pad((x[:, :-1] & ~x[:, 1:]).long(), (0, 1))
            S = torch.nn.functional.pad(ends.cumsum(0).cumsum(1), (1, 0, 1, 0))
            rows, columns = x.shape[0] - side + 1, x.shape[1] - side + 1
            last, first = S[:, side : side + columns], S[:, side - room : side - room + columns]
            found = (last - first)[side:] - (last - first)[:rows]
            found[:, -1] = 0  # nothing lies beyond
            found = found.flip(1) if flip else found
            total += found.mT if turn else found
    return total


def _sides(index: Tensor, held: Tensor, y: int, x: int, side: int) -> Int[Tensor, "side side"]:
    """Return what each texel of a window is held to: what is next to filled texels outside stays as it is."""
    there = index >= 0
    around = torch.nn.functional.pad(there, (1, 1, 1, 1))[y : y + side + 2, x : x + side + 2].clone()
    around[1:-1, 1:-1] = False
    beside = around[:-2, 1:-1] | around[2:, 1:-1] | around[1:-1, :-2] | around[1:-1, 2:]
    inside = there[y : y + side, x : x + side]
    stays = held[y : y + side, x : x + side] | beside
    return torch.where(inside, torch.where(stays, OLD, FREE), NEW)
