"""The jobs `torchmeso synthesize --method wang` and `torchmeso tile`: a look in, Wang tiles out; tiles in, a map out.

Test: tests/pipeline/test_tiles.py
"""

from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.backends import BackendChoice
from torchmeso.data import image, quilting_map, tile_set
from torchmeso.data.quilting_map import QuiltingMap
from torchmeso.data.tile_set import TileSet
from torchmeso.errors import ConfigError, ShapeError
from torchmeso.pipeline.bake import Report, silent
from torchmeso.pipeline.synthesize import open_look
from torchmeso.synthesize import patch_error, tiling, wang
from torchmeso.synthesize.patch_error import Exemplar, Metric
from torchmeso.synthesize.wang import Feature, Wang, WangOptions

GAP = 2
"""Texels between tiles in a picture of them."""


class Made(NamedTuple):
    """What was made.

    Attributes:
        wang: the tiles and how they came about.
        source: what they were cut from.
    """

    wang: Wang
    source: Exemplar


def make(
    path: str | Path,
    options: WangOptions,
    out: str | Path,
    *,
    bands: int | None = None,
    seed: int = 0,
    features: tuple[Feature, ...] = (),
    pictures: str | Path | None = None,
    backend: BackendChoice = "auto",
    report: Report = silent,
) -> Made:
    """Cut Wang tiles from the BTF model or the picture at `path`, and write them.

    Args:
        path: .meso, or a picture.
        options: of the tiles.
        out: .tiles.
        bands: see `patch_error.Metric`.
        seed: the same one gives the same tiles.
        features: what is put somewhere and stays.
        pictures: folder for pictures of the tiles, their seams and a tiled plane.
        backend: where cuts are found.
        report: progress.

    Raises:
        MesoError: a file is missing or no exemplar, or an option is out of range.
    """
    if Path(out).suffix.lower() != ".tiles":
        raise ConfigError(f"{out}: expected a name that ends in .tiles")
    look, show = open_look(path)
    report("exemplar", 0)
    source = patch_error.exemplar(look, Metric(bands=bands))
    report("exemplar", 1)
    rng = torch.Generator().manual_seed(seed)
    found = wang.grow(
        source, options, rng=rng, features=features, backend=backend, progress=partial(report, "tiles")
    )  # fmt: skip
    about = {**asdict(options), "bands": bands, "seed": seed, "made from": Path(path).name}
    tile_set.save(found.set, out, **{name: x for name, x in about.items() if x is not None})
    if pictures is not None:
        for name, picture in draw(found, show(), seed).items():
            image.write_png(Path(pictures) / f"{name}.png", picture)
    return Made(found, source)


def draw(found: Wang, exemplar: Float[Tensor, "H W 3"], seed: int = 0) -> dict[str, Float[Tensor, "_ _ 3"]]:
    """Return pictures by name: tiles, seams (red, as strong as they show), plane (8 x 8 tiles)."""
    tiles = found.set
    looks = exemplar.flatten(0, 1)[tiles.shown().long()]
    shown = found.errors / found.errors.flatten().float().quantile(0.99).clamp(min=1)
    red = torch.tensor([1.0, 0.0, 0.0])
    seams = torch.lerp(0.6 * looks, red, shown.clamp(0, 1).unsqueeze(-1).to(looks.dtype))
    plane = tiles.lay(tiling.plane(tiles, 8, 8, seed=seed))
    return {"tiles": _side_by_side(looks), "seams": _side_by_side(seams), "plane": plane.apply(exemplar)}


def _side_by_side(tiles: Float[Tensor, "T w w 3"]) -> Float[Tensor, "_ _ 3"]:
    columns = max(round(len(tiles) ** 0.5), 1)
    missing = -len(tiles) % columns
    framed = torch.nn.functional.pad(tiles, (0, 0, 0, GAP, 0, GAP), value=1)
    framed = torch.cat([framed, framed.new_ones(missing, *framed.shape[1:])])
    return framed.unflatten(0, (-1, columns)).movedim(2, 1).flatten(2, 3).flatten(0, 1)


def lay(
    path: str | Path,
    size: tuple[int, int],
    out: str | Path,
    *,
    hashed: bool = True,
    seed: int = 0,
    exemplar: str | Path | None = None,
) -> QuiltingMap:
    """Lay tiles over the plane and write it, as a map or as a picture.

    Args:
        path: .tiles.
        size: rows and columns of tiles.
        out: .quilt, or with `exemplar` .png.
        hashed: by a hash of each cell, which repeats without a seam; else in scanlines, which does not.
        seed: the same one gives the same tiling.
        exemplar: model or picture to show.

    Raises:
        MesoError: a file is missing or another's, or the size is out of range.
    """
    wanted = ".quilt" if exemplar is None else ".png"
    if Path(out).suffix.lower() != wanted:
        raise ConfigError(f"{out}: expected a name that ends in {wanted}")
    tiles = tile_set.load(path)
    found = tiles.lay(_cells(tiles, size, hashed, seed), tileable=hashed)
    if exemplar is None:
        about = {"seed": seed, "plane": f"{size[1]} x {size[0]} tiles", "made from": Path(path).name}
        quilting_map.save(found, out, **about)
        return found
    shown = open_look(exemplar)[1]()
    if tuple(shown.shape[:2]) != tiles.source:
        raise ShapeError(
            f"{exemplar}: expected the {tiles.source[1]} x {tiles.source[0]} texels that the tiles were cut from, got "
            f"{shown.shape[1]} x {shown.shape[0]}"
        )
    image.write_png(out, found.apply(shown))
    return found


def _cells(tiles: TileSet, size: tuple[int, int], hashed: bool, seed: int) -> Tensor:
    if hashed:
        return tiling.plane(tiles, *size, seed=seed)
    return tiling.scanlines(tiles, *size, rng=torch.Generator().manual_seed(seed))
