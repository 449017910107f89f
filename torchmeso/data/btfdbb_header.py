"""The header of Bonn's `.btf` files: signature, what was measured and how, directions, size, rotations.

Little endian. After the signature come, counted by `struct_size` from itself on: u32 struct_size, u32 version, three
texts of 80 bytes (measurement setup, image sensor, light source), f32 pixels per mm, 3 f32 scale of RGB; from version
2 on u32 cosine flag; from 3 on u32 length and that much XML; from 4 on u32 channels and their names, each after its
u32 length. Then u32 views, and for each one its theta and phi, u32 lights and their theta and phi (f32, radians);
u32 width and height; where the signature ends in R, u32 count and as many 3 x 3 rotations.

Test: tests/data/test_btfdbb_header.py
"""

import math
import struct
from dataclasses import dataclass, field

import numpy as np

from torchmeso.errors import FormatError

SIGNATURES = (
    b"!DFMF08FCR", b"!DFMF08FC", b"!FMF12FCER", b"!FMF12FCE", b"!FMF06FCR", b"!FMF06FC", b"!PVF06FCR", b"!PVF06FC",
    b"!BDIF06R2!",
)  # fmt: skip
"""Known signatures; of two that fit the longer one is meant."""

MOST_CHANNELS = 4096
"""Channels of a file; a damaged count would be read for a long time."""

TEXT_BYTES = 80
"""Of each of the three texts."""


class Cursor:
    """A place in the bytes of a file: what is read advances it, never past the end, and nothing is copied."""

    def __init__(self, path: str, data: np.ndarray, at: int = 0):
        """Start at byte `at` of `data`, (n) uint8; `path` is for errors."""
        self.path, self.data, self.at = path, data, at

    def array(self, what: str, dtype: str, *shape: int) -> np.ndarray:
        """Return the next values, as a view that may lie askew in memory.

        Raises:
            FormatError: the file ends before.
        """
        n_bytes = math.prod(shape) * np.dtype(dtype).itemsize
        if n_bytes > len(self.data) - self.at:
            raise FormatError(
                f"{self.path}: expected {n_bytes} bytes of {what} at byte {self.at}, "
                f"the file ends after {len(self.data)}; the copy may be incomplete"
            )
        found = self.data[self.at : self.at + n_bytes].view(dtype).reshape(shape)
        self.at += n_bytes
        return found

    def u8(self, what: str) -> int:
        """Return the next byte."""
        return int(self.array(what, "u1", 1)[0])

    def u32(self, what: str) -> int:
        """Return the next whole number."""
        return int(self.array(what, "<u4", 1)[0])

    def floats(self, what: str, n: int) -> tuple[float, ...]:
        """Return the next `n` float32 values."""
        return tuple(map(float, self.array(what, "<f4", n)))

    def text(self, what: str, n_bytes: int) -> str:
        """Return the next text, cut at its first zero byte."""
        raw = self.array(what, "u1", n_bytes).tobytes()
        return raw.split(b"\0", 1)[0].decode("utf-8", errors="replace")


def _none() -> np.ndarray:
    return np.zeros((0, 3, 3), np.float32)


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Header:
    """What a file says about its measurement.

    Attributes:
        signature: which layout follows.
        version: of the header, 1 to 4.
        setup: measurement setup, image sensor, light source.
        ppmm: pixels per millimetre; 0 = unknown.
        rgb_scale: scale of RGB, as told; values are not multiplied by it.
        cosine: whether values hold the factor cos(theta_i); None where the version is too old to tell.
        xml: further notes.
        channels: names.
        views: (view, 2) theta and phi in radians, as listed.
        lights: (light, 2), the same for all views.
        width: texels.
        height: texels.
        rotations: (n, 3, 3), not applied.
    """

    signature: str
    version: int = 4
    setup: tuple[str, str, str] = ("", "", "")
    ppmm: float = 0.0
    rgb_scale: tuple[float, ...] = (1.0, 1.0, 1.0)
    cosine: bool | None = True
    xml: str = ""
    channels: tuple[str, ...] = ("R", "G", "B")
    views: np.ndarray
    lights: np.ndarray
    width: int
    height: int
    rotations: np.ndarray = field(default_factory=_none)

    @property
    def pairs(self) -> int:
        """Pairs of light and view."""
        return len(self.views) * len(self.lights)

    @property
    def texels(self) -> int:
        """Number of texels."""
        return self.width * self.height


def read(cursor: Cursor) -> Header:
    """Return the header; the cursor then stands where the layout of the signature begins.

    Raises:
        FormatError: no known signature, sizes that do not agree, or the file ends before.
    """
    path, start = cursor.path, cursor.data[:10].tobytes()
    signature = next((s for s in SIGNATURES if start.startswith(s)), None)
    if signature is None:
        raise FormatError(
            f"{path}: expected a Bonn BTF (!DFMF08FCR, !FMF12FCER, !FMF06FC, !PVF06FC, !BDIF06R2!), got {start!r}; "
            "the copy may be incomplete"
        )
    cursor.at = begin = len(signature)
    size, version = cursor.u32("struct size"), cursor.u32("version")
    texts = [cursor.text(what, TEXT_BYTES) for what in ("measurement setup", "image sensor", "light source")]
    (ppmm,) = cursor.floats("pixels per mm", 1)
    rgb_scale = cursor.floats("RGB scale", 3)
    cosine = bool(cursor.u32("cosine flag")) if version > 1 else None
    xml = cursor.text("XML", cursor.u32("length of XML")) if version > 2 else ""
    channels = _channels(cursor) if version > 3 else ("R", "G", "B")
    if size != cursor.at - begin:
        raise FormatError(
            f"{path}: header says it has {size} bytes, version {version} takes {cursor.at - begin}; "
            "the copy may be incomplete"
        )
    views, lights = _directions(cursor)
    width, height = cursor.u32("width"), cursor.u32("height")
    if width < 1 or height < 1:
        raise FormatError(f"{path}: expected at least one texel, got {width} x {height}; the copy may be incomplete")
    return Header(
        signature=signature.decode(),
        version=version,
        setup=(texts[0], texts[1], texts[2]),
        ppmm=ppmm,
        rgb_scale=rgb_scale,
        cosine=cosine,
        xml=xml,
        channels=channels,
        views=views,
        lights=lights,
        width=width,
        height=height,
        rotations=read_rotations(cursor) if signature.endswith(b"R") else _none(),
    )


def read_rotations(cursor: Cursor) -> np.ndarray:
    """Return (n, 3, 3) rotations after their number."""
    return cursor.array("rotations", "<f4", cursor.u32("number of rotations"), 3, 3)


def _channels(cursor: Cursor) -> tuple[str, ...]:
    count = cursor.u32("number of channels")
    if not 1 <= count <= MOST_CHANNELS:
        raise FormatError(
            f"{cursor.path}: expected 1 to {MOST_CHANNELS} channels, got {count}; the copy may be incomplete"
        )
    return tuple(cursor.text("name of a channel", cursor.u32("length of a name")) for _ in range(count))


def _directions(cursor: Cursor) -> tuple[np.ndarray, np.ndarray]:
    """Return (view, 2) and (light, 2) angles; every view lists all lights again."""
    n_view = cursor.u32("number of views")
    ahead = Cursor(cursor.path, cursor.data, cursor.at)
    ahead.floats("direction of a view", 2)
    n_light = ahead.u32("number of lights")
    if n_view < 1 or n_light < 1:
        raise FormatError(
            f"{cursor.path}: expected at least one view and light, got {n_view} and {n_light}; "
            "the copy may be incomplete"
        )
    records = cursor.array("directions", "u1", n_view, 12 + 8 * n_light)
    views = np.ascontiguousarray(records[:, :8]).view("<f4")
    counts = np.ascontiguousarray(records[:, 8:12]).view("<u4")[:, 0]
    lights = records[:, 12:]
    if (counts != n_light).any() or (lights != lights[0]).any():
        raise FormatError(
            f"{cursor.path}: expected the same lights for every view, got other ones; such files are not read"
        )
    return views, np.ascontiguousarray(lights[0]).view("<f4").reshape(n_light, 2)


def to_bytes(header: Header) -> bytes:
    """Return a file's beginning, always as version 4: signature, header, directions, size, and rotations after an R."""
    texts = b"".join(text.encode()[: TEXT_BYTES - 1].ljust(TEXT_BYTES, b"\0") for text in header.setup)
    told = texts + struct.pack("<4f", header.ppmm, *header.rgb_scale)
    told += struct.pack("<I", header.cosine is not False) + _with_length(header.xml)
    told += struct.pack("<I", len(header.channels)) + b"".join(map(_with_length, header.channels))
    lights = struct.pack("<I", len(header.lights)) + header.lights.astype("<f4").tobytes()
    directions = b"".join(view.astype("<f4").tobytes() + lights for view in header.views)
    rest = struct.pack("<I", len(header.views)) + directions + struct.pack("<II", header.width, header.height)
    if header.signature.endswith("R"):
        rest += rotations_to_bytes(header)
    return header.signature.encode() + struct.pack("<II", len(told) + 8, 4) + told + rest


def rotations_to_bytes(header: Header) -> bytes:
    """Return the number of rotations and the rotations."""
    return struct.pack("<I", len(header.rotations)) + header.rotations.astype("<f4").tobytes()


def _with_length(text: str) -> bytes:
    raw = text.encode()
    return struct.pack("<I", len(raw)) + raw
