"""BTFs read in bands of whole texel rows, as fits need them: the next band is read while this one is worked on.

Pictures lie on disk one after the other, fits want all directions of a texel. The transposition is done by the chunks
of raw tables: `picture_set.to_table` decodes every picture once and cuts it into chunks of rows, and a band here is
whole rows of chunks, so that no chunk is decoded twice. Only where a row of chunks does not fit into `ROOM` twice over
is it read in parts, and then once for each of them. Two bands are in memory at a time, in the dtype they are stored in;
they become float32 a row at a time, or in the kernel.

Test: tests/data/test_bands.py
"""

import math
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from torchmeso.data.btf import Bands, Btf
from torchmeso.errors import check_memory

ROOM = 256 << 20
"""Memory of one band as it is stored."""

LIMIT = 4 << 30
"""Memory of one row of texels that is not tried."""


class Band(NamedTuple):
    """Rows of texels as they are stored.

    Attributes:
        rows: which.
        stored: (light, view, rows, W, 3) uint8 codes in sRGB, or floats; gone when the next band is asked for.
    """

    rows: slice
    stored: Shaped[Tensor, "light view rows W 3"]


def layout(btf: Bands, room: int | None = None) -> list[slice]:
    """Return the bands of `btf`: whole rows of chunks of about `room` bytes (`ROOM`), at least one row of texels.

    Raises:
        SizeError: a row of texels needs more than `LIMIT`.
    """
    height, width = btf.texels
    itemsize, grain = 4, 1
    if isinstance(btf, Btf) and not isinstance(btf.images, Tensor):
        itemsize, grain = btf.images.dtype.itemsize, btf.images.chunks[2]
    row_bytes = math.prod((len(btf.lights), len(btf.views), width, 3, itemsize))
    check_memory("btf: a row of texels", float(row_bytes), LIMIT, "the copy may be damaged")
    fitting = (ROOM if room is None else room) // row_bytes
    step = fitting // grain * grain or (grain if grain <= 2 * fitting else max(1, fitting))
    return [slice(start, min(start + step, height)) for start in range(0, height, step)]


def ahead(btf: Bands, bands: Sequence[slice]) -> Iterator[Band]:
    """Yield `bands` of `btf` in order, reading one ahead; what goes wrong there is raised here.

    Raises:
        FormatError: the file on disk is damaged.
    """
    room = _rooms(btf, bands)
    pool = ThreadPoolExecutor(1)
    try:
        waiting = [pool.submit(_read, btf, rows, room[0]) for rows in bands[:1]]
        for at, rows in enumerate(bands):
            stored = waiting.pop().result()
            if at + 1 < len(bands):
                waiting.append(pool.submit(_read, btf, bands[at + 1], room[(at + 1) % 2]))
            yield Band(rows, stored)
            del stored
    finally:
        pool.shutdown(cancel_futures=True)


def each_row(btf: Bands, band: Band) -> Iterator[Float[Tensor, "light view W 3"]]:
    """Yield T of each row of texels of a band as float32.

    Raises:
        ShapeError: a value is not finite, or too large.
    """
    return (linear_row(btf, band, row) for row in range(band.stored.shape[2]))


def linear_row(btf: Bands, band: Band, row: int) -> Float[Tensor, "light view W 3"]:
    """Return T of row 0, 1, ... of a band as float32.

    Raises:
        ShapeError: a value is not finite, or too large.
    """
    stored = band.stored[:, :, row : row + 1]
    linear = btf.linear(stored, band.rows.start + row) if isinstance(btf, Btf) else stored
    return linear[:, :, 0]


def _rooms(btf: Bands, bands: Sequence[slice]) -> list[np.ndarray | None]:
    """Return two places to read bands to; on borders of 64 bytes, so that kernels take them as they are."""
    if not isinstance(btf, Btf) or isinstance(btf.images, Tensor) or not bands:
        return [None, None]
    rows = max(band.stop - band.start for band in bands)
    size = math.prod((len(btf.lights), len(btf.views), rows, btf.texels[1], 3)) * btf.images.dtype.itemsize
    return [torch.empty(size, dtype=torch.uint8).numpy() for _ in range(min(2, len(bands)))] * 2


def _read(btf: Bands, rows: slice, room: np.ndarray | None) -> Tensor:
    if isinstance(btf, Btf):
        return btf.stored_rows(rows.start, rows.stop, room)
    return btf.rows(rows.start, rows.stop)
