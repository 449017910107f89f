"""One pixel's sequence, sample by sample in float64: when the laser or the shadow passed."""

import math


def peak_time(values, threshold):
    """Return the time of the brightest sample below a frame, or None where it was not lit once."""
    best = max(values)
    at = values.index(best)
    width = 1
    while at + width < len(values) and values[at + width] == best:
        width += 1
    passes = sum(v >= threshold and (i == 0 or values[i - 1] < threshold) for i, v in enumerate(values))
    if best < threshold or at == 0 or at + width >= len(values) or passes != 1:
        return None
    if width > 1:
        return at + (width - 1) / 2
    low = 1e-3 * best
    a, b, c = (math.log(max(values[at + d], low)) for d in (-1, 0, 1))
    return at + min(max(0.5 * (a - c) / (a - 2 * b + c), -0.5), 0.5)


def fall_time(values, contrast):
    """Return the first fall through the middle of the range, or None."""
    middle = 0.5 * (min(values) + max(values))
    if max(values) - min(values) < contrast:
        return None
    for i in range(1, len(values)):
        a, b = values[i - 1] - middle, values[i] - middle
        if a >= 0 > b:
            return i - 1 + a / (a - b)
    return None
