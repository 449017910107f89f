"""Bonn's `.btf` files, written: DFMF from fitted factors, BDI from the values themselves.

Directions are listed in the order of their rings, values hold cos(theta_i) and the cosine flag says so, texel rows go
from the bottom up. Layouts: `data.btfdbb_header`, `data.btfdbb_body`, `data.btfdbb_bdi`.

Test: tests/data/test_btfdbb_write.py
"""

import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchmeso.data import btfdbb_bdi, btfdbb_header
from torchmeso.data.btf import Bands
from torchmeso.data.btfdbb_colour import Colour
from torchmeso.data.btfdbb_header import Header
from torchmeso.data.store import replacing
from torchmeso.errors import ShapeError, check_finite, check_memory, check_range, check_shape
from torchmeso.geometry.directions import to_angles
from torchmeso.geometry.hemisphere import DirectionSet

Storage = Literal["float16", "float32", "float64"]
Progress = Callable[[float], None]


def header_of(table: Bands, signature: str) -> Header:
    """Return the header that a table gets; rotations, image scale and names of devices are not known."""
    height, width = table.texels
    return Header(
        signature=signature,
        views=_angles(table.views),
        lights=_angles(table.lights),
        width=width,
        height=height,
    )


def write_dfmf(
    path: str | Path,
    header: Header,
    colour: Colour,
    factors: Sequence[tuple[Float[Tensor, "pair rank"], Float[Tensor, "texel rank"]]],
    *,
    storage: Storage = "float16",
) -> None:
    """Write factors of three decorrelated channels as `!DFMF08FCR`.

    Args:
        path: of the file.
        header: directions and size (`header_of`); its signature is written as it is.
        colour: what the channels stand for.
        factors: for each channel by pair (light + lights * view) and by texel (x + width * y, row 0 at the bottom),
            largest component first; value = their product.
        storage: of the factors; float16 is what readers by others know best.

    Raises:
        ShapeError: factors do not match the header, or a value does not fit `storage`.
        StorageError: the disk is full, or the place cannot be written to.
    """
    if len(factors) != len(header.channels):
        raise ShapeError(f"{path}: expected factors of {len(header.channels)} channels, got {len(factors)}")
    blocks = [_channel(header, k, *pair, storage) for k, pair in enumerate(factors)]
    most = max(by_pair.shape[1] for by_pair, _ in factors)
    head = struct.pack("<Ii", most, colour.model) + struct.pack("<12f", *colour.mean, *colour.transform)
    with replacing(path) as beside, beside.open("wb") as file:
        file.write(btfdbb_header.to_bytes(header) + head)
        for block in blocks:
            for part in block:
                file.write(part)


def _channel(header: Header, k: int, by_pair: Tensor, by_texel: Tensor, storage: Storage) -> tuple[bytes, ...]:
    """Return the parts of one channel; singular values are the norms of S V, U being orthonormal."""
    rank = by_pair.shape[-1]
    check_shape(f"btfdbb.factors[{k}] by pair", by_pair, (header.pairs, rank))
    check_shape(f"btfdbb.factors[{k}] by texel", by_texel, (header.texels, rank))
    parts = []
    for values in (by_texel.norm(dim=0), by_pair, by_texel):
        stored = values.to(getattr(torch, storage))
        check_finite(f"btfdbb.factors[{k}] as {storage}", stored)
        parts.append(stored.contiguous().numpy().tobytes())
    sizes = struct.pack("<BIII", np.dtype(storage).itemsize, rank, header.pairs, header.texels)
    return sizes, *parts


def write_bdi(
    path: str | Path,
    table: Bands,
    *,
    compression: Literal["full", "bzip", "sparse"] = "full",
    mask: Bool[Tensor, "H W"] | None = None,
    chunk_rows: int = 4,
    progress: Progress = lambda share: None,
) -> None:
    """Write all values of a table as halves (`!BDIF06R2!`), a chunk of texel rows at a time.

    Args:
        path: of the file.
        table: in memory or on disk; read from the bottom row up.
        compression: full, bzip, or sparse: texels outside the mask are left out and read as 0.
        mask: (H, W) texels that were measured, row 0 on top; none = all.
        chunk_rows: texel rows of a chunk, which are in memory at once.
        progress: called with the share done, 0..1.

    Raises:
        ConfigError: `chunk_rows` is below 1.
        ShapeError: a value is not finite, or beyond half (65,504); the mask has another size.
        SizeError: a chunk would be longer than the format can tell.
        StorageError: the disk is full, or the place cannot be written to.
    """
    height, width = table.texels
    header = header_of(table, "!BDIF06R2!")
    measured = torch.ones(height, width, dtype=torch.bool) if mask is None else mask
    check_shape("btfdbb.mask", measured, (height, width))
    bottom_up = measured.flip(0).flatten().numpy()
    check_range("btfdbb.chunk_rows", chunk_rows, 1, 2**31)
    longest = min(chunk_rows, height) * width * header.pairs * 3 * btfdbb_bdi.HALF_BYTES
    check_memory(f"{path}: a chunk", longest, btfdbb_bdi.MEMORY_LIMIT - 1, "take fewer rows to a chunk")
    number = btfdbb_bdi.COMPRESSIONS.index(compression)
    with replacing(path) as beside, beside.open("wb") as file:
        file.write(btfdbb_header.to_bytes(header) + struct.pack("<IB", chunk_rows, number))
        file.write(bottom_up.astype(np.uint8).tobytes() + btfdbb_header.rotations_to_bytes(header))
        for bottom in range(0, height, chunk_rows):
            top = min(bottom + chunk_rows, height)
            halves = _halves(table, height - top, height - bottom)
            chunk = btfdbb_bdi.pack(halves, bottom_up[bottom * width : top * width], number)
            file.write(struct.pack("<I", len(chunk)) + chunk)
            progress(top / height)


def _halves(table: Bands, start: int, stop: int) -> np.ndarray:
    """Return (texel, pair * 3) halves of texel rows start .. stop, from the bottom row up."""
    band = table.rows(start, stop).half()
    check_finite("btfdbb.values as float16", band)
    texels = band.flip(2).permute(2, 3, 1, 0, 4)  # row, column, view, light, channel
    return texels.reshape(-1, len(table.lights) * len(table.views) * 3).numpy()


def _angles(directions: DirectionSet) -> np.ndarray:
    """Return (n, 2) theta and phi >= 0 in radians, float32."""
    theta, phi = to_angles(directions.directions(torch.float64))
    return torch.stack([theta, phi % (2 * torch.pi)], -1).float().numpy()
