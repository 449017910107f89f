"""What follows the header of Bonn's `.btf` files that are not factored: BDI, chunks of whole texels in halves.

u32 texel rows of a chunk, u8 compression, u8 mask of every texel, u32 rotations and as many 3 x 3 matrices, then the
chunks from the bottom row on, each after its u32 length. A texel is channel + 3 * (light + lights * view) halves.
Compression 0: whole texels one after the other. 1: the same through bzip2. 2 (sparse): texels whose mask is not 0
only; the others are 0. Sparse chunks and the order within a texel are taken to be so: no file by others was at hand.

Test: tests/data/test_btfdbb_bdi.py
"""

import bz2
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.data.btfdbb_header import Cursor, Header, read_rotations
from torchmeso.errors import FormatError, check_memory

FULL, BZIP, SPARSE = range(3)

COMPRESSIONS = ("full", "bzip", "sparse")
"""By their number in the file."""

HALF_BYTES = 2

MEMORY_LIMIT = 4 << 30
"""Bytes of a decoded chunk."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Chunks:
    """Chunks of texel rows, on disk.

    Attributes:
        path: for errors.
        chunks: bytes of each chunk as stored.
        compression: 0 full, 1 bzip, 2 sparse.
        step: texels of a chunk; the last one may hold fewer.
        pairs: pairs of light and view.
        mask: (texel) whether it was measured.
    """

    path: str
    chunks: tuple[np.ndarray, ...]
    compression: int
    step: int
    pairs: int
    mask: np.ndarray

    def values(self, pairs: slice, texels: slice) -> Float[Tensor, "pair texel 3"]:
        """Return linear RGB; pairs are light + lights * view and texels x + width * y, row 0 at the bottom.

        Raises:
            FormatError: a chunk is damaged.
        """
        wanted = range(len(self.mask))[texels]
        first = wanted.start // self.step
        held = [self._part(number, pairs, wanted) for number in range(first, (wanted.stop - 1) // self.step + 1)]
        return torch.cat(held).transpose(0, 1).float()

    def _part(self, number: int, pairs: slice, wanted: range) -> Tensor:
        """Return (texel, pair, 3) halves of those of a chunk's texels that are wanted."""
        start = number * self.step
        chunk = self._decoded(number).reshape(-1, self.pairs, 3)
        return torch.from_numpy(chunk[max(wanted.start - start, 0) : wanted.stop - start, pairs].copy())

    def _decoded(self, number: int) -> np.ndarray:
        """Return (texel, pair * 3) halves of a chunk."""
        mask = self.mask[number * self.step : (number + 1) * self.step]
        width = self.pairs * 3
        size = len(mask) * width * HALF_BYTES
        check_memory(f"{self.path}: chunk {number}", size, MEMORY_LIMIT, "write it in chunks of fewer rows")
        stored = self.chunks[number]
        if self.compression == BZIP:
            stored = np.frombuffer(self._unzipped(number, size), np.uint8)
        halves = stored.view("<f2").reshape(-1, width)
        if self.compression != SPARSE:
            return halves
        whole = np.zeros((len(mask), width), np.float16)
        whole[mask] = halves
        return whole

    def _unzipped(self, number: int, n_bytes: int) -> bytes:
        try:
            raw = bz2.BZ2Decompressor().decompress(self.chunks[number].tobytes(), max_length=n_bytes + 1)
        except OSError as error:
            raise FormatError(
                f"{self.path}: chunk {number} cannot be decompressed ({error}); the copy may be incomplete"
            ) from error
        if len(raw) != n_bytes:
            got = "more" if len(raw) > n_bytes else f"{len(raw)}"
            raise FormatError(
                f"{self.path}: chunk {number}: expected {n_bytes} bytes, got {got}; the copy may be incomplete"
            )
        return raw

    def facts(self) -> dict[str, object]:
        """Return what `info` tells of it."""
        return {
            "chunks": f"{len(self.chunks)}, {COMPRESSIONS[self.compression]}",
            "storage": "float16",
            "texels measured": f"{float(self.mask.mean()):.0%}",
        }


def read(cursor: Cursor, header: Header) -> tuple[Chunks, np.ndarray]:
    """Return the chunks, and the rotations that stand before them; no chunk is decoded yet.

    Raises:
        FormatError: an unknown compression, a chunk of the wrong length, or the file ends before.
    """
    rows = cursor.u32("texel rows of a chunk")
    compression = cursor.u8("compression")
    if rows < 1 or compression >= len(COMPRESSIONS) or len(header.channels) != 3:
        raise FormatError(
            f"{cursor.path}: expected chunks of at least one row, compression 0 to 2 and 3 channels, "
            f"got {rows}, {compression} and {len(header.channels)}; the copy may be incomplete"
        )
    mask = cursor.array("mask", "u1", header.texels) != 0
    rotations = read_rotations(cursor)
    step = min(rows, header.height) * header.width
    texel_bytes = header.pairs * 3 * HALF_BYTES
    chunks = []
    for start in range(0, header.texels, step):
        part = mask[start : start + step]
        length = cursor.u32("length of a chunk")
        expected = (int(part.sum()) if compression == SPARSE else len(part)) * texel_bytes
        if compression != BZIP and length != expected:
            raise FormatError(
                f"{cursor.path}: chunk {len(chunks)}: expected {expected} bytes, header says {length}; "
                "the copy may be incomplete"
            )
        chunks.append(cursor.array("a chunk", "u1", length))
    body = Chunks(
        path=cursor.path, chunks=tuple(chunks), compression=compression, step=step, pairs=header.pairs, mask=mask
    )
    return body, rotations


def pack(texels: np.ndarray, mask: np.ndarray, compression: int) -> bytes:
    """Return the bytes of a chunk of (texel, pair * 3) halves, for texels of this (texel) mask."""
    if compression == SPARSE:
        texels = texels[mask]
    raw = texels.astype("<f2").tobytes()
    return bz2.compress(raw) if compression == BZIP else raw
