"""Bonn's `.btf` files put together byte by byte from the description of the format, not by the package's writer."""

import bz2
import struct

import numpy as np

VIEWS = [(0.0, 0.0)] + [(30.0, 120.0 * j) for j in range(3)]
LIGHTS = [(20.0, 10.0 + 180.0 * j) for j in range(2)] + [(60.0, 90.0 * j) for j in range(4)]
WIDTH, HEIGHT = 5, 3
PAIRS, TEXELS = len(LIGHTS) * len(VIEWS), WIDTH * HEIGHT
"""24 pairs and 15 texels: neither can be taken for the other."""

UNCHANGED = ((1, 0, 0), (0, 1, 0), (0, 0, 1))

CODES = {2: "e", 4: "f", 8: "d"}


def numbers(values, size=4):
    """Return values, flattened rows first, as scalars of `size` bytes."""
    flat = np.asarray(values, np.float64).ravel().tolist()
    return struct.pack(f"<{len(flat)}{CODES[size]}", *flat)


def named(text):
    return struct.pack("<I", len(text)) + text.encode()


def header(
    signature, version=4, cosine=1, channels=("R", "G", "B"), views=None, lights=None, width=WIDTH, height=HEIGHT
):
    views, lights = VIEWS if views is None else views, LIGHTS if lights is None else lights
    texts = b"".join(text.encode().ljust(80, b"\0") for text in ("dome", "camera", "lamp"))
    told = struct.pack("<I", version) + texts + struct.pack("<f", 12.5) + struct.pack("<fff", 1.0, 2.0, 3.0)
    if version > 1:
        told += struct.pack("<I", cosine)
    if version > 2:
        told += named("<xml/>")
    if version > 3:
        told += struct.pack("<I", len(channels)) + b"".join(map(named, channels))
    told = struct.pack("<I", len(told) + 4) + told + struct.pack("<I", len(views))
    for view in views:
        told += struct.pack("<ff", *np.radians(view)) + struct.pack("<I", len(lights))
        for light in lights:
            told += struct.pack("<ff", *np.radians(light))
    told += struct.pack("<II", width, height)
    if signature.endswith("R"):
        told += struct.pack("<I", 2) + numbers(np.stack([np.eye(3), 2 * np.eye(3)]))
    return signature.encode() + told


def factors(values, size, k=None):
    """Return a factorisation of (rows, columns) values, exact where `k` is none."""
    U, S, V = np.linalg.svd(np.asarray(values, np.float64), full_matrices=False)
    U, S, V = U[:, :k], S[:k], V[:k]
    rows, columns = values.shape
    sizes = struct.pack("<III", len(S), rows, columns)
    return bytes([size]) + sizes + numbers(S, size) + numbers(U, size) + numbers((S[:, None] * V).T, size)


def dfmf(values, *, model=0, mean=(0, 0, 0), transform=UNCHANGED, size=8, transposed=False, k=None, **about):
    """Return a file of (pair, texel, channel) numbers: pair = light + lights * view, texels from the bottom row up."""
    n_channel = values.shape[-1]
    about.setdefault("channels", ("a", "b", "c")[:n_channel])
    body = struct.pack("<Ii", 99, model) + numbers(mean) + numbers(transform)
    for c in range(n_channel):
        matrix = values[..., c].T if transposed else values[..., c]
        body += factors(matrix, size, k)
    return header(about.pop("signature", "!DFMF08FCR"), **about) + body


def fmf(values, *, signature="!FMF06FCR", size=8, extended=b"", **about):
    rows = values.transpose(0, 2, 1).reshape(-1, values.shape[1])  # channel + 3 * pair
    return header(signature, **about) + extended + struct.pack("<I", 99) + factors(rows, size)


def pvf(values, *, signature="!PVF06FC", size=8, legacy=False, pictures=True, **about):
    n_view = len(about.get("views", VIEWS))
    n_light = len(values) // n_view
    body = struct.pack("<I", 301074) if legacy else b""
    body += struct.pack("<II", 99, n_view)
    for view in range(n_view):
        part = values[view * n_light : (view + 1) * n_light]  # light, texel, channel
        samples = part.reshape(n_light, -1) if pictures else part.transpose(1, 0, 2).reshape(part.shape[1], -1)
        mean = samples.mean(0)
        U, S, V = np.linalg.svd(samples - mean, full_matrices=False)
        body += bytes([size]) + struct.pack("<III", len(S), *samples.shape)
        body += numbers(S, size) + numbers(mean, size) + numbers(V.T, size) + numbers(U * S, size)
    return header(signature, **about) + body


def bdi(values, *, compression=0, rows=2, mask=None, **about):
    n_texel = values.shape[1]
    mask = np.ones(n_texel, bool) if mask is None else mask
    body = struct.pack("<IB", rows, compression) + bytes(mask.tolist()) + struct.pack("<I", 1) + numbers(np.eye(3))
    texels = values.transpose(1, 0, 2).reshape(n_texel, -1)
    step = rows * about.get("width", WIDTH)
    for start in range(0, n_texel, step):
        part, kept = texels[start : start + step], mask[start : start + step]
        raw = numbers(part[kept] if compression == 2 else part, 2)
        raw = bz2.compress(raw) if compression == 1 else raw
        body += struct.pack("<I", len(raw)) + raw
    return header("!BDIF06R2!", **about) + body


def random_values(low=0.01, high=40.0, seed=0, n_channel=3):
    """Return (pair, texel, channel) values over three decades, highlights above 1 among them."""
    random = np.random.default_rng(seed)
    return np.exp(random.uniform(np.log(low), np.log(high), (PAIRS, TEXELS, n_channel)))


def as_table(values):
    """Return what a file of (pair, texel, channel) values means: (light, view, H, W, 3), row 0 on top."""
    table = values.reshape(len(VIEWS), len(LIGHTS), HEIGHT, WIDTH, 3)
    return np.flip(table, 2).transpose(1, 0, 2, 3, 4).copy()


KINDS = {
    "dfmf": lambda v: dfmf(v),
    "dfmf of halves": lambda v: dfmf(v, size=2),
    "dfmf in model 11": lambda v: dfmf(np.log(v) / 9, model=11, size=4),
    "dfmf transposed": lambda v: dfmf(v, transposed=True, version=1),
    "fmf": lambda v: fmf(v),
    "fmf extended": lambda v: fmf(
        np.log(v), signature="!FMF12FCER", extended=struct.pack("<BIIIee", 2, 1, 2, 1, 0.5, 0.25)
    ),
    "pvf": lambda v: pvf(v, signature="!PVF06FCR"),
    "pvf legacy": lambda v: pvf(v, legacy=True, pictures=False),
    "bdi": lambda v: bdi(v),
    "bdi bzip": lambda v: bdi(v, compression=1),
    "bdi sparse": lambda v: bdi(v, compression=2, mask=np.arange(TEXELS) % 4 > 0),
}
"""One file of every layout, of (pair, texel, channel) values."""
