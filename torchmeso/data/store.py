"""Native files: written beside and renamed, so that nothing is ever half-written, and resumable by blocks.

Raw tables (.btf.zarr, .mdf.zarr) are Zarr 3 groups filled block by block; a job that was cut off leaves
`<name>.part` with the blocks it finished, and the same job goes on from there. Zarr reads a missing block as zeros;
ours are all written, black ones too, and a finished table that lacks one is refused where it is opened. Run-time models
(.meso) are safetensors files, one tensor per component, memory-mapped: what is not asked for is never read.

Test: tests/data/test_store.py
"""

import errno
import glob
import hashlib
import json
import math
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import zarr
from torch import Tensor
from zarr.codecs import BloscCodec, Crc32cCodec

from torchmeso.errors import FormatError, MesoError, StorageError

FORMAT_VERSION = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class ArraySpec:
    """Shape and layout of one array of a raw table.

    Attributes:
        shape: whole shape.
        dtype: numpy name.
        chunks: what is compressed, and can be read, alone.
        shards: what one file holds; a block of a job is made of whole shards.
        axes: names of the axes, kept with the array.
    """

    shape: tuple[int, ...]
    dtype: str
    chunks: tuple[int, ...]
    shards: tuple[int, ...]
    axes: tuple[str, ...]


class BlockWriter:
    """A raw table in the making: arrays to write blocks into, and which blocks are done."""

    def __init__(self, part: Path, target: Path, group: zarr.Group):
        """Use `open_blocks`."""
        self._part, self._target, self._group = part, target, group

    def __getitem__(self, name: str) -> zarr.Array:
        """Return the array `name` to write into."""
        with zarr.config.set({"array.write_empty_chunks": True}):
            return _array(self._group, name)

    def is_done(self, block: int) -> bool:
        """Return whether an earlier run finished `block`."""
        return (self._part / "done" / str(block)).exists()

    def mark_done(self, block: int) -> None:
        """Record that all arrays of `block` are written."""
        (self._part / "done" / str(block)).touch()

    def finish(self) -> None:
        """Give the finished table its name."""
        for scrap in (self._part / "table").rglob("*.partial"):  # of chunks that a killed run was writing
            scrap.unlink()
        replace_directory(self._part / "table", self._target)
        shutil.rmtree(self._part)


def open_blocks(path: str | Path, specs: Mapping[str, ArraySpec], attributes: dict[str, Any]) -> BlockWriter:
    """Return a writer for the raw table `path`, resumed where an earlier run of the same job stopped.

    The same job means equal specs and attributes; anything else in `<path>.part` is thrown away.

    Raises:
        StorageError: the disk is full, or the place cannot be written to.
    """
    with writing(path):
        return _open_blocks(Path(path), specs, attributes)


def _open_blocks(path: Path, specs: Mapping[str, ArraySpec], attributes: dict[str, Any]) -> BlockWriter:
    part = path.with_name(path.name + ".part")
    key = content_hash({name: _spec_as_json(spec) for name, spec in specs.items()}, attributes)
    # Without its table it is what a run left that was killed just after the table had its name.
    if part.exists() and not ((part / "table").is_dir() and _key_of(part) == key):
        shutil.rmtree(part)
    fresh = not part.exists()
    (part / "done").mkdir(parents=True, exist_ok=True)
    group = zarr.open_group(str(part / "table"), mode="a", zarr_format=3)
    if fresh:
        for name, spec in specs.items():
            group.create_array(
                name,
                shape=spec.shape,
                dtype=spec.dtype,
                chunks=spec.chunks,
                shards=spec.shards,
                dimension_names=spec.axes,
                # Blosc reads where a damaged chunk sends it: the sum is looked at first.
                compressors=(BloscCodec(cname="lz4", shuffle="shuffle"), Crc32cCodec()),
            )
        group.attrs.update({**attributes, "format": FORMAT_VERSION, "blocks": "all"})
        (part / "key").write_text(key)
    return BlockWriter(part, path, group)


def open_table(path: str | Path, kind: str) -> zarr.Group:
    """Return the raw table at `path` for reading.

    Raises:
        FormatError: it is missing, is unfinished, is no table of this `kind`, or is of a newer format.
    """
    path = Path(path)
    if not path.is_dir():
        part = path.with_name(path.name + ".part")
        hint = "; an unfinished bake lies beside it, run the same bake again" if part.exists() else "; bake it first"
        raise FormatError(f"{path}: expected a {kind} table, found none{hint}")
    try:
        group = zarr.open_group(str(path), mode="r")
    except Exception as error:  # zarr raises many kinds on damaged metadata
        raise FormatError(
            f"{path}: expected a Zarr group ({type(error).__name__}); the copy may be incomplete"
        ) from error
    about = attributes(group)
    if not isinstance(about.get("format", 0), int):
        raise FormatError(f"{path}: expected a format number, got '{about['format']}'; the copy may be incomplete")
    if about.get("kind") != kind:
        raise FormatError(f"{path}: expected a {kind} table, got '{about.get('kind', 'something else')}'")
    if about.get("format", 0) > FORMAT_VERSION:
        raise FormatError(f"{path}: written by a newer torchmeso (format {about['format']}); update torchmeso")
    if about.get("blocks") == "all":
        with reading(path):
            _check_blocks(path, group)
    return group


def _check_blocks(path: Path, group: zarr.Group) -> None:
    """Raise FormatError where a file of an array is missing: of all of them only names are read."""
    for name, array in sorted(group.arrays()):
        grid = [-(-size // block) for size, block in zip(array.shape, array.shards or array.chunks, strict=True)]
        folder = path / name / "c"
        found = {
            Path(root, file).relative_to(folder).as_posix() for root, _, files in os.walk(folder) for file in files
        }
        count = math.prod(grid)
        if len(found) < count:
            # One after the other: a damaged file may ask for more than a list could hold.
            blocks = ("/".join(map(str, np.unravel_index(at, grid))) for at in range(count))
            missing = next(block for block in blocks if block not in found)
            raise FormatError(
                f"{path}: block {missing} of '{name}' is missing, {len(found)} of {count} are there; "
                "the copy is incomplete, copy or bake it again"
            )


def attributes(group: zarr.Group) -> dict[str, Any]:
    """Return what a raw table says about itself."""
    return dict(group.attrs)


def read_array(group: zarr.Group, name: str, selection: Any = Ellipsis) -> Tensor:
    """Return (part of) an array of a table.

    Raises:
        FormatError: the array is missing or a chunk is damaged.
    """
    try:
        return torch.from_numpy(np.asarray(_array(group, name)[selection]))
    except Exception as error:  # zarr and numcodecs raise many kinds on damaged chunks
        raise FormatError(
            f"{group.store_path}: '{name}' cannot be read ({type(error).__name__}); the copy may be incomplete"
        ) from error


def write_model(path: str | Path, tensors: Mapping[str, Tensor], meta: dict[str, Any]) -> None:
    """Write a run-time model: `tensors` by name, `meta` as JSON."""
    from safetensors import SafetensorError
    from safetensors.torch import save_file

    header = {"torchmeso": json.dumps({**meta, "format": FORMAT_VERSION})}
    with replacing(path) as beside:
        try:
            save_file({name: x.contiguous() for name, x in tensors.items()}, str(beside), metadata=header)
        except SafetensorError as error:
            raise StorageError(f"{path}: could not be written ({error}); make room or choose another place") from error


class Model:
    """A run-time model on disk: metadata now, tensors when asked for."""

    def __init__(self, path: str | Path):
        """Read the header of `path`.

        Raises:
            FormatError: the file is missing, damaged, or no model of ours.
        """
        from safetensors import SafetensorError, safe_open

        self.path = Path(path)
        if not self.path.is_file():
            raise FormatError(
                f"{path}: expected a run-time model (.meso), found none; make one with torchmeso compress"
            )
        try:
            self._file = safe_open(str(path), framework="pt")
        except SafetensorError as error:
            raise FormatError(f"{path}: expected a safetensors file ({error}); the copy may be incomplete") from error
        header = self._file.metadata() or {}
        if "torchmeso" not in header:
            raise FormatError(f"{path}: expected a model written by torchmeso, got another safetensors file")
        with reading(path):
            self.meta: dict[str, Any] = dict(json.loads(header["torchmeso"]))
            if self.meta.get("format", 0) > FORMAT_VERSION:
                raise FormatError(
                    f"{path}: written by a newer torchmeso (format {self.meta['format']}); update torchmeso"
                )

    def names(self) -> list[str]:
        """Return the names of all tensors."""
        return list(self._file.keys())

    def read(self, name: str) -> Tensor:
        """Return one tensor.

        Raises:
            FormatError: there is none of that name.
        """
        if name not in self.names():
            raise FormatError(f"{self.path}: expected a tensor '{name}', found none")
        return self._file.get_tensor(name)


def open_kind(path: str | Path, section: str, *, expected: str, make: str) -> Model:
    """Return the model at `path`, whose header has a `section`; it holds what is `expected`, which `make` makes.

    Raises:
        FormatError: the file is missing or damaged, or holds something else.
    """
    if not Path(path).is_file():
        raise FormatError(f"{path}: expected {expected}, found none; make one with {make}")
    model = Model(path)
    if not isinstance(model.meta.get(section), dict):
        raise FormatError(f"{path}: expected {expected}, got a file of kind '{model.meta.get('kind', 'unknown')}'")
    return model


@contextmanager
def reading(path: str | Path) -> Iterator[None]:
    """Turn whatever goes wrong while a file is decoded into a FormatError that names `path`.

    zarr, numcodecs, JSON and our own code meet damage in many places, and each says it in its own way.
    """
    try:
        yield
    except MesoError:
        raise
    except KeyError as error:
        raise FormatError(f"{path}: expected {error} in the file, found none; the copy may be incomplete") from error
    except Exception as error:
        what = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
        raise FormatError(f"{path}: cannot be read ({what}); the copy may be incomplete") from error


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Yield a file name beside `path` to write to; it takes the name `path` when the block ends without error.

    What a killed process left there is removed by the next one that writes `path`.

    Raises:
        StorageError: the disk is full, or the place cannot be written to.
    """
    path = Path(path)
    beside = path.with_name(f"{path.stem}.{os.getpid()}.part{path.suffix}")
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        for other in path.parent.glob(f"{glob.escape(path.stem)}.*.part{glob.escape(path.suffix)}"):
            _remove_if_left(other)
        try:
            yield beside
            os.replace(beside, path)
        finally:
            beside.unlink(missing_ok=True)


@contextmanager
def writing(path: str | Path) -> Iterator[None]:
    """Turn what the system says against writing into a StorageError that names `path`."""
    try:
        yield
    except StorageError:
        raise
    except OSError as error:
        if error.errno not in CANNOT_WRITE:
            raise
        raise StorageError(
            f"{path}: could not be written ({error.strerror}); make room or choose another place"
        ) from error


CANNOT_WRITE = {
    errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES, errno.EPERM, errno.EIO, errno.ENOTDIR,
    errno.EISDIR, errno.ENAMETOOLONG, errno.EEXIST,
}  # fmt: skip
"""What the system says where a file cannot be written."""


def replace_directory(source: Path, target: Path) -> None:
    """Rename a folder over another one; the old one is only removed once the new one has its name."""
    old = target.with_name(f"{target.name}.old.part")
    if target.exists():
        if old.exists():  # of a run that was killed
            shutil.rmtree(old)
        os.replace(target, old)
    os.replace(source, target)
    if old.exists():
        shutil.rmtree(old)


def content_hash(*parts: Any) -> str:
    """Return a short hash of JSON-like parts, the same on every machine."""
    text = json.dumps(parts, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:24]


def cache_dir() -> Path:
    """Return the folder of cached bakes: TORCHMESO_CACHE, else ~/.cache/torchmeso."""
    return Path(os.environ.get("TORCHMESO_CACHE", Path.home() / ".cache" / "torchmeso"))


def _remove_if_left(beside: Path) -> None:
    """Remove a file that a process was writing which runs no more."""
    process = beside.name.removesuffix(f".part{beside.suffix}").rpartition(".")[2]
    if not process.isdecimal():
        return
    try:
        os.kill(int(process), 0)
    except ProcessLookupError:
        beside.unlink(missing_ok=True)
    except (OSError, OverflowError):
        return  # another's, or no process at all


def _array(group: zarr.Group, name: str) -> zarr.Array:
    array = group[name]
    assert isinstance(array, zarr.Array)
    return array


def _key_of(part: Path) -> str:
    key = part / "key"
    return key.read_text() if key.is_file() else ""


def _spec_as_json(spec: ArraySpec) -> list:
    return [spec.shape, spec.dtype, spec.chunks, spec.shards, spec.axes]
