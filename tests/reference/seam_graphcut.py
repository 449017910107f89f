"""Slow twin of torchmeso/synthesize/seam_graphcut.py: paths found one after the other, and every cut there is."""

from collections import deque
from itertools import product

from torchmeso.synthesize.seam_graphcut import ABSENT, FREE, NEW, OLD

BOUNDLESS = 1 << 60


def cost(e, side, errors, old):
    """Return what a cut costs, edge by edge; None where it takes a texel from the side that it is held to."""
    height, width = e.shape
    there = [(y, x) for y in range(height) for x in range(width) if side[y, x] != ABSENT]
    total = 0
    for y, x in there:
        if (side[y, x] == OLD and not old[y, x]) or (side[y, x] == NEW and old[y, x]):
            return None
        total += int(errors[y, x]) if side[y, x] == FREE and old[y, x] else 0
        for q in ((y, x + 1), (y + 1, x)):
            if q in there and bool(old[q]) != bool(old[y, x]):
                total += int(e[y, x]) + int(e[q])
    return total


def exhaustive(e, side, errors):
    """Return the least cost of any cut and the least set of old texels that costs so much."""
    free = (side == FREE).nonzero().tolist()
    best, least = None, None
    for choice in product((False, True), repeat=len(free)):
        old = (side == OLD).clone()
        for (y, x), kept in zip(free, choice, strict=True):
            old[y, x] = kept
        found = cost(e, side, errors, old)
        if best is None or (found, int(old.sum())) < (best, int(least.sum())):
            best, least = found, old
    return best, least


def flow(e, side, errors):
    """Return the largest flow and what has capacity left from the source, by shortest augmenting paths."""
    height, width = e.shape
    room = {}

    def join(a, b, forth, back):
        room.setdefault(a, {})[b] = forth
        room.setdefault(b, {})[a] = back

    for y in range(height):
        for x in range(width):
            kind = int(side[y, x])
            if kind in (OLD, NEW):
                join("source" if kind == OLD else (y, x), (y, x) if kind == OLD else "sink", BOUNDLESS, 0)
            elif kind == FREE and int(errors[y, x]):
                join((y, x), "sink", int(errors[y, x]), 0)
            for q in ((y, x + 1), (y + 1, x)):
                if q[0] < height and q[1] < width and ABSENT not in (kind, int(side[q])):
                    join((y, x), q, int(e[y, x]) + int(e[q]), int(e[y, x]) + int(e[q]))
    room.setdefault("source", {})
    total = 0
    while True:
        before, queue = {"source": None}, deque(["source"])
        while queue and "sink" not in before:
            a = queue.popleft()
            for b, left in room[a].items():
                if left > 0 and b not in before:
                    before[b] = a
                    queue.append(b)
        if "sink" not in before:
            return total, {p for p in before if p != "source"}
        path, b = [], "sink"
        while before[b] is not None:
            path.append((before[b], b))
            b = before[b]
        most = min(room[a][b] for a, b in path)
        for a, b in path:
            room[a][b] -= most
            room[b][a] += most
        total += most
