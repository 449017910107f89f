"""Pictures on disk: PNG, JPEG, TIFF (sRGB), OpenEXR, Radiance, PFM (linear), as linear RGB tensors, row 0 on top.

Test: tests/data/test_image.py
"""

import io
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from torchmeso.data import pfm, rgbe, store
from torchmeso.data.store import replacing
from torchmeso.errors import FormatError, StorageError

PIXELS_PER_BYTE = 8 * 1032
"""Of a black-and-white PNG of one colour: deflate packs 1032 bytes into one at most; JPEG stays far below."""

EXR_PIXELS_PER_BYTE = 1032
"""Of an OpenEXR picture of one colour in two bytes or more."""


def read(path: str | Path | bytes) -> Float[Tensor, "H W 3"]:
    """Return a colour picture as linear RGB; PNG, JPEG and TIFF are taken as sRGB, EXR, .hdr and PFM as linear.

    Args:
        path: of the file; or the content of a PNG or JPEG file.

    Raises:
        FormatError: the file is missing or unreadable.
    """
    if not isinstance(path, bytes) and Path(path).suffix.lower() == ".exr":
        return _read_exr(Path(path))
    if not isinstance(path, bytes) and Path(path).suffix.lower() == ".hdr":
        return torch.from_numpy(rgbe.read(path))
    if not isinstance(path, bytes) and Path(path).suffix.lower() == ".pfm":
        return torch.from_numpy(pfm.read(path))
    return decode_codes(torch.from_numpy(_read_pillow(path, colour=True)))


def read_codes(data: bytes, name: str) -> UInt8[Tensor, "H W 3"]:
    """Return the sRGB codes of a PNG, JPEG or TIFF file, given its content.

    Nothing is decoded before its size is checked; 16 bits are rounded to 8.

    Raises:
        FormatError: the content is damaged, far too short for the picture it announces, or no whole numbers.
    """
    from PIL import Image

    with store.reading(name), Image.open(io.BytesIO(data), formats=("JPEG", "PNG", "TIFF")) as picture:
        _check_announced(picture, name, len(data))
        return torch.from_numpy(_codes(picture, name))


def _check_announced(picture: Any, name: object, n_bytes: int) -> None:
    width, height = picture.size
    if width * height > PIXELS_PER_BYTE * n_bytes:
        raise FormatError(
            f"{name}: announces {width} x {height} pixels, too many for {n_bytes} bytes; the copy may be damaged"
        )


def _codes(picture: Any, name: object) -> np.ndarray:
    """Return (H, W, 3) uint8. Pillow itself cuts one channel of 16 bits off at 255."""
    if picture.mode == "F":
        raise FormatError(f"{name}: expected whole numbers of 8 or 16 bits, got floats; save such pictures as EXR")
    if picture.mode.startswith("I"):
        grey = np.asarray(picture).clip(0, 65535) / 257
        return np.repeat((grey + 0.5).astype(np.uint8)[..., None], 3, axis=-1)
    return np.array(picture.convert("RGB"))


def read_data(path: str | Path) -> Float[Tensor, "H W"]:
    """Return a one-channel picture that holds data, not colour (a height, a mask), in [0, 1] as stored.

    Raises:
        FormatError: the file is missing or unreadable.
    """
    if Path(path).suffix.lower() == ".exr":
        return _read_exr(Path(path))[..., 0]
    grey = _read_pillow(path, colour=False)
    if grey.ndim == 3:
        grey = grey[..., 0]
    whole = {np.dtype(np.uint16): 65535, np.dtype(np.int32): 65535, np.dtype(np.float32): 1}.get(grey.dtype, 255)
    return torch.from_numpy(grey.astype(np.float32) / whole)


def read_vectors(path: str | Path | bytes) -> Float[Tensor, "H W 3"]:
    """Return a three-channel picture that holds data, not colour (a normal map), in [0, 1] as stored.

    Args:
        path: of the file; or the content of a PNG or JPEG file.

    Raises:
        FormatError: the file is missing or unreadable.
    """
    if not isinstance(path, bytes) and Path(path).suffix.lower() == ".exr":
        return _read_exr(Path(path))
    return torch.from_numpy(_read_pillow(path, colour=True).astype(np.float32) / 255)


def write_png(path: str | Path, rgb: Float[Tensor, "H W 3"]) -> None:
    """Write linear RGB as an 8-bit sRGB picture: exposure 0, clipped to [0, 1]."""
    from PIL import Image

    with replacing(path) as beside:
        Image.fromarray(to_bytes(rgb)).save(beside, format="PNG")


def write_exr(path: str | Path, rgb: Float[Tensor, "H W 3"], **channels: Float[Tensor, "H W"]) -> None:
    """Write linear RGB, and further named channels such as depth, as float32 OpenEXR (ZIP)."""
    import OpenEXR

    # Contiguous copies in a dictionary of our own: the writer garbles strided arrays and changes the dictionary.
    planes = {"RGB": np.array(rgb.detach().float().numpy(), order="C", copy=True)}
    planes |= {name: np.array(x.detach().float().numpy(), order="C", copy=True) for name, x in channels.items()}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with replacing(path) as beside:
        try:
            OpenEXR.File(header, planes).write(str(beside))
        except RuntimeError as error:  # what the binding makes of any failure
            raise StorageError(f"{path}: could not be written ({error}); make room or choose another place") from error


def to_bytes(rgb: Float[Tensor, "H W 3"]) -> np.ndarray:
    """Return linear RGB as (H, W, 3) sRGB bytes; not-a-number becomes 0."""
    srgb = to_srgb(torch.nan_to_num(rgb.detach().float(), nan=0.0).clamp(0, 1))
    return (srgb * 255 + 0.5).to(torch.uint8).numpy()


def to_linear(srgb: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Return linear values of sRGB ones (IEC 61966-2-1)."""
    return torch.where(srgb <= 0.04045, srgb / 12.92, ((srgb.clamp(min=0) + 0.055) / 1.055) ** 2.4)


@lru_cache(maxsize=1)
def srgb_table() -> Float[Tensor, "256"]:
    """Return the linear value of each sRGB code, float32."""
    return to_linear(torch.arange(256, dtype=torch.float64) / 255).float()


def decode_codes(codes: UInt8[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Return the float32 linear values of sRGB codes, through a table of 256 entries."""
    # Indices are four times as wide as codes (bytes would be a mask), so they are made a million at a time.
    flat = codes.reshape(-1)
    linear = torch.empty(flat.shape, dtype=torch.float32)
    for some, out in zip(flat.split(1 << 20), linear.split(1 << 20), strict=True):
        torch.index_select(srgb_table(), 0, some.int(), out=out)
    return linear.reshape(codes.shape)


def encode_codes(linear: Float[Tensor, "*batch"]) -> UInt8[Tensor, "*batch"]:
    """Return the nearest sRGB codes of linear values, clipped to [0, 1]: the inverse of `decode_codes`."""
    return (to_srgb(linear.clamp(0, 1)) * 255 + 0.5).to(torch.uint8)


def to_srgb(linear: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Return sRGB values of linear ones: the inverse of `to_linear`."""
    return torch.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear.clamp(min=0) ** (1 / 2.4) - 0.055)


def _read_pillow(path: str | Path | bytes, *, colour: bool) -> np.ndarray:
    """Return (H, W, 3) codes, or the values of a picture that holds data as they are stored."""
    from PIL import Image, UnidentifiedImageError

    name = "embedded picture" if isinstance(path, bytes) else path
    if not isinstance(path, bytes) and not Path(path).is_file():
        raise FormatError(f"{path}: expected a picture, found none; check the path")
    try:
        with Image.open(io.BytesIO(path) if isinstance(path, bytes) else path) as picture:
            _check_announced(picture, name, len(path) if isinstance(path, bytes) else Path(path).stat().st_size)
            return _codes(picture, name) if colour else np.asarray(picture)
    except (UnidentifiedImageError, Image.DecompressionBombError, OSError, SyntaxError, ValueError) as error:
        raise FormatError(
            f"{name}: expected a PNG, JPEG, TIFF or EXR picture ({error}); the copy may be incomplete"
        ) from error


def _read_exr(path: Path) -> Tensor:
    import OpenEXR

    if not path.is_file():
        raise FormatError(f"{path}: expected a picture, found none; check the path")
    try:
        window = OpenEXR.File(str(path), header_only=True).header()["dataWindow"]
        width, height = (int(last) - int(first) + 1 for first, last in zip(*window, strict=True))
        if not 0 < width * height <= EXR_PIXELS_PER_BYTE * path.stat().st_size:
            raise ValueError(f"announces {width} x {height} pixels in {path.stat().st_size} bytes")
        channels = OpenEXR.File(str(path)).channels()
    except Exception as error:  # the binding raises RuntimeError and others
        raise FormatError(f"{path}: expected an OpenEXR picture ({error}); the copy may be incomplete") from error
    if "RGB" in channels or "RGBA" in channels:
        pixels = channels["RGB" if "RGB" in channels else "RGBA"].pixels[..., :3]
    else:
        only = channels.get("Y") or next(iter(channels.values()))
        pixels = np.repeat(only.pixels[..., None], 3, axis=-1)
    return torch.from_numpy(np.ascontiguousarray(pixels, dtype=np.float32))
