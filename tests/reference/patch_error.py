"""Slow twin of torchmeso/synthesize/patch_error.py: placement by placement, as eq. (2) is written."""

import torch


def errors(codes, target, mask, *, toroidal=False):
    """Return the squared error of every placement of a patch."""
    height, width = mask.shape
    rows, columns = codes.shape[:2]
    if not toroidal:
        rows, columns = rows - height + 1, columns - width + 1
    found = torch.zeros(rows, columns, dtype=codes.dtype)
    for y in range(rows):
        for x in range(columns):
            patch = codes.roll((-y, -x), (0, 1))[:height, :width]
            found[y, x] = (patch - target)[mask].square().sum()
    return found


def squared_distance(model, alpha, beta, a, b):
    """Return eq. (2) between texels `a` and `b` of an SH + PCA BTF, term by term."""
    W = model.decoded().double()
    total = torch.zeros((), dtype=torch.float64)
    for v in range(len(model.views)):
        for m in range(model.terms):
            for c in range(3):
                component = model.basis[:, m, c].double()
                p1, p2 = (component @ W[v, y, x] for y, x in (a, b))
                total += alpha[v] * beta[m] * (p1 - p2) ** 2
    return total
