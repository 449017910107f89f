"""Portable float maps (.pfm): linear values as 32-bit floats, one or three channels.

"PF" or "Pf", width and height, a scale whose sign tells the byte order (negative: the lowest byte first), then rows
from the bottom up. The size of the scale is a unit that programs do not agree on; it is not applied. Format as
described with the Netpbm and PBRT tools.

Test: tests/data/test_pfm.py
"""

import re
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from torchmeso.data import store
from torchmeso.errors import FormatError

HEADER = re.compile(rb"(P[Ff])\s+(\d{1,6})\s+(\d{1,6})\s+([+-]?[\d.]+(?:[eE][+-]?\d+)?)[ \t]*\r?\n")


def read(path: str | Path) -> Float32[np.ndarray, "H W 3"]:
    """Return the picture, row 0 on top; one channel becomes three.

    Raises:
        FormatError: the file is missing, damaged, or of another kind.
    """
    if not Path(path).is_file():
        raise FormatError(f"{path}: expected a picture, found none; check the path")
    with store.reading(path):
        return decode(Path(path).read_bytes(), str(path))


def decode(data: bytes, name: str) -> Float32[np.ndarray, "H W 3"]:
    """Return the picture that the content of a file holds, row 0 on top.

    Raises:
        FormatError: the content is damaged, or of another kind.
    """
    header = HEADER.match(data[:200])
    if header is None or not float(header[4]):
        raise FormatError(f"{name}: expected a portable float map ('PF', its size and a scale), got something else")
    width, height, channels = int(header[2]), int(header[3]), 3 if header[1] == b"PF" else 1
    needed = 4 * width * height * channels
    if not needed or len(data) - header.end() < needed:
        raise FormatError(
            f"{name}: expected {needed} bytes for {width} x {height} pixels, got {len(data) - header.end()}; "
            "the copy may be incomplete"
        )
    order = "<f4" if float(header[4]) < 0 else ">f4"
    rows = np.frombuffer(data, order, needed // 4, header.end()).reshape(height, width, channels)
    return np.ascontiguousarray(np.broadcast_to(rows[::-1], (height, width, 3)), dtype=np.float32)
