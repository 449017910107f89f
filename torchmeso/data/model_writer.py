"""Run-time models (.meso) written a part of a tensor at a time, for those that are larger than memory.

A safetensors file is a u64 length, a JSON header that names each tensor's type, shape and place, and the tensors.
Places follow from types and shapes, so the header is written first; wide types come first, which keeps all aligned.

Test: tests/data/test_model_writer.py
"""

import json
import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchmeso.data import store

DTYPES = {
    torch.float64: "F64", torch.float32: "F32", torch.int64: "I64", torch.int32: "I32", torch.float16: "F16",
    torch.int16: "I16", torch.uint8: "U8", torch.bool: "BOOL",
}  # fmt: skip

Layout = Mapping[str, tuple[torch.dtype, tuple[int, ...]]]
Write = Callable[[str, Tensor, int], None]
"""Called with a name, values, and where they begin along the tensor's first axis."""


@contextmanager
def in_parts(path: str | Path, layout: Layout, meta: dict[str, Any]) -> Iterator[Write]:
    """Yield a function that writes (part of) a tensor of the model `path`, which gets its name at the end.

    Args:
        path: of the model.
        layout: dtype and shape of each tensor; what is not written is zero.
        meta: as in `store.write_model`.

    Raises:
        StorageError: the disk is full, or the place cannot be written to.
    """
    header: dict[str, Any] = {"__metadata__": {"torchmeso": json.dumps({**meta, "format": store.FORMAT_VERSION})}}
    at = 0
    for name in sorted(layout, key=lambda name: -layout[name][0].itemsize):
        dtype, shape = layout[name]
        size = math.prod(shape) * dtype.itemsize
        header[name] = {"dtype": DTYPES[dtype], "shape": list(shape), "data_offsets": [at, at + size]}
        at += size
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    first = 8 + len(text)
    with store.replacing(path) as beside, beside.open("wb") as file:
        file.write(len(text).to_bytes(8, "little") + text)
        file.truncate(first + at)

        def write(name: str, values: Tensor, start: int = 0) -> None:
            dtype, shape = layout[name]
            assert values.dtype == dtype and values.shape[1:] == shape[1:], (name, values.shape, shape)
            assert start + len(values) <= shape[0]
            file.seek(first + header[name]["data_offsets"][0] + start * math.prod(shape[1:]) * dtype.itemsize)
            file.write(values.contiguous().numpy().data)

        yield write
