"""One frame's peaks and least-squares line, pixel by pixel in float64: slow and plain."""

import math


def smooth(frame, sigma):
    """Return the frame (list of rows) smoothed, the border repeated."""
    radius = math.ceil(4 * sigma)
    kernel = [math.exp(-0.5 * (x / sigma) ** 2) for x in range(-radius, radius + 1)]
    kernel = [k / sum(kernel) for k in kernel]
    height, width = len(frame), len(frame[0])

    def at(n, i):
        return min(max(i, 0), n - 1)

    down = [
        [sum(k * frame[at(height, y + d - radius)][x] for d, k in enumerate(kernel)) for x in range(width)]
        for y in range(height)
    ]
    return [
        [sum(k * down[y][at(width, x + d - radius)] for d, k in enumerate(kernel)) for x in range(width)]
        for y in range(height)
    ]


def column_peaks(frame, region, sigma, threshold):
    """Return (x, y) of the Gaussian peak of every column that has one."""
    found, image = [], smooth(frame, sigma)
    for x in range(len(image[0])):
        rows = [y for y in range(len(image)) if region[y][x]]
        if not rows:
            continue
        y = max(rows, key=lambda row: image[row][x])
        if image[y][x] < threshold or not 0 < y < len(image) - 1:
            continue
        low = 1e-3 * image[y][x]
        a, b, c = (math.log(max(image[y + d][x], low)) for d in (-1, 0, 1))
        found.append((x + 0.5, y + 0.5 + 0.5 * (a - c) / (a - 2 * b + c)))
    return found
