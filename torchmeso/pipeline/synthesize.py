"""The job `torchmeso synthesize`: a model or a picture in, a quilting map out.

Test: tests/pipeline/test_synthesize.py
"""

from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.backends import BackendChoice
from torchmeso.data import address, image, quilting_map
from torchmeso.errors import ConfigError, FormatError
from torchmeso.geometry.directions import from_angles
from torchmeso.pipeline.bake import Report, open_model, silent
from torchmeso.synthesize import patch_error, quilting
from torchmeso.synthesize.patch_error import Exemplar, Look, Metric
from torchmeso.synthesize.quilting import Quilt, QuiltingOptions

PICTURES = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
"""Kinds of pictures that can be quilted: as they are shown, sRGB."""

SHOWN_LIGHT_DEG = 45.0
"""Where the light stands in pictures of a BTF; the viewer looks straight down."""


class Done(NamedTuple):
    """What was made.

    Attributes:
        quilt: the map and how it came about.
        source: what it was cut from.
    """

    quilt: Quilt
    source: Exemplar


def quilt(
    path: str | Path,
    size: tuple[int, int],
    options: QuiltingOptions,
    out: str | Path,
    *,
    bands: int | None = None,
    seed: int = 0,
    pictures: str | Path | None = None,
    backend: BackendChoice = "auto",
    report: Report = silent,
) -> Done:
    """Quilt the BTF model or the picture at `path`, and write the map; of a picture the quilted one, if so named.

    Args:
        path: .meso, or a picture.
        size: height and width in texels.
        options: of the quilting.
        out: .quilt, or of a picture .png too.
        bands: see `patch_error.Metric`.
        seed: the same one gives the same map.
        pictures: folder for pictures of the map, the cuts and the seams.
        backend: where seams are found.
        report: progress.

    Raises:
        MesoError: a file is missing or no exemplar, or an option is out of range.
    """
    look, show = open_look(path)
    if Path(out).suffix.lower() not in ((".quilt", ".png") if isinstance(look, Tensor) else (".quilt",)):
        raise ConfigError(f"{out}: expected a name that ends in .quilt, or for a picture in .png")
    report("exemplar", 0)
    source = patch_error.exemplar(look, Metric(bands=bands))
    report("exemplar", 1)
    rng = torch.Generator().manual_seed(seed)
    found = quilting.grow(source, size, options, rng=rng, backend=backend, progress=partial(report, "quilting"))
    if Path(out).suffix.lower() == ".png":
        image.write_png(out, found.map.apply(show()))
    else:
        about = {**asdict(options), "bands": bands, "seed": seed, "made from": Path(path).name}
        quilting_map.save(found.map, out, **{name: x for name, x in about.items() if x is not None})
    if pictures is not None:
        for name, picture in draw(found, show()).items():
            image.write_png(Path(pictures) / f"{name}.png", picture)
    return Done(found, source)


def open_look(path: str | Path) -> tuple[Look, Callable[[], Float[Tensor, "H W 3"]]]:
    """Return what to grow from, and what shows it as a picture. Of pictures sRGB values are compared, as eyes do.

    Raises:
        FormatError: the file is missing, damaged, or neither a model nor a picture.
    """
    path = Path(path)
    if path.suffix.lower() in PICTURES:
        shown = image.read(path)
        return image.to_srgb(shown), lambda: shown
    if path.suffix.lower() != ".meso":
        raise FormatError(f"{path}: expected a model (.meso) or a picture ({', '.join(PICTURES)})")
    btf = open_model(path, depth=False).btf
    assert isinstance(btf, patch_error.Look)

    def shown_model() -> Tensor:
        uv = address.texel_centres(*btf.texels)
        wi = from_angles(torch.tensor(SHOWN_LIGHT_DEG).deg2rad(), torch.tensor(0.8)).expand(*uv.shape[:2], 3)
        T = btf.evaluate(uv, wi, torch.tensor([0.0, 0.0, 1.0]).expand(*uv.shape[:2], 3))
        return T / T.quantile(0.99).clamp(min=1e-6)

    return btf, shown_model


def draw(found: Quilt, exemplar: Float[Tensor, "H W 3"]) -> dict[str, Float[Tensor, "_ _ 3"]]:
    """Return pictures by name: look, map (red = column, green = row of the exemplar), cuts (patches), seams."""
    height, width = found.map.source
    look = found.map.apply(exemplar)
    row, column = (x.float() for x in (found.map.index // width, found.map.index % width))
    places = torch.stack([column / max(width - 1, 1), row / max(height - 1, 1), torch.full_like(row, 0.5)], -1)
    hues = torch.rand(int(found.patch.max()) + 1, 3, generator=torch.Generator().manual_seed(1))
    right, below = found.map.seams()
    seams = torch.where((right | below).unsqueeze(-1), torch.tensor([1.0, 0.0, 0.0]), 0.6 * look)
    return {"look": look, "map": places, "cuts": hues[found.patch.long()], "seams": seams}
