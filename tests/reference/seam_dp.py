"""Slow twin of torchmeso/synthesize/seam_dp.py: every path there is, one after the other."""

from itertools import product


def paths(n, across, at=None):
    """Yield every path of `n` steps over `across` places, straight or one to either side; from `at` where given."""
    for first in range(across) if at is None else [at]:
        for turns in product((-1, 0, 1), repeat=n - 1):
            path = [first]
            for turn in turns:
                path.append(path[-1] + turn)
            if all(0 <= x < across for x in path):
                yield path


def straight(e):
    """Return the least cost of a path from the first row of `e` to the last."""
    return min(sum(int(e[y, x]) for y, x in enumerate(path)) for path in paths(*e.shape))


def corner(e, left, top):
    """Return the least cost of a path up from the bottom to a texel of the diagonal, and on to the right."""
    height, width = e.shape
    costs = []
    for k in range(min(left, top)):
        down = min(sum(int(e[k + i, x]) for i, x in enumerate(path)) for path in paths(height - k, left, k))
        across = min(sum(int(e[y, k + i]) for i, y in enumerate(path)) for path in paths(width - k, top, k))
        costs.append(down + across - int(e[k, k]))
    return min(costs)
