"""Fits that go from a file to a file: neither the BTF nor the model is ever in memory, and a killed fit goes on.

Bands of texel rows are fitted as in `compress.double_sh` and `compress.eigen`, and kept in a journal beside the model
(`data.journal`); a model needs the range of each of its maps before the first code can be written. Then one map after
the other is collected over the bands, quantised and written. The file holds what `fit` and `save` would give, bit for
bit. Adaptive steps need the spread of all maps first: these are then collected twice, and the streams are in memory
until the last one is there. The factors of one decomposition per channel are in memory, and kept after every pass.

Test: tests/compress/test_stream.py
"""

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import torch
from torch import Tensor

from torchmeso.algebra.gram import right_basis
from torchmeso.backends import BackendChoice
from torchmeso.compress import double_sh, eigen, factored, quantize, sh_pca
from torchmeso.compress.double_sh import DoubleShOptions, quantised
from torchmeso.compress.eigen import EigenOptions
from torchmeso.compress.eigen_budget import kept_scores
from torchmeso.compress.factored import FactoredOptions
from torchmeso.compress.kept_maps import KeptMaps
from torchmeso.compress.sh_pca import ShPcaOptions
from torchmeso.data import bands, eigen_btf, factored_btf, journal, sh_btf, sh_pca_btf, store
from torchmeso.data.btf import Bands
from torchmeso.data.journal import Journal
from torchmeso.data.mdf import Mdf

Progress = Callable[[float], None]


def fit(
    btf: Bands,
    options: EigenOptions | DoubleShOptions | ShPcaOptions | FactoredOptions,
    path: str | Path,
    *,
    key: str,
    backend: BackendChoice = "auto",
    silhouette: Mdf | None = None,
    progress: Progress = lambda share: None,
) -> None:
    """Write the model of `btf` to `path` (.meso), from where an earlier run with the same `key` and options stopped.

    Args:
        btf: on disk or in memory.
        options: of the method.
        path: of the model.
        key: says which BTF it is, and changes with it.
        backend: of double SH.
        silhouette: the material's MDF, packed into the model.
        progress: called with the share done, 0..1.

    Raises:
        ConfigError: the options do not fit the BTF's directions.
        FormatError: the file on disk is damaged.
        ShapeError: a value of the BTF is not finite, or a coefficient too large.
        StorageError: the disk is full, or the place cannot be written to.
    """
    layout = bands.layout(btf)
    job = store.content_hash(
        key, type(options).__name__, asdict(options), backend, [(rows.start, rows.stop) for rows in layout]
    )
    if isinstance(options, EigenOptions):
        eigen.check(btf, options)
        with journal.beside(path, job) as kept:
            _fit_eigen(btf, options, layout, kept, path, silhouette, progress)
    elif isinstance(options, ShPcaOptions):
        sh_pca.projection(btf.lights, options)  # refuses before anything is written
        with journal.beside(path, job) as kept:
            _fit_sh_pca(btf, options, kept, path, silhouette, progress)
    elif isinstance(options, FactoredOptions):
        factored.check(btf, options)
        with journal.beside(path, job) as kept:
            factored_btf.save(factored.fit(btf, options, kept=kept, progress=progress), path, silhouette=silhouette)
    else:
        sides = double_sh.sides(btf, options)
        with journal.beside(path, job) as kept:
            _fit_double_sh(btf, options, sides, layout, kept, path, backend, silhouette, progress)


def _fit_double_sh(
    btf: Bands,
    options: DoubleShOptions,
    sides: tuple[double_sh.Side, double_sh.Side],
    layout: list[slice],
    kept: Journal,
    path: str | Path,
    backend: BackendChoice,
    silhouette: Mdf | None,
    progress: Progress,
) -> None:
    light, view = sides
    height, width = btf.texels
    maps = KeptMaps(
        parts=kept, name="c", layout=tuple(layout), count=light.terms * view.terms, before=(), after=(width * 3,),
        dtype=torch.float16,
    )  # fmt: skip
    fitted = double_sh.coefficients(btf, light, view, maps.todo(), backend=backend)
    maps.keep(fitted, lambda share: progress(0.8 * share))

    def collected(i: int) -> Tensor:
        """Return all coefficients (i, 0), (i, 1), ..."""
        return maps.collected(i * view.terms, view.terms).unflatten(2, (width, 3))

    step = None
    if options.storage == "adaptive":
        spreads = [quantize.spread(c) for i in range(light.terms) for c in collected(i)]
        lost = double_sh.left_out(btf, light, view, maps.row)
        step = quantize.steps(spreads, double_sh.gain(light, view), lost).unflatten(0, (light.terms, view.terms))

    def coefficients(i: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return codes, scale and offset of all coefficients (i, 0), (i, 1), ..."""
        found = quantised(collected(i), options.storage, None if step is None else step[i])
        progress(0.8 + 0.2 * (i + 1) / light.terms)
        return found

    sh_btf.write(
        path, coefficients, terms=(light.terms, view.terms), texels=(height, width),
        dtype=quantize.dtype_of(options.storage), lights=btf.lights, views=btf.views, silhouette=silhouette,
        coded=options.storage == "adaptive",
    )  # fmt: skip


def _fit_eigen(
    btf: Bands,
    options: EigenOptions,
    layout: list[slice],
    kept: Journal,
    path: str | Path,
    silhouette: Mdf | None,
    progress: Progress,
) -> None:
    height, width = btf.texels
    n_view = len(btf.views)
    square = n_view, n_view
    total, todo = torch.zeros(square, dtype=torch.float64), layout
    for at, rows in enumerate(layout):
        if kept.has(_name("gram", rows), square, torch.float64):
            total, todo = kept.read(_name("gram", rows), square, torch.float64), layout[at + 1 :]
    for rows, sum_so_far in eigen.grams(btf, todo, total):
        total = sum_so_far
        kept.write(_name("gram", rows), total)
        progress(0.4 * rows.stop / height)
    W = right_basis(total, options.rank).vectors.float()

    maps = kept_scores(btf, W, kept, "E", lambda share: progress(0.4 + 0.4 * share))
    step = None
    if options.storage == "adaptive":
        spreads = (quantize.spread(maps.collected(k)[0]) for k in range(options.rank))
        step = eigen.adaptive_steps(btf, options.rank, total, spreads)

    def component(k: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return codes, scale and offset of one eigen map."""
        found = maps.collected(k)[0][..., None, :]
        codes = quantize.quantize(found, options.storage, None if step is None else step[k, None])
        progress(0.8 + 0.2 * (k + 1) / options.rank)
        return codes.codes[..., 0, :], codes.scale[0], codes.offset[0]

    eigen_btf.write(
        path, component, weights=W, texels=(height, width), dtype=quantize.dtype_of(options.storage),
        lights=btf.lights, views=btf.views, silhouette=silhouette, coded=options.storage == "adaptive",
    )  # fmt: skip


def _fit_sh_pca(
    btf: Bands, options: ShPcaOptions, kept: Journal, path: str | Path, silhouette: Mdf | None, progress: Progress
) -> None:
    found = sh_pca.fit_parts(btf, options, kept, progress=lambda share: progress(0.8 * share))

    def component(k: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return codes, scale and offset of the weights of one component."""
        codes = found.component(k, options.storage)
        progress(0.8 + 0.2 * (k + 1) / options.rank)
        return codes

    sh_pca_btf.write(
        path, component, basis=found.basis, texels=btf.texels, dtype=quantize.dtype_of(options.storage),
        lights=btf.lights, views=btf.views, domain=options.domain, silhouette=silhouette,
    )  # fmt: skip


def _name(what: str, rows: slice) -> str:
    return f"{what}.{rows.start}-{rows.stop}"
