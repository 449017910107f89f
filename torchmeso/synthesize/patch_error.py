"""Patch error: how unlike two patches of a texture are, over all views and lights at once.

kawasaki2005quilting, eq. (2): squared differences of coefficients, weighted by beta over the light's harmonics and by
alpha over the views. Weights W_k of components stand for coefficients B W, so that the distance it means is

    d^2 = sum_v alpha_v || diag(sqrt(beta)) B^T dW_v ||^2,      a K x K matrix on the components' weights.

Any such metric is the plain distance of some picture of channels: `channels` makes that picture, of SH + PCA,
double-SH and eigen BTFs (without a beta the metric is the mean square of T over lights, views and colours) and of
pictures. `exemplar` turns it onto its principal axes and rounds it to 12 bits, the same step in every channel, so that
errors are whole numbers: sums in any order and on any number of threads are the same, and the choice made by them.

`Search` holds the exemplar's spectra. The errors of all placements come from products of spectra in float64, whose
rounding stays far below one half: rounded, they are the whole numbers themselves.

Test: tests/synthesize/test_patch_error.py
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchmeso.algebra import subspace
from torchmeso.data.eigen_btf import EigenBtf
from torchmeso.data.sh_btf import ShBtf, held_basis
from torchmeso.data.sh_pca_btf import ShPcaBtf
from torchmeso.errors import ConfigError, ShapeError, check_finite, check_range, check_shape
from torchmeso.geometry import hemisphere
from torchmeso.geometry.hemisphere import DirectionSet

LEVELS = 4095
"""Largest code of 12 bits."""

MIDDLE = 2048
"""Taken off codes before they are transformed: half the size, and a quarter of the rounding."""

FLOOR = 1e-7
"""Share of the largest direction of a metric below which a direction is left out."""

BLOCK = 1 << 16
"""Texels whose channels are taken at a time."""

Look = EigenBtf | ShBtf | ShPcaBtf | Tensor
"""What patches can be cut from: a BTF model, or a picture (H, W, C)."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Metric:
    """What counts in eq. (2).

    Attributes:
        alpha: (view,) weight of each view, or None: its solid angle.
        beta: (k_l,) weight of each harmonic of the light, or None: the mean square of T over the lights.
        bands: harmonics of degree below this only (an eigen BTF: so many components), or None = all; "a low frequency
            of SH coefficient largely influences the synthesis" (section 3.1.2).
    """

    alpha: Float[Tensor, "view"] | None = None
    beta: Float[Tensor, "k_l"] | None = None
    bands: int | None = None

    def __post_init__(self) -> None:
        """Raise ConfigError for no band at all."""
        if self.bands is not None:
            check_range("metric.bands", self.bands, 1, 64)


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Exemplar:
    """A texture to cut patches from.

    Attributes:
        codes: (H, W, C) int64 in [0, 4095], principal axes of the channels, largest first.
        power: (H, W) int64 squared length of a texel's channels before any was left out, in squared steps.
        step: distance of one code, in the unit of the channels.
        kept: share of the channels' variance that the codes hold.
    """

    codes: Int[Tensor, "H W C"]
    power: Int[Tensor, "H W"]
    step: float
    kept: float

    @property
    def texels(self) -> tuple[int, int]:
        """Height and width."""
        return self.codes.shape[0], self.codes.shape[1]


def channels(look: Look, metric: Metric | None = None) -> Float[Tensor, "H W C"]:
    """Return a picture whose plain squared distance is eq. (2), float32.

    Args:
        look: a model, or a picture, which is its own channels.
        metric: what counts.

    Raises:
        ConfigError: weights of harmonics or views that the look does not have.
        ShapeError: a picture has no texel, or weights have another length than the model's directions.
    """
    metric = metric or Metric()
    if isinstance(look, Tensor):
        check_shape("exemplar", look, (-1, -1, -1))
        if min(look.shape) < 1:
            raise ShapeError(f"exemplar: expected at least one texel and channel, got {tuple(look.shape)}")
        if metric.alpha is not None or metric.beta is not None or metric.bands is not None:
            raise ConfigError("metric: a picture has neither views nor harmonics; leave alpha, beta and bands out")
        return look.float()
    if isinstance(look, EigenBtf):
        return _of_eigen(look, metric)
    return _of_sh_pca(look, metric) if isinstance(look, ShPcaBtf) else _of_double_sh(look, metric)


def _of_sh_pca(model: ShPcaBtf, metric: Metric) -> Tensor:
    terms = _terms(metric, model.terms)
    light = _light_factor(model.lights, model.terms, metric)[:terms]
    basis = torch.einsum("kmc,mj->kcj", model.basis[:, :terms].double(), light).flatten(1)
    components = _factor(basis @ basis.mT)
    views = _shares(model.views, metric.alpha).sqrt()
    # One view after the other, so that decoded weights are never held whole.
    each = [
        (model.offset + model.scale * codes.to(model.scale.dtype)) @ (share * components).to(model.scale.dtype)
        for codes, share in zip(model.maps, views, strict=True)
    ]
    return torch.cat(each, -1).float()


def _of_double_sh(model: ShBtf, metric: Metric) -> Tensor:
    n_light, n_view = (_terms(metric, n) for n in model.terms)
    light = _light_factor(model.lights, model.terms[0], metric)[:n_light]
    Y = held_basis(model.views, model.views.directions(torch.float64), model.terms[1])[:, :n_view]
    view = _factor(Y.mT @ (_shares(model.views, metric.alpha)[:, None] * Y))
    model = model.truncated(n_light, n_view)
    rows = max(BLOCK // model.texels[1], 1)
    parts = (replace(model, maps=maps).decoded() for maps in model.maps.split(rows, 2))
    each = [torch.einsum("ijhwc,ia,jb->hwabc", C, light.to(C.dtype), view.to(C.dtype)).flatten(2) for C in parts]
    return torch.cat(each).float()


def _of_eigen(model: EigenBtf, metric: Metric) -> Tensor:
    if metric.beta is not None:
        raise ConfigError("metric.beta: an eigen BTF has no harmonics; leave beta out")
    model = model if metric.bands is None else model.truncated(min(metric.bands, model.rank))
    W = model.weights.double()
    components = _factor(W.mT @ (_shares(model.views, metric.alpha)[:, None] * W)) / math.sqrt(3)
    lights = _shares(model.lights, None).sqrt()
    each = [
        torch.einsum("hwkc,kj->hwjc", E, (share * components).to(E.dtype)).flatten(2)
        for E, share in zip(model.decoded(), lights, strict=True)
    ]
    return torch.cat(each, -1).float()


def _terms(metric: Metric, terms: int) -> int:
    return terms if metric.bands is None else min(metric.bands**2, terms)


def _light_factor(lights: DirectionSet, terms: int, metric: Metric) -> Float[Tensor, "k_l j"]:
    """Return F with |F^T c|^2 = sum_m beta_m c_m^2, or the mean square over the lights, of one colour in three."""
    if metric.beta is not None:
        check_shape("metric.beta", metric.beta, (terms,))
        check_finite("metric.beta", metric.beta, 0, 1e30)
        return metric.beta.double().sqrt().diag()
    Y = held_basis(lights, lights.directions(torch.float64), terms)
    return _factor(Y.mT @ (_shares(lights, None)[:, None] * Y)) / math.sqrt(3)


def _shares(directions: DirectionSet, given: Tensor | None) -> Float[Tensor, "direction"]:
    """Return the weights given, or the directions' shares of the hemisphere's solid angle."""
    if given is None:
        found = hemisphere.solid_angles(directions)
        return found / found.sum()
    check_shape("metric.alpha", given, (len(directions),))
    check_finite("metric.alpha", given, 0, 1e30)
    return given.double()


def _factor(gram: Float[Tensor, "n n"]) -> Float[Tensor, "n j"]:
    """Return F with F F^T = a positive matrix; directions that hold nothing of it are left out."""
    values, vectors = torch.linalg.eigh((gram + gram.mT) / 2)
    kept = values > FLOOR * values[-1].clamp(min=1e-300)
    kept[-1] = True
    return vectors[:, kept] * values[kept].clamp(min=0).sqrt()


def exemplar(look: Look, metric: Metric | None = None, *, channels_kept: int = 24, energy: float = 0.99) -> Exemplar:
    """Return `look` as whole numbers on the principal axes of its channels.

    Args:
        look: a model or a picture.
        metric: what counts.
        channels_kept: most of them.
        energy: share of the variance after which further ones are left out.

    Raises:
        ConfigError: a dial is out of range, or weights do not fit.
        ShapeError: there is no texel, or a value is not finite.
    """
    check_range("channels_kept", channels_kept, 1, 256)
    check_range("energy", energy, 0, 1)
    with one_thread():
        found = channels(look, metric)
        check_finite("exemplar", found)
        return _quantised(found, channels_kept, energy)


def _quantised(found: Float[Tensor, "H W C"], most: int, energy: float) -> Exemplar:
    height, width, n = found.shape
    rows = found.flatten(0, 1)
    # By blocks: never a second copy of what may be gigabytes.
    mean = torch.stack([block.sum(0, dtype=torch.float64) for block in rows.split(BLOCK)]).sum(0) / len(rows)

    def blocks() -> Iterator[Tensor]:
        return ((block.double() - mean).float()[None] for block in rows.split(BLOCK))

    square = torch.cat([block.square().sum(-1, dtype=torch.float64) for block in rows.split(BLOCK)])
    whole = float(sum(block.square().sum(dtype=torch.float64) for block in blocks()))
    rank = min(most, n, len(rows))
    (scores,), _ = subspace.factor(blocks, len(rows), n, 1, rank)
    each = scores.square().sum(0, dtype=torch.float64)
    # Not fewer than what the energy asks for: the first axes whose sum reaches it.
    count = min(int((each.cumsum(0) < energy * whole).sum()) + 1, rank)
    scores, kept = scores[:, :count], min(float(each[:count].sum()) / whole, 1.0) if whole > 0 else 1.0
    low, high = scores.amin(0), scores.amax(0)
    step = float((high - low).max()) / LEVELS or 1.0
    codes = ((scores - low) / step).round().long()
    power = (square / step**2).round().long()
    return Exemplar(codes=codes.reshape(height, width, -1), power=power.reshape(height, width), step=step, kept=kept)


@contextmanager
def one_thread() -> Iterator[None]:
    """Compute on one thread: sums of floats run in one order, and small ones are not cut into smaller ones."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


class Placements(NamedTuple):
    """Where a patch may be cut from: its first row and column.

    Attributes:
        rows: number of first rows, 0, 1, ...
        columns: of first columns.
    """

    rows: int
    columns: int


class Search:
    """An exemplar's spectra, for the errors of patches at all placements."""

    def __init__(self, source: Exemplar, *, toroidal: bool = False):
        """Transform `source` once; `toroidal`: patches may run over its border, as over that of one that tiles."""
        self.source, self.toroidal = source, toroidal
        codes = (source.codes - MIDDLE).movedim(-1, 0).double()
        self._codes, self._squares = torch.fft.rfft2(codes), torch.fft.rfft2(codes.square().sum(0))
        self._under: dict[tuple, Tensor] = {}

    def placements(self, height: int, width: int) -> Placements:
        """Return where a patch of this size may be cut from.

        Raises:
            ShapeError: the patch is larger than the exemplar.
        """
        rows, columns = self.source.texels
        if height > rows or width > columns:
            raise ShapeError(
                f"patch: expected at most {columns} x {rows} texels, the exemplar's, got {width} x {height}"
            )
        return Placements(rows, columns) if self.toroidal else Placements(rows - height + 1, columns - width + 1)

    def errors(self, target: Int[Tensor, "h w C"], mask: Bool[Tensor, "h w"]) -> Int[Tensor, "rows columns"]:
        """Return the squared error of every placement over `mask`, in squared steps, exact.

        Args:
            target: codes that a patch is to continue; not read outside of the mask.
            mask: the overlap, of any shape.

        Raises:
            ShapeError: the patch is larger than the exemplar.
        """
        placed, size = self.placements(*mask.shape), self.source.texels
        wanted = torch.where(mask.unsqueeze(-1), target - MIDDLE, 0)
        spectrum = torch.fft.rfft2(wanted.movedim(-1, 0).double(), s=size)
        cross = torch.fft.irfft2((self._codes * spectrum.conj()).sum(0), s=size)
        found = (self._squares_under(mask) - 2 * cross).round().long() + wanted.square().sum()
        return found[: placed.rows, : placed.columns]

    def _squares_under(self, mask: Tensor) -> Float[Tensor, "H W"]:
        """Return the sum of the exemplar's squares under the mask at every placement; masks come again and again."""
        key = (*mask.shape, mask.numpy().tobytes())
        if key not in self._under:
            size = self.source.texels
            spectrum = torch.fft.rfft2(mask.double(), s=size)
            self._under[key] = torch.fft.irfft2(self._squares * spectrum.conj(), s=size)
        return self._under[key]
