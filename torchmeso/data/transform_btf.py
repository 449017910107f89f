"""The transform-coded BTF, a small file that opens as an eigen BTF.

T(texel, wi, wo) = step * sum_jkc L_j(wi) V_k(wo) A_c D^T q_jkc: orthonormal bases of light, view and colour that
belong to the material, a cosine transform D over blocks of texels, and whole numbers q, all of one step. Most of
them are 0, and LZMA stores those in next to nothing: what is below the error budget takes no room. One stream holds
one component of the view, so that the first few are read alone. `expanded` is the eigen BTF with W = V, which
evaluates, has mips and is drawn by the kernels as any other; resident it is as large as that.

Test: tests/data/test_transform_btf.py
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int16, UInt8
from torch import Tensor

from torchmeso.data import code_stream, mdf, store
from torchmeso.data.eigen_btf import EigenBtf
from torchmeso.data.mdf import Mdf
from torchmeso.errors import FormatError, ShapeError, check_finite, check_shape
from torchmeso.geometry import hemisphere
from torchmeso.geometry.hemisphere import DirectionSet

LARGEST_BLOCK = 32
"""Texels along a side of the blocks of the cosine transform."""


@dataclass(frozen=True, eq=False, kw_only=True)
class TransformBtf:
    """Quantised coefficients and their bases.

    Attributes:
        codes: (rank, light term, 3, H, W) q; blocks of the cosine transform lie where their texels do.
        light_basis: (light, light term) L, orthonormal columns.
        view_basis: (view, rank) V, orthonormal columns, the strongest first.
        colour_basis: (3, 3) A, rgb by term.
        step: of the codes, > 0.
        lights: directions towards the light.
        views: directions towards the viewer.
    """

    codes: Int16[Tensor, "rank term 3 H W"]
    light_basis: Float[Tensor, "light term"]
    view_basis: Float[Tensor, "view rank"]
    colour_basis: Float[Tensor, "3 3"]
    step: float
    lights: DirectionSet
    views: DirectionSet

    def __post_init__(self) -> None:
        """Raise ShapeError unless the parts match."""
        check_shape("transform.codes", self.codes, (-1, -1, 3, -1, -1))
        rank, terms, _, height, width = self.codes.shape
        check_shape("transform.light_basis", self.light_basis, (len(self.lights), terms))
        check_shape("transform.view_basis", self.view_basis, (len(self.views), rank))
        check_shape("transform.colour_basis", self.colour_basis, (3, 3))
        if min(rank, terms, height, width) < 1:
            raise ShapeError(f"transform.codes: expected at least one of each, got {tuple(self.codes.shape)}")
        if not 0 < self.step < math.inf:
            raise ShapeError(f"transform.step: expected a positive number, got {self.step}")
        for name in ("light_basis", "view_basis", "colour_basis"):
            check_finite(f"transform.{name}", getattr(self, name))

    def expanded(self) -> EigenBtf:
        """Return the same BTF as eigen maps of eight bits, component by component: what pictures are made from."""
        maps, scale, offset = zip(
            *(opened(codes, self.step, self.light_basis, self.colour_basis) for codes in self.codes), strict=True
        )
        return EigenBtf(
            maps=torch.stack(maps, -2),
            weights=self.view_basis.float(),
            scale=torch.stack(scale),
            offset=torch.stack(offset),
            lights=self.lights,
            views=self.views,
        )


def opened(
    codes: Int16[Tensor, "term 3 H W"],
    step: float,
    light_basis: Float[Tensor, "light term"],
    colour_basis: Float[Tensor, "3 3"],
) -> tuple[UInt8[Tensor, "light H W 3"], Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Return the eigen map of one component in eight bits: codes, scale and offset."""
    terms = cosines(codes.float() * step, inverse=True)
    E = torch.einsum("jchw,lj,rc->lhwr", terms, light_basis.float(), colour_basis.float())
    low, high = E.amin((0, 1, 2)), E.amax((0, 1, 2))
    scale = ((high - low) / 255).clamp(min=torch.finfo(torch.float32).tiny)
    return ((E - low) / scale).round_().clamp_(0, 255).to(torch.uint8), scale, low


def cosines(
    x: Float[Tensor, "*batch H W"], *, inverse: bool = False, along: tuple[int, ...] = (-2, -1)
) -> Float[Tensor, "*batch H W"]:
    """Return the orthonormal cosine transform (DCT-II) of blocks of texels, in the place of their texels.

    Blocks are as large as divides the texture, up to `LARGEST_BLOCK`; `along` its columns (-2), its rows (-1) or both.
    """
    for dim in along:
        n = x.shape[dim]
        side = max(b for b in range(1, min(n, LARGEST_BLOCK) + 1) if n % b == 0)
        k, place = torch.arange(side, dtype=torch.float64)[:, None], torch.arange(side, dtype=torch.float64) + 0.5
        D = torch.cos(math.pi * k * place / side) * math.sqrt(2 / side)
        D[0] /= math.sqrt(2)
        D = (D.T if inverse else D).to(x.dtype)
        blocks = x.movedim(dim, -1).unflatten(-1, (-1, side)) @ D.T
        x = blocks.flatten(-2).movedim(-1, dim)
    return x


def packed(codes: Int16[Tensor, "term 3 H W"]) -> bytes:
    """Return the stream of one component: 0, -1, 1, -2, ... as 0, 1, 2, 3, ..., low bytes, then high ones."""
    q = codes.numpy().ravel()
    folded = ((q << 1) ^ (q >> 15)).astype("<i2").view(np.uint8)
    planes = np.ascontiguousarray(folded.reshape(-1, 2).T)
    return code_stream.squeezed(planes.tobytes())


def unpacked(stream: bytes, shape: tuple[int, int, int, int]) -> Int16[Tensor, "term 3 H W"]:
    """Return the codes of one component.

    Raises:
        FormatError: the stream is damaged, or does not hold `shape`.
    """
    if min(shape) < 1:
        raise FormatError(f"transform: expected at least one code, got the shape {shape}; the copy may be incomplete")
    data = code_stream.opened(stream, 2 * math.prod(shape))
    low, high = np.frombuffer(data, np.uint8).reshape(2, -1).astype(np.int32)
    folded = low + 256 * high
    q = np.where(folded & 1, -((folded + 1) >> 1), folded >> 1).astype(np.int16)
    return torch.from_numpy(q).reshape(shape)


def save(packed_btf: TransformBtf, path: str | Path, *, silhouette: Mdf | None = None, **meta: object) -> None:
    """Write a run-time model (.meso): one stream per component, bases in halves, and the MDF where there is one."""
    write(
        path, (packed(codes) for codes in packed_btf.codes), texels=tuple(packed_btf.codes.shape[3:]),
        light_basis=packed_btf.light_basis, view_basis=packed_btf.view_basis, colour_basis=packed_btf.colour_basis,
        step=packed_btf.step, lights=packed_btf.lights, views=packed_btf.views, silhouette=silhouette, **meta,
    )  # fmt: skip


def write(
    path: str | Path,
    streams: Iterable[bytes],
    *,
    texels: tuple[int, ...],
    light_basis: Float[Tensor, "light term"],
    view_basis: Float[Tensor, "view rank"],
    colour_basis: Float[Tensor, "3 3"],
    step: float,
    lights: DirectionSet,
    views: DirectionSet,
    silhouette: Mdf | None = None,
    **meta: object,
) -> None:
    """Write a run-time model (.meso) as `save` does, of the streams of its components; only these are in memory.

    Raises:
        StorageError: the disk is full, or the place cannot be written to.
    """
    tensors = {f"transform.view.{k}": _bytes(stream) for k, stream in enumerate(streams)}
    for name, basis in (("light", light_basis), ("view", view_basis), ("colour", colour_basis)):
        tensors[f"transform.{name}_basis"] = basis.half()
    about: dict[str, object] = {
        "lights": lights.name, "views": views.name, "rank": view_basis.shape[1], "light_terms": light_basis.shape[1],
        "texels": list(texels), "step": step,
    }  # fmt: skip
    parts: dict[str, object] = {"kind": "transform", "transform": about, **meta}
    if silhouette is not None:
        mdf_tensors, parts["mdf"] = mdf.to_tensors(silhouette)
        tensors |= mdf_tensors
    store.write_model(path, tensors, parts)


def load(path: str | Path, *, rank: int | None = None) -> TransformBtf:
    """Return the transform-coded BTF of a run-time model, reading only the first `rank` components where given.

    Raises:
        FormatError: the file is missing, damaged, or holds no transform-coded BTF.
    """
    model = store.Model(path)
    about = model.meta.get("transform")
    if about is None:
        raise FormatError(f"{path}: expected a transform-coded BTF, found {', '.join(model.names()) or 'nothing'}")
    with store.reading(path):
        kept = about["rank"] if rank is None else min(rank, about["rank"])
        if kept < 1:
            raise FormatError(f"{path}: expected at least one component, got {kept}; the copy may be incomplete")
        shape = (about["light_terms"], 3, *about["texels"])
        streams = (model.read(f"transform.view.{k}").numpy().tobytes() for k in range(kept))
        return TransformBtf(
            codes=torch.stack([unpacked(stream, shape) for stream in streams]),
            light_basis=model.read("transform.light_basis").float(),
            view_basis=model.read("transform.view_basis").float()[:, :kept],
            colour_basis=model.read("transform.colour_basis").float(),
            step=float(about["step"]),
            lights=hemisphere.parse(about["lights"]),
            views=hemisphere.parse(about["views"]),
        )


def _bytes(stream: bytes) -> Tensor:
    return torch.frombuffer(bytearray(stream), dtype=torch.uint8)
