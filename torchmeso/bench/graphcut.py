"""Cuts of the suite `synthesize`: shortest paths and flows beside OR-tools' maximum flow.

Costs are those of smooth noise of 24 channels, as overlaps of patches have. OR-tools (extra `peers`) is given its arcs
as arrays that are ready: what is timed of it is taking them and solving.

Test: tests/bench/test_graphcut.py
"""

from collections.abc import Callable, Iterator
from functools import partial
from importlib import import_module

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from torchmeso.bench.suite import Context, Row
from torchmeso.bench.timing import time_together
from torchmeso.synthesize.patch_error import one_thread
from torchmeso.synthesize.seam_graphcut import ABSENT, FREE, NEW, OLD, Cut, cut, differences

CHANNELS = 24
"""Of a patch's codes."""

BATCH = 8
"""Candidates that are cut at once."""

Arcs = tuple[np.ndarray, np.ndarray, np.ndarray]


def overlap(size: int, batch: int, *, seed: int = 0) -> Int[Tensor, "B size size"]:
    """Return e between smooth noise and smooth noise."""
    rng = torch.Generator().manual_seed(seed)
    a, b = (_smooth(batch, size, rng) for _ in range(2))
    return differences(a, b)


def _smooth(batch: int, size: int, rng: torch.Generator) -> Int[Tensor, "B size size C"]:
    x = torch.randn(batch * CHANNELS, 1, size, size, generator=rng)
    for _ in range(2):
        x = torch.nn.functional.avg_pool2d(torch.nn.functional.pad(x, (3, 3, 3, 3), mode="circular"), 7, 1)
    x = (x / x.std()).reshape(batch, CHANNELS, size, size).movedim(1, -1)
    return (2048 + 400 * x).round().clamp(0, 4095).long()


def strip(size: int) -> Int[Tensor, "size size"]:
    """Return sides: what is old on the left, what is new on the right."""
    side = torch.full((size, size), FREE)
    side[:, 0], side[:, -1] = OLD, NEW
    return side


def old_errors(e: Int[Tensor, "size size"], *, seed: int = 0) -> Int[Tensor, "size size"]:
    """Return errors of old seams: on one texel in twenty, about as large as new ones."""
    rng = torch.Generator().manual_seed(seed)
    at = torch.rand(e.shape, generator=rng) < 0.05
    return torch.where(at, (4 * e.double().mean() * torch.rand(e.shape, generator=rng)).long(), 0)


def arcs(e: Int[Tensor, "H W"], side: Int[Tensor, "H W"], errors: Int[Tensor, "H W"]) -> Arcs:
    """Return tails, heads and capacities of the graph; the source is node H W, the sink the next."""
    cost, held = e.numpy(), side.numpy()
    number = np.arange(cost.size).reshape(cost.shape)
    whole = int(2 * cost.sum() + errors.sum()) + 1
    tails, heads, rooms = [], [], []
    for one, other in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        there = (held[one] != ABSENT) & (held[other] != ABSENT)
        room = (cost[one] + cost[other])[there]
        for a, b in ((one, other), (other, one)):
            tails.append(number[a][there])
            heads.append(number[b][there])
            rooms.append(room)
    for kind, room in ((OLD, np.full(cost.shape, whole)), (NEW, np.full(cost.shape, whole)), (FREE, errors.numpy())):
        at = (held == kind) & (room > 0)
        end = np.full(int(at.sum()), cost.size + (kind != OLD))
        tails.append(end if kind == OLD else number[at])
        heads.append(number[at] if kind == OLD else end)
        rooms.append(room[at])
    return np.concatenate(tails), np.concatenate(heads), np.concatenate(rooms)


def by_ortools(e: Int[Tensor, "H W"], side: Int[Tensor, "H W"], errors: Int[Tensor, "H W"]) -> int:
    """Return the largest flow as OR-tools finds it."""
    return _solve(arcs(e, side, errors), e.numel())


def _solve(given: Arcs, texels: int) -> int:
    solver = import_module("ortools.graph.python.max_flow").SimpleMaxFlow()
    solver.add_arcs_with_capacity(*given)
    solver.solve(texels, texels + 1)
    return solver.optimal_flow()


def certificate(e: Int[Tensor, "H W"], side: Int[Tensor, "H W"], errors: Int[Tensor, "H W"], found: Cut) -> int:
    """Return what the first cut of a batch costs, edge by edge: that of the flow where both are best."""
    old, there = found.old[0], side != ABSENT
    total = int(errors[old & (side == FREE)].sum())
    for one, other in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        apart = (old[one] != old[other]) & there[one] & there[other]
        total += int((e[one] + e[other])[apart].sum())
    return total


def cuts(context: Context) -> Iterator[Row]:
    """Shortest paths of 64 and 256 texels, and a flow of 128 with old seams."""
    for name, size, kept, goal in (("path", 64, False, 5), ("path", 256, False, 5), ("flow", 128, True, 1)):
        yield from _rows(name, size, kept, goal, context)


def _rows(name: str, size: int, kept: bool, goal: float, context: Context) -> Iterator[Row]:
    e, side = overlap(size, BATCH), strip(size)
    errors = old_errors(e[0]) if kept else torch.zeros_like(side)
    what = f"cut of {size} x {size} texels" + ", old seams kept" * kept
    calls: dict[str, Callable[[], object]] = {
        "one": partial(cut, e[:1], side, errors=errors, backend="opencl"),
        "batch": partial(cut, e, side, errors=errors, backend="opencl"),
    }
    found = cut(e, side, errors=errors, backend="opencl")
    off = abs(certificate(e[0], side, errors, found) - int(found.cost[0])) / max(int(found.cost[0]), 1)
    yield Row(
        id=f"cut.{name}_{size}.certificate", what=f"{what}: difference of its cost, edge by edge, and the flow",
        value=off, unit="relative", better="lower", goal=1e-8,
    )  # fmt: skip
    try:
        import_module("ortools.graph.python.max_flow")
    except ImportError:
        why = "OR-tools is not installed: pip install 'torchmeso[peers]'"
        for figure in ("value", "vs_ortools", "batch_vs_ortools"):
            yield Row(id=f"cut.{name}_{size}.{figure}", what=what, value=None, unit="x", better="higher", why=why)
        return
    given = arcs(e[0], side, errors)
    peer = _solve(given, side.numel())
    yield Row(
        id=f"cut.{name}_{size}.value", what=f"{what}: difference of its cost and OR-tools'", unit="relative",
        value=abs(peer - int(found.cost[0])) / max(peer, 1), better="lower", goal=1e-8,
    )  # fmt: skip
    calls["ortools"] = partial(_solve, given, side.numel())
    with one_thread():  # as synthesis does
        timing = time_together(calls, n=9 if context.quick else 25, settle=1)
    for figure, call, count in (("vs_ortools", "one", 1), ("batch_vs_ortools", "batch", BATCH)):
        own, other = timing[call].cpu / count, timing["ortools"].cpu
        yield Row(
            id=f"cut.{name}_{size}.{figure}", value=round(other / own, 2), unit="x", better="higher", goal=goal,
            what=f"{what}, {'alone' if count == 1 else f'one of {count} at once'}, call and copies included: times as "
            "fast as OR-tools, CPU time", n=timing[call].n,
            peer=f"OR-tools {2 * other:.2f} ms, own {2 * own:.3f} ms of CPU time; wall {timing['ortools'].wall:.2f} "
            f"and {timing[call].wall / count:.3f} ms",
        )  # fmt: skip
