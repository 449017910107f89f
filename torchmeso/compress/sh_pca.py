"""Fit an SH + PCA BTF: spherical harmonics over the light, then principal components over views and texels.

kawasaki2005quilting, section 2. The samples f over the lights of every view, texel and channel become a vector
z = P f, the vectors of the three channels become one, and the principal components v_k of all of these (not centred:
eq. (1) adds no mean) give weights W_k = v_k . z and the basis b_k = Q v_k. Two ways over the light:

- `sphere_projection` (the paper's): samples are interpolated over the triangles between the lights onto the texels of
  a cube map, fall off below the last ring, are zero below the horizon, and are summed with y_m and solid angles; Q = 1.
- `hemisphere_fit` (default): least squares at the L lights with a ridge, |f - Y c|^2 + r |c|^2, r = ridge L / 4 pi.
  With Y = U S V^T the vector is z = U^T f and Q = V S / (S^2 + r): what PCA leaves out, and what eight bits lose, is
  then an error of T at the lights and not one of coefficients, whose lengths say little on a hemisphere (the condition
  of Y^T Y is 8e6 for 25 coefficients on ubo81). The ridge is for what lies between the lights: 1e-4 costs 0.1 dB at
  the lights of a brick and wins 0.1 dB (25 coefficients) and 3.9 dB (36) between them.

The components come from the Gram matrix of all vectors, which is exact, or from a sample of them (`training`, the
paper's). Rows of texels are computed one by one: bands of any height give the same bits.

Test: tests/compress/test_sh_pca.py
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.algebra import secular
from torchmeso.algebra.gram import right_basis
from torchmeso.algebra.spherical_harmonics import basis, degree_of, project
from torchmeso.compress.kept_maps import KeptMaps
from torchmeso.compress.quantize import Codes, Storage, quantize
from torchmeso.data import bands
from torchmeso.data.btf import Bands, horizon_falloff
from torchmeso.data.journal import InMemory, Parts
from torchmeso.data.sh_pca_btf import Domain, ShPcaBtf
from torchmeso.errors import ConfigError, check_range
from torchmeso.geometry import cube_map, hemisphere, triangulation
from torchmeso.geometry.hemisphere import DirectionSet

FACE = 64
"""Texels along a face of the cube map: 25 coefficients of ubo81 lie within 1e-3 of those of a finer one."""

Progress = Callable[[float], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class ShPcaOptions:
    """How to compress.

    Attributes:
        rank: components K kept, at most three per coefficient.
        light_terms: coefficients over the light: 1, 4, 9, 16, 25 or 36.
        domain: least squares at the lights, or the paper's projection on a cube map.
        ridge: how much small coefficients count beside small errors, least squares only; 0 = not at all.
        training: vectors that the components are found from, drawn at random; None = all of them.
        storage: uint8, float16 or float32.
        regularise: let lights that cannot tell the coefficients apart pass, with the smallest coefficients.
    """

    rank: int = 16
    light_terms: int = 25
    domain: Domain = "hemisphere_fit"
    ridge: float = 1e-4
    training: int | None = None
    storage: Storage = "uint8"
    regularise: bool = False

    def __post_init__(self) -> None:
        """Raise ConfigError for terms that are no whole bands, or a rank or sample that does not go with them."""
        degree_of(self.light_terms)
        if not 1 <= self.rank <= 3 * self.light_terms:
            raise ConfigError(
                f"compress.rank: expected 1 to {3 * self.light_terms} (three channels of {self.light_terms} "
                f"coefficients), got {self.rank}"
            )
        if self.storage == "adaptive":
            raise ConfigError("compress.storage: SH + PCA has no adaptive steps; take uint8, float16 or float32")
        check_range("compress.ridge", self.ridge, 0, 1e6)
        if self.training is not None:
            check_range("compress.training", self.training, self.rank, 1e9)


class Projection(NamedTuple):
    """What turns samples over the light into vectors, and components of these into coefficients.

    Attributes:
        vector: (n, light) P.
        coefficient: (n, n) Q.
    """

    vector: Float[Tensor, "n light"]
    coefficient: Float[Tensor, "n n"]


def projection(lights: DirectionSet, options: ShPcaOptions) -> Projection:
    """Return the way over the light, in float64.

    Raises:
        ConfigError: the lights cannot tell so many coefficients apart, where least squares are asked for.
    """
    degree = degree_of(options.light_terms)
    if options.domain == "hemisphere_fit":
        Y = basis(lights.directions(torch.float64), degree)
        found = secular.factorise(Y, f"compress: light ({lights.name})", regularise=options.regularise)
        square = torch.where(found.values > 0, found.values.square(), 1)
        inverse = found.values / (square + options.ridge * len(lights) / (4 * math.pi))
        return Projection(found.left.mT.contiguous(), found.right * inverse)
    cube = cube_map.texels(FACE)
    # Each light in turn is 1 and the others 0: the matrix of everything that is linear in them.
    c = project(_onto_cube(lights, cube).mT, cube.directions, cube.solid_angle, degree)
    return Projection(c.mT.contiguous(), torch.eye(options.light_terms, dtype=torch.float64))


def _onto_cube(lights: DirectionSet, cube: cube_map.CubeMap) -> Float[Tensor, "texel light"]:
    """Return the share of every light in the texels of a cube map; T falls off below the last ring and ends at 0."""
    taps = triangulation.interpolate(lights, cube.directions)
    nodes = hemisphere.with_pole(torch.eye(len(lights), dtype=torch.float64), lights)
    falloff = horizon_falloff(lights, cube.directions)
    return torch.einsum("tk,tkl->tl", taps.weight, nodes[taps.node]) * falloff


class Fitted(NamedTuple):
    """An SH + PCA BTF in parts of a job.

    Attributes:
        maps: weights W, (view, H, W) of each component.
        basis: (rank, coefficient, 3) b.
    """

    maps: KeptMaps
    basis: Float[Tensor, "rank m 3"]

    def component(self, k: int, storage: Storage) -> Codes:
        """Return the codes (view, H, W) of the weights of a component, their scale and their offset."""
        found = quantize(self.maps.collected(k)[0, ..., None, None], storage)
        return Codes(found.codes[..., 0, 0], found.scale[0, 0], found.offset[0, 0])


def fit(
    btf: Bands,
    options: ShPcaOptions | None = None,
    *,
    rng: torch.Generator | None = None,
    progress: Progress = lambda share: None,
) -> ShPcaBtf:
    """Return the SH + PCA BTF of `btf`.

    Args:
        btf: in memory or on disk.
        options: components, coefficients, domain, training and storage.
        rng: draws the vectors of `training`; the same ones every time where it is None.
        progress: called with the share done, 0..1.

    Raises:
        ConfigError: the lights cannot tell so many coefficients apart.
        ShapeError: a value of the BTF is not finite.
    """
    options = options or ShPcaOptions()
    found = fit_parts(btf, options, InMemory(), rng=rng, progress=progress)
    maps, scale, offset = zip(*(found.component(k, options.storage) for k in range(options.rank)), strict=True)
    return ShPcaBtf(
        maps=torch.stack(maps, -1), scale=torch.stack(scale), offset=torch.stack(offset), basis=found.basis,
        lights=btf.lights, views=btf.views, domain=options.domain,
    )  # fmt: skip


def fit_parts(
    btf: Bands,
    options: ShPcaOptions,
    parts: Parts,
    *,
    rng: torch.Generator | None = None,
    progress: Progress = lambda share: None,
) -> Fitted:
    """Return what `fit` returns, in `parts`, from where an earlier run stopped: a band is in memory at a time."""
    through = projection(btf.lights, options)
    P = through.vector.float()
    n, layout = 3 * options.light_terms, bands.layout(btf)
    trained = _trained(btf, options, rng or torch.Generator().manual_seed(0))
    total, todo = torch.zeros(n, n, dtype=torch.float64), layout
    for at, rows in enumerate(layout):
        if parts.has(_gram_of(rows), (n, n), torch.float64):
            total, todo = parts.read(_gram_of(rows), (n, n), torch.float64), layout[at + 1 :]
    for rows, sum_so_far in _grams(btf, P, trained, todo, total):
        total = sum_so_far
        parts.write(_gram_of(rows), total)
        progress(0.5 * rows.stop / btf.texels[0])
    components = right_basis((total + total.mT) / 2, options.rank).vectors
    maps = KeptMaps(
        parts=parts, name="W", layout=tuple(layout), count=options.rank, before=(len(btf.views),),
        after=(btf.texels[1],), dtype=torch.float32,
    )  # fmt: skip
    V, around = components.float(), (len(btf.views), btf.texels[1])

    def weights(samples: Float[Tensor, "light view W 3"]) -> Float[Tensor, "rank view W"]:
        return (_vectors(samples, P) @ V).unflatten(0, around).permute(2, 0, 1)

    maps.keep_rows(btf, weights, lambda share: progress(0.5 + 0.5 * share))
    b = torch.einsum("mn,nck->kmc", through.coefficient, components.unflatten(0, (-1, 3)))
    return Fitted(maps, b.float())


def _gram_of(rows: slice) -> str:
    return f"gram.{rows.start}-{rows.stop}"


def _trained(btf: Bands, options: ShPcaOptions, rng: torch.Generator) -> dict[int, Tensor] | None:
    """Return the vectors to train on, (view, column) counted within each texel row that has some; None = all."""
    height, width = btf.texels
    each = len(btf.views) * width
    if options.training is None or options.training >= height * each:
        return None
    places = torch.randperm(height * each, generator=rng)[: options.training].sort().values
    rows = places // each
    return {row: places[rows == row] % each for row in rows.unique().tolist()}


def _grams(
    btf: Bands,
    P: Float[Tensor, "n light"],
    trained: dict[int, Tensor] | None,
    wanted: Sequence[slice],
    total: Float[Tensor, "vector vector"],
) -> Iterator[tuple[slice, Float[Tensor, "vector vector"]]]:
    """Yield bands of texel rows and the Gram matrix of `total` and all vectors so far that components are found from.

    Of a band only the rows from the first to the last that has such vectors are read.
    """
    asked = [[row for row in range(b.start, b.stop) if trained is None or row in trained] for b in wanted]
    needed = [(rows, chosen) for rows, chosen in zip(wanted, asked, strict=True) if chosen]
    read = bands.ahead(btf, [slice(chosen[0], chosen[-1] + 1) for _, chosen in needed])
    for (rows, chosen), band in zip(needed, read, strict=True):
        for row in chosen:
            z = _vectors(bands.linear_row(btf, band, row - band.rows.start), P)
            z = z if trained is None else z[trained[row]]
            total = total + (z.mT @ z).double()
        yield rows, total


def _vectors(samples: Float[Tensor, "light view W 3"], P: Float[Tensor, "n light"]) -> Float[Tensor, "_ vector"]:
    """Return the vectors (view and column, coefficient and channel) of a texel row."""
    return (P @ samples.flatten(1)).unflatten(1, (-1, 3)).movedim(0, 1).flatten(1)
