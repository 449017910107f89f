"""UBO2003 and ATRIUM, the BTF sets of the University of Bonn as pictures: a folder or a zip of it.

A picture's name tells its directions: "00008 tl000 pl000 tv030 pv030.jpg" is lit from theta 0, phi 0 and seen from
theta 30, phi 30 (degrees). Only these four keys are read, wherever they stand; folders and numbers are not. Sets have
81 lights x 81 views (`hemisphere.ubo81`) of 256 x 256 (ATRIUM 800 x 800) pixels; any other rings are read too, also a
single view. phi goes from +x (right) to +y (up in the picture): of the quarter turns and mirrorings it is the one
under which normals found from the lights are those of a surface, up to half a turn (a test measures it on a real set).

JPEG and PNG hold T as sRGB codes and stay codes; Radiance pictures (.hdr) hold T itself. Where their resolution line
reads "+X W -Y H", as in ATRIUM, scan lines are taken as rows from the bottom, as readers of these sets do, not as the
columns that `data.rgbe` (and Radiance) make of them.

Test: tests/data/test_ubo2003.py
"""

import os
import re
import zipfile
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torchmeso.data import image, rgbe, store
from torchmeso.data.picture_set import PictureSet, Reader, by_place
from torchmeso.errors import FormatError
from torchmeso.geometry import gaps
from torchmeso.geometry.hemisphere import DirectionSet

CODES, FLOATS = (".jpg", ".jpeg", ".png"), (".hdr",)

INFLATION = 1032
"""Bytes that one byte of a zip can stand for at most."""


def survey(path: str | Path, *, lights: DirectionSet | None = None, views: DirectionSet | None = None) -> PictureSet:
    """Return which pictures there are; none is read.

    Args:
        path: a folder, searched to any depth, or a zip.
        lights: the set they should be; None = found from their angles (`geometry.gaps.meant`): one direction is
            itself, directions of ubo81 are meant to be all of it, others are complete rings.
        views: likewise.

    Raises:
        FormatError: there is no picture of that kind, two show the same, or their directions are no rings.
    """
    path = Path(path)
    sizes = _in_folder(path) if path.is_dir() else _in_zip(path)
    angles = {name: found for name in sizes if (found := _angles(name)) is not None}
    if not angles:
        raise FormatError(f"{path}: expected pictures named like '00008 tl000 pl000 tv030 pv030.jpg', found none")
    kinds = {Path(name).suffix.lower() in FLOATS for name in angles}
    if len(kinds) > 1:
        raise FormatError(f"{path}: holds JPEG or PNG and Radiance pictures; keep one kind, best the latter (.hdr)")
    lights = lights or gaps.meant({light for light, _ in angles.values()}, f"{path}: lights")
    views = views or gaps.meant({view for _, view in angles.values()}, f"{path}: views")
    return PictureSet(
        name=str(path),
        lights=lights,
        views=views,
        files=by_place(str(path), angles, lights, views),
        encoding="linear" if kinds == {True} else "srgb",
        key=store.content_hash(str(path.resolve()), sorted((name, sizes[name]) for name in angles)),
        opened=_opener(path),
    )


def _angles(name: str) -> tuple[gaps.Angles, gaps.Angles] | None:
    """Return (theta, phi) of light and view in degrees that a picture's name tells; None where it tells none."""
    stem, suffix = os.path.splitext(name.replace("\\", "/").rpartition("/")[2])
    found = [
        re.findall(rf"(?<![a-z]){key}(\d{{1,3}}(?:\.\d{{1,6}})?)", stem.lower()) for key in ("tl", "pl", "tv", "pv")
    ]
    if suffix.lower() not in CODES + FLOATS or any(len(numbers) != 1 for numbers in found):
        return None
    tl, pl, tv, pv = (float(numbers[0]) for numbers in found)
    return gaps.turned((tl, pl)), gaps.turned((tv, pv))


def _in_folder(path: Path) -> dict[str, list[int]]:
    """Return the size and the time of change of all files, by their name below `path`."""
    with store.reading(path):
        found = {}
        for folder, _, names in os.walk(path):
            for name in names:
                file = os.path.join(folder, name)
                if _angles(name) is not None:
                    about = os.stat(file)
                    found[os.path.relpath(file, path)] = [about.st_size, about.st_mtime_ns]
        return found


def _in_zip(path: Path) -> dict[str, list[int]]:
    """Return the size and the checksum of all members, by name."""
    if not path.is_file():
        raise FormatError(f"{path}: expected a folder or a zip of pictures, found none; check the path")
    with store.reading(path), zipfile.ZipFile(path) as archive:
        return {member.filename: [member.file_size, member.CRC] for member in archive.infolist() if not member.is_dir()}


def _opener(path: Path) -> Callable[[], AbstractContextManager[Reader]]:
    @contextmanager
    def opened() -> Iterator[Reader]:
        if path.is_dir():
            yield lambda name: _decode(_read_file(path / name), f"{path / name}")
            return
        with _opened_zip(path) as archive:
            yield lambda name: _decode(_read_member(archive, name, path), f"{path}: {name}")

    return opened


def _opened_zip(path: Path) -> zipfile.ZipFile:
    with store.reading(path):
        return zipfile.ZipFile(path)


def _read_file(path: Path) -> bytes:
    with store.reading(path):
        return path.read_bytes()


def _read_member(archive: zipfile.ZipFile, name: str, path: Path) -> bytes:
    with store.reading(f"{path}: {name}"):
        member = archive.getinfo(name)
        if member.file_size > INFLATION * member.compress_size + 1024:
            raise FormatError(
                f"{path}: '{name}' announces {member.file_size} bytes in {member.compress_size}; "
                "the copy may be damaged"
            )
        return archive.read(member)


def _decode(data: bytes, name: str) -> Tensor:
    """Return a picture: uint8 sRGB codes, or linear float32."""
    if not name.lower().endswith(FLOATS):
        return image.read_codes(data, name)
    picture = rgbe.decode(data, name)
    if rgbe.read_header(data, name).order == "+X-Y":
        picture = np.rot90(picture)  # columns from the left are rows from the bottom
    return torch.from_numpy(np.ascontiguousarray(picture))
