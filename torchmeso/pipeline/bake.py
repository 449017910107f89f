"""Materials as a configuration asks for them: baked, compressed, and kept by content.

What was made once from the same mesostructure, options and code lies in the cache (`data.store.cache_dir`) and is
only opened; a bake that was cut off goes on where it stopped.

Test: tests/pipeline/test_bake.py
"""

import hashlib
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import torch

from torchmeso.compress import factored, stream
from torchmeso.compress.double_sh import DoubleShOptions
from torchmeso.compress.eigen import EigenOptions
from torchmeso.compress.sh_pca import ShPcaOptions
from torchmeso.config_sections import Config, MaterialConfig, MesoConfig
from torchmeso.data import (
    btf,
    eigen_btf,
    factored_btf,
    gdm,
    gdm_coded,
    gdm_svd,
    image,
    journal,
    mdf,
    quilting_map,
    sh_btf,
    sh_pca_btf,
    store,
    textured,
    tile_atlas,
    tile_set,
    transform_btf,
)
from torchmeso.data.textured import Textured
from torchmeso.data.tile_set import TileSet
from torchmeso.errors import ConfigError, FormatError
from torchmeso.geometry.mesh_file import Finish
from torchmeso.meso import bake_btf, bake_gdm, bake_mdf
from torchmeso.render.scene import Material, quilted
from torchmeso.synthesize import patch_error, wang
from torchmeso.synthesize.patch_error import Metric

Report = Callable[[str, float], None]
"""Called with what is being done and the share done, 0..1."""

CODE = ("meso", "transport", "geometry", "data", "compress", "algebra")
"""Folders whose code decides what a bake holds."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Asset:
    """A material ready to render, and what it took.

    Attributes:
        material: for `render`.
        seconds: wall time by step, empty where everything came from the cache.
        raw_bytes: BTF and MDF on disk before compression; 0 where no table was baked.
        model_bytes: the run-time model.
        tiles: what lays the material out, where it is tiles.
    """

    material: Material
    seconds: dict[str, float]
    raw_bytes: int
    model_bytes: int
    tiles: TileSet | None = None


def silent(what: str, share: float) -> None:
    """Report nothing."""


def prepare(config: Config, report: Report = silent) -> dict[str, Asset]:
    """Return the materials that the objects of `config` use, baking what is not in the cache.

    Raises:
        MesoError: a file is missing, or an option is out of range.
    """
    used = set().union(*(item.used_materials for item in config.objects))
    depth = config.render.silhouette != "none"
    return {
        name: prepare_material(name, m, report, depth=depth) for name, m in config.materials.items() if name in used
    }


def prepare_material(name: str, material: MaterialConfig, report: Report = silent, *, depth: bool = True) -> Asset:
    """Return one material, baked and compressed or from the cache; without `depth` its MDF stays on disk."""
    asset = _prepare(name, material, report, depth=depth)
    if material.tiled:
        tiles = _tiles(name, material, asset.material, report)
        return replace(asset, material=quilted(asset.material, tile_atlas.build(tiles).map), tiles=tiles)
    if material.quilting is None:
        return asset
    return replace(asset, material=quilted(asset.material, quilting_map.load(material.quilting)))


def _tiles(name: str, material: MaterialConfig, look: Material, report: Report) -> TileSet:
    """Return the tiles that lay a material out: from their file, or cut from it and kept by content."""
    if material.wang is None:
        assert material.quilting is not None
        return tile_set.load(material.quilting)
    path = tiles_path(material)
    if path.exists():
        return tile_set.load(path)
    made_from = image.to_srgb(look.btf.albedo) if isinstance(look.btf, Textured) else look.btf
    assert isinstance(made_from, patch_error.Look)
    report(f"{name}: tiles", 0)
    source = patch_error.exemplar(made_from, Metric(bands=material.wang.bands))
    rng, told = torch.Generator().manual_seed(material.wang.seed), partial(report, f"{name}: tiles")
    asked = material.wang
    found = wang.grow(
        source, asked, rng=rng, corners=None if asked.corners is None else torch.tensor(asked.corners),
        features=tuple(feature.build() for feature in asked.features), backend="auto", progress=told,
    ).set  # fmt: skip
    tile_set.save(found, path, seed=material.wang.seed)
    return found


def tiles_path(material: MaterialConfig) -> Path:
    """Return where the cache keeps the tiles that are cut from a material."""
    if material.finish is not None:
        made_from: object = [file_hash(material.albedo_map or ""), material.albedo]
    elif material.model is not None:
        made_from = [file_hash(material.model), material.rank]
    else:
        made_from = model_path(material).name
    assert material.wang is not None
    asked = {**asdict(material.wang), "features": [f.model_dump() for f in material.wang.features]}
    masks = [file_hash(f.mask) for f in material.wang.features if f.mask is not None]
    about = [made_from, asked, masks, code_hash(("synthesize",))]
    return store.cache_dir() / f"{store.content_hash(*about)}.tiles"


def _prepare(name: str, material: MaterialConfig, report: Report, *, depth: bool) -> Asset:
    if material.finish is not None:
        return Asset(material=plain(material.finish), seconds={}, raw_bytes=0, model_bytes=0)
    if material.in_shell:
        return _prepare_gdm(name, material, report)
    if material.model is not None:
        opened = open_model(material.model, depth=depth, rank=material.rank)
        return Asset(material=opened, seconds={}, raw_bytes=0, model_bytes=Path(material.model).stat().st_size)
    assert material.meso is not None
    seconds: dict[str, float] = {}
    model = model_path(material)
    if not model.exists():
        btf_table, mdf_table = bake_tables(name, material, report, seconds)
        start = time.perf_counter()
        _compress(name, btf_table, mdf_table, material, model, report)
        seconds["compress"] = time.perf_counter() - start
    raw = sum(_size_on_disk(p) for p in table_paths(material))
    opened = open_model(model, depth=depth)
    return Asset(material=opened, seconds=seconds, raw_bytes=raw, model_bytes=model.stat().st_size)


def _prepare_gdm(name: str, material: MaterialConfig, report: Report) -> Asset:
    """Return a material in a shell: its GDM baked, from the cache, or as it is given."""
    seconds: dict[str, float] = {}
    path = Path(material.model) if material.model is not None else bake_tables(name, material, report, seconds)[0]
    table = Material(gdm=open_gdm(path, rank=material.rank), shell=material.shell, albedo=material.floor)
    size = path.stat().st_size if path.is_file() else _size_on_disk(path)
    return Asset(material=table, seconds=seconds, raw_bytes=size if material.model is None else 0, model_bytes=size)


def open_gdm(path: str | Path, *, rank: int | None = None) -> gdm.Gdm:
    """Return the direct table in a raw table (.gdm.zarr), or what a run-time model (.gdm.meso) stands for.

    Args:
        path: the file.
        rank: components of a factored GDM to read; all of them where it is None.

    Raises:
        FormatError: the file is missing, damaged, or holds no GDM.
    """
    if not str(path).endswith(".meso"):
        return gdm.load(path)
    if "coded" in store.Model(path).meta:
        return gdm_coded.load(path)
    return gdm_svd.load(path, rank=rank).expanded()


def _compress(name: str, btf_table: Path, mdf_table: Path, material: MaterialConfig, out: Path, report: Report) -> None:
    """Fit the kind of model that the material asks for, and write it with the MDF."""
    table, depth = btf.load(btf_table), mdf.load(mdf_table)
    options = material.double_sh or material.sh_pca or material.eigen
    what = {DoubleShOptions: "double-SH", ShPcaOptions: "SH + PCA", EigenOptions: "eigen"}[type(options)]
    told = partial(report, f"{name}: {what} BTF")
    stream.fit(table, options, out, key=journal.state_of(btf_table), silhouette=depth, progress=told)


def plain(finish: Finish) -> Material:
    """Return the material of a plain look: a colour, or pictures.

    Raises:
        FormatError: a picture is missing or unreadable.
    """
    if finish.albedo_map is None and finish.normal_map is None:
        return Material(albedo=finish.albedo)
    return Material(btf=textured.from_finish(finish), albedo=finish.albedo)


def bake_tables(
    name: str,
    material: MaterialConfig,
    report: Report,
    seconds: dict[str, float],
    *,
    out: Path | None = None,
    force: bool = False,
) -> tuple[Path, ...]:
    """Bake the BTF and the MDF of a material, or its GDM, into the cache or into the folder `out` under its name.

    Raises:
        ConfigError: there is nothing to bake, or another table lies in `out` and `force` is not given.
    """
    if material.meso is None:
        raise ConfigError(f"materials.{name}: expected a mesostructure ('meso') to bake, found none")
    paths = table_paths(material)
    if out is not None:
        paths = tuple(out / f"{name}.{table.kind}.zarr" for table in _tables(material))
    keys = _keys(material)
    if all(_is_finished(path, key) for path, key in zip(paths, keys, strict=True)):
        return paths
    for path, key in zip(paths, keys, strict=True):
        if out is not None and path.exists() and not force and not _is_finished(path, key):
            raise ConfigError(f"{path}: holds another table; give --force to replace it, or another folder")
        with store.writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
    meso = material.meso.build()
    source = {"type": material.meso.type, **material.meso.arguments}
    for table, path, key in reversed(list(zip(_tables(material), paths, keys, strict=True))):
        start = time.perf_counter()
        if not _is_finished(path, key):
            told = partial(report, f"{name}: {table.kind.upper()}")
            table.bake(meso, table.options, path, about={"source": source, "key": key}, progress=told)
        seconds[table.kind] = time.perf_counter() - start
    return paths


class _Table(NamedTuple):
    """A table that a material needs."""

    kind: str
    options: Any
    bake: Callable[..., None]


def _tables(material: MaterialConfig) -> tuple[_Table, ...]:
    if material.gdm is not None:
        return (_Table("gdm", material.gdm, bake_gdm.bake),)
    return (_Table("btf", material.btf, bake_btf.bake), _Table("mdf", material.mdf, bake_mdf.bake))


def open_model(path: str | Path, *, depth: bool = True, rank: int | None = None) -> Material:
    """Return the material in a run-time model (.meso), reading what is asked for only.

    Args:
        path: the model.
        depth: whether to read the MDF.
        rank: components of the eigen or SH + PCA BTF to read; all of them where it is None. Of a double-SH BTF the
            bands.

    Raises:
        FormatError: the file is missing, damaged, or holds no BTF.
    """
    model = store.Model(path)
    if "sh" in model.meta:
        reflectance = sh_btf.load(path, degree=None if rank is None else rank - 1)
    elif "sh_pca" in model.meta:
        reflectance = sh_pca_btf.load(path, rank=rank)
    elif "transform" in model.meta:
        reflectance = transform_btf.load(path, rank=rank).expanded()
    elif "factored" in model.meta:
        reflectance = factored.opened(factored_btf.load(path), rank)
    else:
        reflectance = eigen_btf.load(path, rank=rank)
    return Material(btf=reflectance, mdf=mdf.from_model(model) if depth else None)


def table_paths(material: MaterialConfig) -> tuple[Path, ...]:
    """Return where the cache keeps the BTF and the MDF of a material, or its GDM."""
    kinds = (table.kind for table in _tables(material))
    return tuple(store.cache_dir() / f"{key}.{kind}.zarr" for key, kind in zip(_keys(material), kinds, strict=True))


def model_path(material: MaterialConfig) -> Path:
    """Return where the cache keeps the run-time model of a material."""
    kind: object = asdict(material.eigen)
    if material.double_sh is not None:
        kind = ["double-sh", asdict(material.double_sh)]
    if material.sh_pca is not None:
        kind = ["sh-pca", asdict(material.sh_pca)]
    return store.cache_dir() / f"{store.content_hash(_keys(material), kind)}.meso"


@cache
def code_hash(folders: tuple[str, ...] = CODE) -> str:
    """Return a hash of the code that decides what a bake holds, so that no cache outlives it."""
    root = Path(__file__).resolve().parents[1]
    digest = hashlib.sha256()
    for folder in folders:
        for file in sorted((root / folder).glob("*.py")):
            digest.update(file.read_bytes())
    return digest.hexdigest()[:24]


def describe_meso(meso: MesoConfig) -> list:
    """Return what a mesostructure is made of, file contents included, for a content hash."""
    arguments = {k: v for k, v in meso.arguments.items() if Path(str(v)) not in meso.files}
    return [meso.type, arguments, [file_hash(path) for path in meso.files]]


def file_hash(path: str | Path) -> str:
    """Return a hash of a file's content.

    Raises:
        FormatError: it is missing.
    """
    if not Path(path).is_file():
        raise FormatError(f"{path}: expected a file, found none; check the path")
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()[:24]


def _keys(material: MaterialConfig) -> tuple[str, ...]:
    assert material.meso is not None
    about = [describe_meso(material.meso), code_hash()]
    return tuple(store.content_hash(about, asdict(table.options)) for table in _tables(material))


def _is_finished(path: Path, key: str) -> bool:
    if not path.is_dir():
        return False
    kind = path.name.split(".")[-2]
    return store.attributes(store.open_table(path, kind)).get("key") == key


def _size_on_disk(path: Path) -> int:
    return sum(f.stat().st_size for f in path.rglob("*") if f.is_file()) if path.is_dir() else 0
