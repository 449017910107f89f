"""Fit a double-SH BTF: spherical harmonics over the light, then over the view, texel by texel.

leung2007tileable, section 3.1 and appendix. Every picture's samples over the light become k_l coefficients, whose
values over the view become k_v coefficients each. Both stages are constrained least squares (`algebra.secular`): the
energy of a vector of coefficients stays under

    E = energy * sum of omega_j f_j^2,

the energy of what it stands for over the hemisphere, omega_j the solid angle that a direction stands for
(`hemisphere.solid_angles`). Harmonics that are orthonormal over the sphere then have no more energy than the
hemisphere shows, which suppresses the large, opposed coefficients that cancel there and amplify noise.

Columns (texels and channels) do not see each other: bands of texel rows of any height give the same bits. The table is
read in bands (`data.bands`), and its sRGB codes go to the kernel as they are. Before they are quantised the
coefficients are kept in float16, whose step is far below that of uint8.

Kernel: kernels_cl/compress/double_sh.cl          Test: tests/compress/test_double_sh.py
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Shaped, UInt8
from torch import Tensor

from torchmeso.algebra import secular
from torchmeso.algebra.secular import Factors
from torchmeso.algebra.spherical_harmonics import basis, degree_of
from torchmeso.backends import BackendChoice, opencl
from torchmeso.compress import quantize
from torchmeso.compress.quantize import Storage
from torchmeso.data import bands, image
from torchmeso.data.btf import Bands
from torchmeso.data.sh_btf import ShBtf
from torchmeso.errors import ShapeError, check_range
from torchmeso.geometry.hemisphere import DirectionSet, solid_angles

COLUMNS = 2048
"""Columns that go through both stages before the next ones do: what stands between them stays in the cache."""

REGISTERS = 26
"""Sums that the kernel holds at once, of 32 vector registers."""

LANES, GROUPS = 16, 4
"""Columns that a work-item fits at once, and how often: as in the kernel."""

LIT_SHARE = 0.9
"""Share of columns up to which those that are not black are copied out first."""

ROWS = 4
"""Rows of texels that are read again to tell what the harmonics leave out."""

Progress = Callable[[float], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class DoubleShOptions:
    """How to compress.

    Attributes:
        light_terms: k_l: 1, 4, 9, 16, 25 or 36.
        view_terms: k_v.
        energy: bound of the coefficients' energy, of the energy that the samples show; None = plain least squares.
        storage: uint8, float16, float32, or adaptive (bytes with steps that follow their variance).
        regularise: let directions that cannot tell the coefficients apart pass, with the smallest coefficients.
    """

    light_terms: int = 25
    view_terms: int = 25
    energy: float | None = 1.0
    storage: Storage = "uint8"
    regularise: bool = False

    def __post_init__(self) -> None:
        """Raise ConfigError for terms that are no whole bands, or an energy that bounds nothing."""
        degree_of(self.light_terms)
        degree_of(self.view_terms)
        if self.energy is not None:
            check_range("compress.energy", self.energy, 0, 1e6)


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Side:
    """The light or the view: what turns samples over its directions into coefficients.

    Attributes:
        factors: of the basis at the directions.
        share: (direction) what a squared sample adds to the bound of the energy; None = no bound.
    """

    factors: Factors
    share: Float[Tensor, "direction"] | None

    @property
    def terms(self) -> int:
        """Number of coefficients."""
        return len(self.factors.values)


def side(what: str, directions: DirectionSet, terms: int, options: DoubleShOptions) -> Side:
    """Return the light's or the view's side of a fit.

    Raises:
        ConfigError: the directions cannot tell so many coefficients apart.
    """
    Y = basis(directions.directions(torch.float64), degree_of(terms))
    factors = secular.factorise(Y, f"compress: {what} ({directions.name})", regularise=options.regularise)
    share = None if options.energy is None else options.energy * solid_angles(directions)
    return Side(factors=factors, share=share)


def sides(btf: Bands, options: DoubleShOptions) -> tuple[Side, Side]:
    """Return both sides of a fit of `btf`: the light's and the view's.

    Raises:
        ConfigError: the directions cannot tell so many coefficients apart.
    """
    return (
        side("light", btf.lights, options.light_terms, options),
        side("view", btf.views, options.view_terms, options),
    )


def fit(
    btf: Bands,
    options: DoubleShOptions | None = None,
    *,
    backend: BackendChoice = "torch",
    progress: Progress = lambda share: None,
) -> ShBtf:
    """Return the double-SH BTF of `btf`.

    Args:
        btf: in memory or on disk.
        options: terms, bound and storage.
        backend: torch, opencl, or auto.
        progress: called with the share done, 0..1.

    Raises:
        ConfigError: the directions cannot tell so many coefficients apart.
        ShapeError: a value of the BTF is not finite.
    """
    options = options or DoubleShOptions()
    light, view = sides(btf, options)
    found = whole(btf, light, view, backend=backend, progress=lambda share: progress(0.9 * share))
    model = model_of(btf, light, view, found, options.storage)
    progress(1.0)
    return model


def whole(
    btf: Bands,
    light: Side,
    view: Side,
    *,
    backend: BackendChoice = "torch",
    progress: Progress = lambda share: None,
) -> Float[Tensor, "k H W 3"]:
    """Return the coefficients of the whole texture, k = (0,0), (0,1), ..., in float16; raises as `coefficients`."""
    height, width = btf.texels
    found = torch.empty(light.terms * view.terms, height, width * 3, dtype=torch.float16)
    for rows, c in coefficients(btf, light, view, bands.layout(btf), backend=backend):
        found[:, rows] = c
        progress(rows.stop / height)
    return found.unflatten(2, (width, 3))


def model_of(
    btf: Bands,
    light: Side,
    view: Side,
    found: Float[Tensor, "k H W 3"],
    storage: Storage,
    share: float = quantize.SHARE,
) -> ShBtf:
    """Return the model of coefficients; of adaptive steps `share` is what they may add to the squared error."""
    step = None
    if storage == "adaptive":
        lost = left_out(btf, light, view, lambda row: found[:, row].flatten(1))
        step = quantize.steps([quantize.spread(c) for c in found], gain(light, view), lost, share)
    maps, scale, offset = quantised(found, storage, step)
    terms = light.terms, view.terms
    return ShBtf(
        maps=maps.unflatten(0, terms), scale=scale.unflatten(0, terms), offset=offset.unflatten(0, terms),
        lights=btf.lights, views=btf.views,
    )  # fmt: skip


def coefficients(
    btf: Bands, light: Side, view: Side, wanted: Sequence[slice], *, backend: BackendChoice = "torch"
) -> Iterator[tuple[slice, Float[Tensor, "k rows column"]]]:
    """Yield bands of texel rows and their coefficients, k = (0,0), (0,1), ... of light and view, in float16.

    Codes go to the kernel as they are stored, floats a row of texels at a time.

    Raises:
        FormatError: the file on disk is damaged.
        ShapeError: a value of the BTF is not finite, or a coefficient too large.
    """
    for band in bands.ahead(btf, wanted):
        n_light, n_view, height, width, _ = band.stored.shape
        where = f"rows {band.rows.start} to {band.rows.stop - 1}"
        if band.stored.dtype == torch.uint8 and opencl.resolve(backend) == "opencl":
            c = _project_codes(band.stored.flatten(2), light, view).flatten(0, 1)
            half = _in_half(c, where).unflatten(1, (height, width * 3))
        else:
            half = torch.empty(light.terms * view.terms, height, width * 3, dtype=torch.float16)
            for row, samples in enumerate(bands.each_row(btf, band)):
                c = project(samples.reshape(n_light, n_view, -1), light, view, backend=backend)
                half[:, row] = _in_half(c.flatten(0, 1), where)
        yield band.rows, half


def _project_codes(codes: UInt8[Tensor, "light view column"], light: Side, view: Side) -> Tensor:
    """Return the coefficients of columns of sRGB codes; black ones, masked texels, cost nothing where they are many."""
    lit = _lit(codes)
    if len(lit) > LIT_SHARE * codes.shape[2]:
        return project(codes, light, view, srgb=True, backend="opencl")
    out = torch.zeros(light.terms, view.terms, codes.shape[2])
    if len(lit):
        out[:, :, lit] = project(codes[:, :, lit], light, view, srgb=True, backend="opencl")
    return out


def _lit(codes: UInt8[Tensor, "light view column"]) -> Tensor:
    """Return the columns that are not black; most are told by their first few samples."""
    dark = (codes[:, 0].amax(0) == 0).nonzero()[:, 0]
    if len(dark):
        dark = dark[codes[:, :, dark].flatten(0, 1).amax(0) == 0]
    keep = torch.ones(codes.shape[2], dtype=torch.bool)
    keep[dark] = False
    return keep.nonzero()[:, 0]


def project(
    samples: Shaped[Tensor, "light view column"],
    light: Side,
    view: Side,
    *,
    unit: float = 1.0,
    srgb: bool = False,
    backend: BackendChoice = "torch",
) -> Float[Tensor, "k_l k_v column"]:
    """Return the coefficients of columns of samples, one stage after the other.

    Args:
        samples: uint8, float32, or float64 on torch; a column is a channel of a texel.
        light: turns the values over the lights into k_l coefficients.
        view: turns those over the views into k_v coefficients.
        unit: T of a sample of 1: 1 / 255 for bytes of linear values.
        srgb: whether samples are uint8 codes in sRGB.
        backend: torch computes in the dtype of the samples.
    """
    if opencl.resolve(backend) == "opencl":
        return _project_opencl(samples, light, view, unit, srgb)
    found = []
    for part in samples.split(COLUMNS, 2):
        floats = part if part.is_floating_point() else part.float()
        values = image.decode_codes(part) if srgb else floats * unit
        found.append(_stage(_stage(values, light).movedim(1, 0), view).movedim(1, 0))
    return torch.cat(found, 2)


def _stage(samples: Float[Tensor, "direction row column"], by: Side) -> Float[Tensor, "k row column"]:
    """Return coefficients in place of the samples."""
    columns = samples.movedim(0, -1)
    energy = None if by.share is None else columns.square() @ by.share.to(columns.dtype)
    return secular.solve(by.factors, columns, energy).c.movedim(-1, 0)


class _Strided(NamedTuple):
    """Samples or coefficients in a buffer: value k of a row's column lies at first + k step + row stride + column."""

    buffer: "opencl.Buffer"
    first: int
    step: int
    stride: int


def _project_opencl(samples: Tensor, light: Side, view: Side, unit: float, srgb: bool) -> Tensor:
    columns, views = samples.shape[2], samples.shape[1]
    if columns < LANES:  # the kernel takes sixteen at a time
        padded = torch.nn.functional.pad(samples, (0, LANES - columns))
        return _project_opencl(padded, light, view, unit, srgb)[:, :, :columns].contiguous()
    samples = opencl.aligned(samples)
    width = min(COLUMNS, columns)
    between = torch.empty(views, light.terms, width)
    out = torch.empty(light.terms, view.terms, columns)
    device, device_between, device_out = (opencl.buffer(x) for x in (samples, between, out))
    tables = _device_factors(light), _device_factors(view)
    codes = ("-DCODES",) * (samples.dtype == torch.uint8) + ("-DSRGB",) * srgb
    for at in range(0, columns, width):
        begin = min(at, columns - width)  # the last chunk is as wide as the others, and does some columns again
        raw = _Strided(device, begin, views * columns, columns)
        half = _Strided(device_between, 0, width, light.terms * width)
        _enqueue(light, tables[0], raw, half, views, width, unit, codes)
        turned = _Strided(device_between, 0, light.terms * width, width)
        whole = _Strided(device_out, begin, columns, view.terms * columns)
        _enqueue(view, tables[1], turned, whole, light.terms, width, 1.0)
    opencl.read([(device_out, out)])
    return out


def _device_factors(by: Side) -> "opencl.Buffer":
    """Return the kernel's `Factors`."""
    f = by.factors
    share = torch.zeros(len(f.left), dtype=torch.float64) if by.share is None else by.share
    square = torch.where(f.values > 0, f.values.square(), 1)
    return opencl.upload(torch.cat([x.flatten() for x in (f.left, share, f.values, square, f.right)]).float().numpy())


def _enqueue(
    by: Side,
    table: "opencl.Buffer",
    source: _Strided,
    target: _Strided,
    rows: int,
    columns: int,
    unit: float,
    codes: tuple[str, ...] = (),
) -> None:
    """Put the fit of rows x columns vectors into the queue."""
    terms = by.terms
    block = -(-terms // -(-terms // REGISTERS))
    options = [f"-DSAMPLES={len(by.factors.left)}", f"-DTERMS={terms}", f"-DBLOCK={block}"]
    options += [*codes, *["-DCONSTRAINED"] * (by.share is not None)]
    run = opencl.kernel("compress/double_sh.cl", "fit", tuple(options))
    places = [np.int64(x) for x in (*source[1:], *target[1:])]
    size = -(-columns // (LANES * GROUPS)), rows
    run(opencl.queue(), size, (1, 1), table, source.buffer, target.buffer, np.int32(columns), *places, np.float32(unit))


def _in_half(c: Float[Tensor, "k column"], where: str) -> Float[Tensor, "k column"]:
    """Return coefficients in float16, which ends at 65,504."""
    half = c.half()
    if not bool(torch.isfinite(half).all()):
        raise ShapeError(
            f"compress: expected coefficients up to 65,504, got {float(c.abs().max()):g} in {where}; scale the BTF down"
        )
    return half


def quantised(
    found: Float[Tensor, "k H W 3"], storage: Storage, step: Float[Tensor, "k 3"] | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """Return codes, scale and offset of every coefficient and channel."""
    parts = [
        quantize.quantize(c.float()[..., None, :], storage, None if step is None else step[k, None])
        for k, c in enumerate(found)
    ]
    codes, scale, offset = (torch.stack(x).squeeze(-2) for x in zip(*parts, strict=True))
    return codes, scale, offset


def gain(light: Side, view: Side) -> Float[Tensor, "k"]:
    """Return the mean squared T of coefficients of 1, (0,0), (0,1), ..., over all pairs of directions."""
    over_light, over_view = (side.factors.matrix.square().mean(0) for side in (light, view))
    return (over_light[:, None] * over_view).flatten()


def left_out(btf: Bands, light: Side, view: Side, coefficients: Callable[[int], Float[Tensor, "k column"]]) -> float:
    """Return the mean squared error of T, before quantisation, in `ROWS` rows of texels spread over the texture.

    `coefficients` is called with a row.
    """
    height = btf.texels[0]
    rows = sorted({(2 * n + 1) * height // (2 * ROWS) for n in range(ROWS)})
    Y_light, Y_view = (side.factors.matrix.float() for side in (light, view))
    total = 0.0
    for row in rows:
        T = btf.rows(row, row + 1)
        c = coefficients(row).float().unflatten(0, (light.terms, view.terms))
        shown = torch.einsum("li,vj,ijx->lvx", Y_light, Y_view, c)
        total += float((shown - T.flatten(2)).square().mean(dtype=torch.float64))
    return total / len(rows)
