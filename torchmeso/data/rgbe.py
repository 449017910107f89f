"""Radiance pictures (.hdr): a mantissa byte per channel and a common exponent, linear RGB.

A value is (m + 0.5) 2^(e - 136), and 0 where e = 0: mantissas are cut off when written, so the middle of the step is
the value without a bias. EXPOSURE lines are divided out. The resolution line says in which order pixels stand:
"-Y H +X W" is the usual one, rows from the top; where X comes first, scan lines are columns.
Source: the Radiance file formats (radsite.lbl.gov), "Picture file format". Runs as written before Radiance 2.0 and
XYZ colours are refused.

Test: tests/data/test_rgbe.py
"""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt8

from torchmeso.data import store
from torchmeso.errors import FormatError

MAX_HEADER = 1 << 16
"""Bytes within which a header must end."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Header:
    """What stands before the pixels.

    Attributes:
        order: signs and axes of the resolution line, slow axis first, e.g. "-Y+X".
        lines: scan lines.
        pixels: of a scan line.
        exposure: what values were multiplied by.
        end: bytes of the header.
    """

    order: str
    lines: int
    pixels: int
    exposure: float
    end: int


def read(path: str | Path) -> Float32[np.ndarray, "H W 3"]:
    """Return the picture as linear RGB, row 0 on top.

    Raises:
        FormatError: the file is missing, damaged, or of another kind.
    """
    if not Path(path).is_file():
        raise FormatError(f"{path}: expected a picture, found none; check the path")
    with store.reading(path):
        return decode(Path(path).read_bytes(), str(path))


def decode(data: bytes, name: str) -> Float32[np.ndarray, "H W 3"]:
    """Return the picture that the content of a file holds, as linear RGB, row 0 on top.

    Raises:
        FormatError: the content is damaged, or of another kind.
    """
    with store.reading(name):
        header = read_header(data, name)
        codes = _upright(_scan_lines(data, header, name), header.order)
    step = np.ldexp(1.0, np.arange(256) - 136) / header.exposure
    step[0] = 0
    # A byte's middle times a power of two is exact in float32; only an exposure makes it round.
    return (codes[..., :3] + np.float32(0.5)) * step.astype(np.float32)[codes[..., 3:]]


def read_header(data: bytes, name: str) -> Header:
    """Return what the header says.

    Raises:
        FormatError: it is none, or of a kind that cannot be read.
    """
    blank = data.find(b"\n\n", 0, MAX_HEADER)
    end = data.find(b"\n", blank + 2, blank + 200)
    if not data.startswith(b"#?") or blank < 0 or end < 0:
        raise FormatError(f"{name}: expected a Radiance picture ('#?RADIANCE'), got something else")
    text = data[:blank].decode("latin-1")
    kind = re.search(r"^FORMAT\s*=\s*(\S+)", text, re.MULTILINE)
    if kind and kind[1] != "32-bit_rle_rgbe":
        raise FormatError(f"{name}: expected the format 32-bit_rle_rgbe, got {kind[1]}; convert it to RGB")
    size = re.fullmatch(rb"([+-][XY]) (\d{1,7}) ([+-][XY]) (\d{1,7})\s*", data[blank + 2 : end])
    if not size or size[1][1:] == size[3][1:] or not int(size[2]) * int(size[4]):
        raise FormatError(f"{name}: expected a size such as '-Y 256 +X 256', got '{data[blank + 2 : end]!r:.60}'")
    exposure = 1.0
    for value in re.findall(r"^EXPOSURE\s*=\s*(\S+)", text, re.MULTILINE):
        exposure *= float(value)
    if not 1e-30 < exposure < 1e30:
        raise FormatError(f"{name}: expected a positive exposure, got {exposure:g}; the copy may be damaged")
    return Header(
        order=(size[1] + size[3]).decode(), lines=int(size[2]), pixels=int(size[4]), exposure=exposure, end=end + 1
    )


def _scan_lines(data: bytes, header: Header, name: str) -> UInt8[np.ndarray, "line pixel 4"]:
    n, lines, at = header.pixels, header.lines, header.end
    packed = 8 <= n <= 32767 and data[at : at + 4] == bytes((2, 2, n >> 8, n & 255))
    # What a line takes at least: runs of up to 127 in two bytes each.
    least = 4 + 8 * -(-n // 127) if packed else 4 * n
    if lines * least > len(data) - at:
        raise FormatError(
            f"{name}: expected at least {lines * least} bytes of pixels, got {len(data) - at}; "
            "the copy may be incomplete"
        )
    if not packed:
        flat = np.frombuffer(data, np.uint8, lines * n * 4, at).reshape(lines, n, 4)
        if (flat[..., :3] == 1).all(-1).any():
            raise FormatError(f"{name}: has runs of the kind before Radiance 2.0; write it anew with a recent program")
        return flat
    out = np.empty((lines, 4, n), np.uint8)
    for line in range(lines):
        if data[at : at + 4] != data[header.end : header.end + 4]:
            raise FormatError(f"{name}: expected scan line {line} at byte {at}, found none; the copy may be damaged")
        at = _unpack(data, at + 4, n, out[line])
    return out.transpose(0, 2, 1)


def _unpack(data: bytes, at: int, n: int, out: np.ndarray) -> int:
    """Fill `out` (4, n) with the four channels of a scan line; return where the next line begins."""
    for channel in range(4):
        codes = bytearray()
        while len(codes) < n:
            count = data[at]
            if count > 128:
                codes += data[at + 1 : at + 2] * (count - 128)
                at += 2
            else:
                codes += data[at + 1 : at + 1 + count]
                at += 1 + count
        out[channel] = np.frombuffer(codes, np.uint8)  # a run beyond the line fails here
    return at


def _upright(codes: np.ndarray, order: str) -> np.ndarray:
    """Return scan lines as rows from the top, x to the right."""
    for axis, direction in enumerate((order[:2], order[2:])):
        if direction in ("+Y", "-X"):
            codes = np.flip(codes, axis)
    return codes.transpose(1, 0, 2) if order[1] == "X" else codes
