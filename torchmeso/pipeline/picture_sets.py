"""BTFs in pictures as the command line takes them: a folder or a zip, made into a raw table in the cache.

Test: tests/pipeline/test_picture_sets.py
"""

from pathlib import Path

from torchmeso.data import btf_file, exr_stack, picture_set, store, ubo2003
from torchmeso.data.btf import Bands
from torchmeso.data.picture_set import PictureSet
from torchmeso.pipeline.bake import Report, silent


def is_one(path: str | Path) -> bool:
    """Return whether `path` is a folder that is no raw table, or a zip."""
    path = Path(path)
    return (path.is_dir() and path.suffix != ".zarr") or path.suffix.lower() == ".zip"


def open_btf(path: str | Path, report: Report = silent, *, allow_missing: bool = False) -> Bands:
    """Return the BTF of a file, or of a folder or zip of pictures; pictures are made into a table first.

    Raises:
        FormatError: the file is missing or damaged, or lacks pictures (unless `allow_missing`).
        StorageError: the cache cannot be written to.
    """
    return btf_file.load(as_table(path, report, allow_missing=allow_missing) if is_one(path) else path)


def survey(path: str | Path) -> PictureSet:
    """Return which pictures `path` holds.

    Raises:
        FormatError: it holds none that are a BTF's.
    """
    if (Path(path) / exr_stack.TABLE).is_file():
        return exr_stack.survey(path)
    return ubo2003.survey(path)


def as_table(path: str | Path, report: Report = silent, *, allow_missing: bool = False) -> Path:
    """Return the raw table of the pictures in `path`, made once and kept until one of the files changes.

    Raises:
        FormatError: a picture is missing (unless `allow_missing`), damaged, or of another size.
        StorageError: the cache cannot be written to.
    """
    pictures = survey(path)
    if not allow_missing:
        picture_set.check_complete(pictures)
    table = store.cache_dir() / f"pictures-{pictures.key}.btf.zarr"
    if not table.exists():
        with store.writing(table):
            table.parent.mkdir(parents=True, exist_ok=True)
        picture_set.to_table(
            pictures,
            table,
            allow_missing=allow_missing,
            progress=lambda x: report("pictures", x),
            source=Path(path).name,
        )
    return table
