"""The factored BTF, a run-time model with one factorisation per colour channel: Bonn's DFMF as a `.meso`.

x_c(texel, light, view) = sum_k P_ck(light, view) S_ck(texel), and T is the linear RGB of the three numbers x_c in a
colour model (`data.btfdbb_colour`; log Y, U/Y, V/Y as in Bonn's files, or RGB). A file holds few numbers: pairs of
light and view plus texels, per component. Renderers, mips and kernels want sums that are linear in what is stored,
which a logarithm is not: the model is a table that reads its rows when asked (`Bands`), and opens as the eigen BTF of
that table (`pipeline.bake.open_model`), of as many components as its fit found necessary.

Test: tests/data/test_factored_btf.py
"""

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.data import btfdbb_colour, mdf, store
from torchmeso.data.btf import LARGEST
from torchmeso.data.btfdbb_colour import Colour
from torchmeso.data.mdf import Mdf
from torchmeso.errors import FormatError, ShapeError, check_finite, check_shape
from torchmeso.geometry import hemisphere
from torchmeso.geometry.hemisphere import DirectionSet


@dataclass(frozen=True, eq=False, kw_only=True)
class FactoredBtf:
    """Factors of the three channels of a colour model.

    Attributes:
        by_pair: (3, light, view, rank) P.
        by_texel: (3, H, W, rank) S.
        colour: what the channels are.
        opened_rank: components of the eigen BTF it opens as.
        lights: directions towards the light.
        views: directions towards the viewer.
    """

    by_pair: Float[Tensor, "3 light view rank"]
    by_texel: Float[Tensor, "3 H W rank"]
    colour: Colour
    opened_rank: int
    lights: DirectionSet
    views: DirectionSet

    def __post_init__(self) -> None:
        """Raise ShapeError unless the parts match."""
        rank = self.by_texel.shape[-1]
        check_shape("factored.by_pair", self.by_pair, (3, len(self.lights), len(self.views), rank))
        check_shape("factored.by_texel", self.by_texel, (3, -1, -1, rank))
        if min(self.by_texel.shape) < 1:
            raise ShapeError(f"factored.by_texel: expected at least one of each, got {tuple(self.by_texel.shape)}")
        if not 1 <= self.opened_rank <= len(self.views):
            raise ShapeError(f"factored.opened_rank: expected 1 to {len(self.views)}, got {self.opened_rank}")
        check_finite("factored.by_pair", self.by_pair)
        check_finite("factored.by_texel", self.by_texel)

    @property
    def rank(self) -> int:
        """Number of components of each channel."""
        return self.by_texel.shape[-1]

    @property
    def texels(self) -> tuple[int, int]:
        """Height and width of the texture."""
        return self.by_texel.shape[1], self.by_texel.shape[2]

    def rows(self, start: int, stop: int) -> Float[Tensor, "light view rows W 3"]:
        """Return T of texel rows start .. stop.

        Raises:
            ShapeError: a value is not finite, or beyond what a BTF holds.
        """
        x = torch.einsum("clvk,chwk->lvhwc", self.by_pair, self.by_texel[:, start:stop])
        T = btfdbb_colour.to_rgb(self.colour, x)
        check_finite("factored", T, -LARGEST, LARGEST)
        return T


def save(model: FactoredBtf, path: str | Path, *, silhouette: Mdf | None = None, **meta: object) -> None:
    """Write a run-time model (.meso): both factors in halves, and the material's MDF where it has one."""
    tensors = {"factored.by_pair": model.by_pair.half(), "factored.by_texel": model.by_texel.half()}
    about: dict[str, object] = {
        "lights": model.lights.name, "views": model.views.name, "rank": model.rank, "opened_rank": model.opened_rank,
        "colour": model.colour.model,
    }  # fmt: skip
    parts: dict[str, object] = {"kind": "factored", "factored": about, **meta}
    if silhouette is not None:
        mdf_tensors, parts["mdf"] = mdf.to_tensors(silhouette)
        tensors |= mdf_tensors
    store.write_model(path, tensors, parts)


def load(path: str | Path) -> FactoredBtf:
    """Return the factored BTF of a run-time model.

    Raises:
        FormatError: the file is missing, damaged, or holds no factored BTF.
    """
    model = store.Model(path)
    about = model.meta.get("factored")
    if about is None:
        raise FormatError(f"{path}: expected a factored BTF, found {', '.join(model.names()) or 'nothing'}")
    with store.reading(path):
        return FactoredBtf(
            by_pair=model.read("factored.by_pair").float(),
            by_texel=model.read("factored.by_texel").float(),
            colour=Colour(about["colour"]),
            opened_rank=about["opened_rank"],
            lights=hemisphere.parse(about["lights"]),
            views=hemisphere.parse(about["views"]),
        )
