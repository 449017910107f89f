"""One pixel's weighted mean without outliers, value by value in float64."""


def merged(values, weights, tolerance):
    """Return the mean of (value, weight) pairs near their weighted median, or None without any."""
    pairs = sorted((v, w) for v, w in zip(values, weights, strict=True) if v is not None and w > 0)
    if not pairs:
        return None
    half, total = sum(w for _, w in pairs) / 2, 0.0
    for middle, w in pairs:  # noqa: B007
        total += w
        if total >= half:
            break
    near = [(v, w) for v, w in pairs if abs(v - middle) <= tolerance]
    return sum(v * w for v, w in near) / sum(w for _, w in near)
