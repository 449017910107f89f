"""What follows the header of Bonn's `.btf` files that are factored: DFMF, FMF, and PVF.

DFMF: u32 components, i32 colour model, 3 f32 mean, 9 f32 transform; for each channel u8 bytes of a scalar (2, 4, 8),
u32 components, u32 rows, u32 columns, the singular values, U (rows x components), S V (columns x components).
Rows are pairs, light + lights * view, and columns texels, x + width * y; or the other way round. FMF: with extended
header u8 version, from 1 on u32 whether values are logarithms (exp(x) - 1e-5), from 2 on u32 width and height and as
many halves of a height map; then u32 components and one such factorisation of all channels, rows = channel +
channels * pair. PVF: possibly u32 301074, u32 components, u32 views; for each view u8 bytes of a scalar, u32
components, u32 weights, u32 dimension, eigenvalues, mean (dimension), basis (dimension x components), weights
(weights x components): value = mean + basis * weight, either a basis of pictures (dimension = channel + channels *
texel) and weights of lights, or a basis over lights and weights of texels.

Factors stay where they are on disk until a decoder asks for a band of texels or for one picture.

Test: tests/data/test_btfdbb_body.py
"""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.data.btfdbb_colour import Colour
from torchmeso.data.btfdbb_header import Cursor, Header
from torchmeso.errors import FormatError

SCALARS = {2: "<f2", 4: "<f4", 8: "<f8"}

BLOCK_NUMBERS = 1 << 20
"""Factors that are converted at a time: those of a picture at once miss the processor's cache, 113 ms instead of 14."""

LEGACY_MAGIC = 301074
"""Begins the layout of some PVF files."""


@runtime_checkable
class Body(Protocol):
    """Numbers of the file's colour model, decoded a part at a time."""

    def values(self, pairs: slice, texels: slice) -> Float[Tensor, "pair texel 3"]:
        """Return float32 numbers; pairs are light + lights * view and texels x + width * y, row 0 at the bottom."""
        ...

    def facts(self) -> dict[str, object]:
        """Return what `info` tells of it."""
        ...


@dataclass(frozen=True, eq=False, slots=True)
class Factored:
    """value[pair, texel, channel] = sum_k by_pair[channel][pair, k] by_texel[channel][texel, k].

    Attributes:
        by_pair: for each channel (pair, rank), on disk.
        by_texel: for each channel (texel, rank), on disk, largest component first.
    """

    by_pair: tuple[np.ndarray, ...]
    by_texel: tuple[np.ndarray, ...]

    def values(self, pairs: slice, texels: slice) -> Float[Tensor, "pair texel 3"]:
        """Return a part, see `Body`."""
        wanted = range(len(self.by_texel[0]))[texels]
        found = torch.empty(len(self.by_pair[0][pairs]), len(wanted), 3)
        for c, (by_pair, by_texel) in enumerate(zip(self.by_pair, self.by_texel, strict=True)):
            U = _tensor(by_pair[pairs])
            step = max(1, BLOCK_NUMBERS // by_texel.shape[1])
            for first in range(wanted.start, wanted.stop, step):
                last = min(first + step, wanted.stop)
                found[:, first - wanted.start : last - wanted.start, c] = U @ _tensor(by_texel[first:last]).mT
        return found

    def facts(self) -> dict[str, object]:
        """Return components and storage."""
        return {
            "components": ", ".join(str(p.shape[1]) for p in self.by_pair),
            "storage": self.by_pair[0].dtype.name,
        }


@dataclass(frozen=True, eq=False, slots=True)
class PerView:
    """One factorisation for each view: value[light, texel, c] = mean + sum_k over by_light and by_texel.

    Attributes:
        by_light: for each view (light, 1 or 3, rank): weights, or a basis over lights.
        by_texel: for each view (texel, 1 or 3, rank): a basis of pictures, or weights.
        mean: for each view (1 or light, 1 or texel, 3).
    """

    by_light: tuple[np.ndarray, ...]
    by_texel: tuple[np.ndarray, ...]
    mean: tuple[np.ndarray, ...]

    def values(self, pairs: slice, texels: slice) -> Float[Tensor, "pair texel 3"]:
        """Return a part, see `Body`."""
        n_light = len(self.by_light[0])
        every = range(n_light * len(self.by_light))[pairs]
        parts = []
        for view in range(every.start // n_light, (every.stop - 1) // n_light + 1):
            lights = slice(max(every.start - view * n_light, 0), min(every.stop - view * n_light, n_light))
            parts.append(self._of_view(view, lights, texels))
        return torch.cat(parts)

    def _of_view(self, view: int, lights: slice, texels: slice) -> Tensor:
        by_light, by_texel = _tensor(self.by_light[view][lights]), _tensor(self.by_texel[view][texels])
        mean = self.mean[view]
        part = mean[lights if len(mean) > 1 else slice(None), texels if mean.shape[1] > 1 else slice(None)]
        channels = [by_light[:, c % by_light.shape[1]] @ by_texel[:, c % by_texel.shape[1]].mT for c in range(3)]
        return (torch.stack(channels, -1) + _tensor(part)).float()

    def facts(self) -> dict[str, object]:
        """Return components and storage."""
        ranks = [w.shape[-1] for w in self.by_light]
        told = f"{min(ranks)}" if min(ranks) == max(ranks) else f"{min(ranks)} to {max(ranks)}"
        return {"components": f"{told} for each view", "storage": self.by_light[0].dtype.name}


def read_dfmf(cursor: Cursor, header: Header, rank: int | None) -> tuple[Factored, Colour]:
    """Return the factors of each channel, `rank` of them at most, and the colour model.

    Raises:
        FormatError: sizes do not agree, or the file ends before.
    """
    cursor.u32("components")
    model = int(cursor.array("colour model", "<i4", 1)[0])
    colour = Colour(model, cursor.floats("colour mean", 3), cursor.floats("colour transform", 9))
    _check_channels(cursor, header)
    by_pair, by_texel = [], []
    for name in header.channels:
        U, SxV = _factors(cursor, f"channel {name}", cursor.u8("size of a scalar"))
        if (len(U), len(SxV)) == (header.texels, header.pairs) and header.texels != header.pairs:
            U, SxV = SxV, U
        _check_sizes(cursor, f"channel {name}", (len(U), len(SxV)), (header.pairs, header.texels))
        by_pair.append(U[:, :rank])
        by_texel.append(SxV[:, :rank])
    return Factored(tuple(by_pair), tuple(by_texel)), colour


def read_fmf(cursor: Cursor, header: Header, rank: int | None) -> tuple[Factored, Colour]:
    """Return the factors that all channels share, `rank` of them at most, and the colour model.

    Raises:
        FormatError: an unknown extended header, sizes that do not agree, or the file ends before.
    """
    logarithms = False
    if header.signature.startswith("!FMF12FCE"):
        version = cursor.u8("version of the extended header")
        if version > 2:
            raise FormatError(f"{cursor.path}: expected an extended header of version 0 to 2, got {version}")
        logarithms = version >= 1 and cursor.u32("dynamic range reduction") != 0
        if version >= 2:
            width, height = cursor.u32("width of the height map"), cursor.u32("height of the height map")
            cursor.array("height map", "<f2", height, width)
    cursor.u32("components")
    _check_channels(cursor, header)
    U, SxV = _factors(cursor, "the factorisation", cursor.u8("size of a scalar"))
    _check_sizes(cursor, "the factorisation", (len(U), len(SxV)), (3 * header.pairs, header.texels))
    split = U.reshape(header.pairs, 3, -1)[..., :rank]
    factored = Factored(tuple(split[:, c] for c in range(3)), (SxV[:, :rank],) * 3)
    return factored, Colour(12 if logarithms else 0)


def read_pvf(cursor: Cursor, header: Header, rank: int | None) -> tuple[PerView, Colour]:
    """Return the factors of each view, `rank` of them at most, and the colour model.

    Raises:
        FormatError: sizes do not agree, or the file ends before.
    """
    if cursor.u32("components") == LEGACY_MAGIC:
        cursor.u32("components")
    n_view, n_light, n_texel = cursor.u32("number of views"), len(header.lights), header.texels
    if n_view != len(header.views):
        raise FormatError(f"{cursor.path}: header lists {len(header.views)} views, the factors are of {n_view}")
    _check_channels(cursor, header)
    by_light, by_texel, means = [], [], []
    for view in range(n_view):
        dtype = _scalar(cursor, cursor.u8("size of a scalar"))
        k, n_weight, dimension = (cursor.u32(what) for what in ("components", "weights", "dimension"))
        _check_rank(cursor, f"view {view}", k)
        cursor.array("eigenvalues", dtype, k)
        mean = cursor.array("mean", dtype, dimension)
        basis, weights = cursor.array("basis", dtype, dimension, k), cursor.array("weights", dtype, n_weight, k)
        pictures = (n_weight, dimension) == (n_light, 3 * n_texel)
        wanted = (n_light, 3 * n_texel) if pictures else (n_texel, 3 * n_light)
        _check_sizes(cursor, f"view {view}", (n_weight, dimension), wanted)
        basis, weights = basis.reshape(-1, 3, k)[..., :rank], weights[:, None, :rank]
        by_light.append(weights if pictures else basis)
        by_texel.append(basis if pictures else weights)
        means.append(mean.reshape(1, -1, 3) if pictures else mean.reshape(-1, 1, 3))
    return PerView(tuple(by_light), tuple(by_texel), tuple(means)), Colour(0)


def _factors(cursor: Cursor, name: str, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return U (rows, components) and S V (columns, components)."""
    dtype = _scalar(cursor, size)
    k, rows, columns = (cursor.u32(what) for what in ("components", "rows", "columns"))
    _check_rank(cursor, name, k)
    cursor.array("singular values", dtype, k)
    return cursor.array(f"U of {name}", dtype, rows, k), cursor.array(f"S V of {name}", dtype, columns, k)


def _scalar(cursor: Cursor, size: int) -> str:
    if size not in SCALARS:
        raise FormatError(f"{cursor.path}: expected scalars of 2, 4 or 8 bytes, got {size}; the copy may be incomplete")
    return SCALARS[size]


def _check_rank(cursor: Cursor, name: str, k: int) -> None:
    # Without components nothing in the file would bear out the sizes it tells.
    if k < 1:
        raise FormatError(f"{cursor.path}: {name}: expected at least one component, got none")


def _check_channels(cursor: Cursor, header: Header) -> None:
    if len(header.channels) != 3:
        raise FormatError(
            f"{cursor.path}: expected 3 channels, got {len(header.channels)}; "
            "convert the file to RGB with the program that made it"
        )


def _check_sizes(cursor: Cursor, name: str, got: tuple[int, int], expected: tuple[int, int]) -> None:
    if got != expected:
        raise FormatError(
            f"{cursor.path}: {name}: expected factors of {expected[0]} and {expected[1]}, as the header lists, "
            f"got {got[0]} and {got[1]}; the copy may be incomplete"
        )


def _tensor(array: np.ndarray) -> Tensor:
    """Return values that may lie askew on disk, halves as float32."""
    values = torch.from_numpy(np.array(array, order="C"))
    return values.float() if values.dtype == torch.float16 else values
