"""Fits to a budget that go from a file to a file: neither the BTF nor the model is ever in memory.

Coefficients, maps and codes of everything that is tried lie in a journal beside the model (`data.journal`), four bytes
for each of their values, and what a killed search found is not looked for again. The file holds what `fit` and `save`
of the method would give, bit for bit.

Test: tests/compress/test_budget_stream.py
"""

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

from torchmeso.backends import BackendChoice
from torchmeso.compress import double_sh_budget, eigen_budget, quantize, transform
from torchmeso.compress.budget import Budget
from torchmeso.compress.double_sh import DoubleShOptions
from torchmeso.compress.eigen import EigenOptions
from torchmeso.compress.transform import TransformOptions
from torchmeso.data import bands, eigen_btf, journal, sh_btf, store, transform_btf
from torchmeso.data.btf import Bands
from torchmeso.data.journal import Parts
from torchmeso.data.mdf import Mdf
from torchmeso.data.transform_btf import packed

Progress = Callable[[float], None]


def fit(
    btf: Bands,
    options: EigenOptions | DoubleShOptions | TransformOptions,
    wanted: Budget,
    path: str | Path,
    *,
    key: str,
    backend: BackendChoice = "auto",
    silhouette: Mdf | None = None,
    progress: Progress = lambda share: None,
) -> float:
    """Write the model of `btf` that keeps a budget to `path` (.meso); return its measured PSNR in dB.

    Args:
        btf: on disk or in memory.
        options: of the method, and the most it may take: components, or coefficients.
        wanted: the budget.
        path: of the model.
        key: says which BTF it is, and changes with it.
        backend: of double SH.
        silhouette: the material's MDF, packed into the model.
        progress: called with the share done, 0..1.

    Raises:
        ConfigError: the options do not fit the BTF's directions, or the budget cannot be reached.
        FormatError: the file on disk is damaged.
        ShapeError: a value of the BTF is not finite, or a coefficient too large.
        StorageError: the disk is full, or the place cannot be written to.
    """
    layout = [(rows.start, rows.stop) for rows in bands.layout(btf)]
    job = store.content_hash(key, type(options).__name__, asdict(options), asdict(wanted), backend, layout)
    with journal.beside(path, job) as parts:
        if isinstance(options, EigenOptions):
            return _eigen(btf, options, wanted, path, parts, silhouette, progress)
        if isinstance(options, DoubleShOptions):
            return _double_sh(btf, options, wanted, path, parts, backend, silhouette, progress)
        return _transform(btf, options, wanted, path, parts, silhouette, progress)


def _eigen(
    btf: Bands,
    options: EigenOptions,
    wanted: Budget,
    path: str | Path,
    parts: Parts,
    silhouette: Mdf | None,
    progress: Progress,
) -> float:
    storage = options.storage
    found = eigen_budget.search(btf, wanted, parts, storage=storage, rank=options.rank, progress=progress)
    eigen_btf.write(
        path, found.component, weights=found.weights, texels=btf.texels, dtype=quantize.dtype_of(storage),
        lights=btf.lights, views=btf.views, silhouette=silhouette, coded=storage == "adaptive",
        psnr=round(found.psnr, 2),
    )  # fmt: skip
    return found.psnr


def _double_sh(
    btf: Bands,
    options: DoubleShOptions,
    wanted: Budget,
    path: str | Path,
    parts: Parts,
    backend: BackendChoice,
    silhouette: Mdf | None,
    progress: Progress,
) -> float:
    storage = options.storage
    found = double_sh_budget.search(btf, wanted, options, parts, backend=backend, progress=progress)
    sh_btf.write(
        path, found.coefficients, terms=found.terms, texels=btf.texels, dtype=quantize.dtype_of(storage),
        lights=btf.lights, views=btf.views, silhouette=silhouette, coded=storage == "adaptive",
        psnr=round(found.psnr, 2),
    )  # fmt: skip
    return found.psnr


def _transform(
    btf: Bands,
    options: TransformOptions,
    wanted: Budget,
    path: str | Path,
    parts: Parts,
    silhouette: Mdf | None,
    progress: Progress,
) -> float:
    found = transform.search(btf, wanted, options, parts, progress)
    light, view, colour = found.bases
    transform_btf.write(
        path, map(packed, found.codes()), texels=btf.texels, light_basis=light, view_basis=view, colour_basis=colour,
        step=found.step, lights=btf.lights, views=btf.views, silhouette=silhouette, psnr=round(found.psnr, 2),
    )  # fmt: skip
    return found.psnr
