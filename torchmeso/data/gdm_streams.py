"""Parts of generalised displacement maps as streams of bytes, in run-time models.

A stream is LZMA over planes of bytes (`data.code_stream`): the first byte of all values, then the second. Rows of equal
values, repeated threads and all that is solid take next to nothing.

Test: tests/data/test_gdm_coded.py
"""

import math

import numpy as np
import torch
from jaxtyping import Float, Shaped, UInt8
from torch import Tensor

from torchmeso.data import code_stream, store
from torchmeso.errors import FormatError


def packed(x: Shaped[Tensor, "*batch"]) -> UInt8[Tensor, "size"]:
    """Return the stream of a tensor."""
    values = np.ascontiguousarray(x.contiguous().numpy()).reshape(-1)
    planes = values.view(np.uint8).reshape(-1, values.dtype.itemsize).T
    return torch.frombuffer(bytearray(code_stream.squeezed(planes.tobytes())), dtype=torch.uint8)


def read(model: store.Model, name: str, shape: tuple[int, ...], dtype: torch.dtype) -> Shaped[Tensor, "*batch"]:
    """Return the tensor of a stream of a model.

    Raises:
        FormatError: there is none of that name, it is damaged, or holds another number of values.
    """
    if min(shape, default=1) < 0:
        raise FormatError(f"{name}: expected sizes of 0 or more, got {shape}; the copy may be incomplete")
    width = torch.empty(0, dtype=dtype).element_size()
    data = code_stream.opened(model.read(name).numpy().tobytes(), width * math.prod(shape))
    planes = np.frombuffer(data, np.uint8).reshape(width, -1)
    values = torch.from_numpy(np.array(planes.T, order="C")).flatten()
    return values.view(dtype).reshape(shape)


def to_tensors(
    left: UInt8[Tensor, "Z H W rows bytes"], occupancy: Float[Tensor, "Z H W"], matter: Float[Tensor, "Z H W 10"]
) -> dict[str, Tensor]:
    """Return what every stored GDM has besides its distances; material in halves, channel by channel."""
    return {
        "gdm.left": packed(left.permute(3, 0, 1, 2, 4)),
        "gdm.occupancy": packed(occupancy.float()),
        "gdm.matter": packed(matter.half().movedim(-1, 0)),
    }


def from_model(
    model: store.Model, bits: tuple[int, int, int, int, int]
) -> tuple[UInt8[Tensor, "Z H W rows bytes"], Float[Tensor, "Z H W"], Float[Tensor, "Z H W 10"]]:
    """Return bits, of this shape, occupancy and material of a model.

    Raises:
        FormatError: a stream is missing, damaged or of another size.
    """
    layers, height, width, rows, count = bits
    left = read(model, "gdm.left", (rows, layers, height, width, count), torch.uint8).permute(1, 2, 3, 0, 4)
    occupancy = read(model, "gdm.occupancy", (layers, height, width), torch.float32)
    matter = read(model, "gdm.matter", (10, layers, height, width), torch.float16).movedim(0, -1)
    return left.contiguous(), occupancy, matter.float()
