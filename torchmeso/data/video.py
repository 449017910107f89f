"""Frames one after the other: a sequence of PNG, an animated GIF, or MP4.

Pictures wait in `<name>.part` until all are there; a job that was cut off goes on behind the last one. Then a sequence
gets its names, or a film is made of them, written beside its name and renamed when it is whole.

Test: tests/data/test_video.py
"""

import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from torchmeso.data.store import replacing, writing
from torchmeso.errors import ConfigError, StorageError

SUFFIXES = (".png", ".gif", ".mp4")


QUICK = 1
"""Compression of PNG (0..9) for pictures that only wait to become a film."""


def paths(path: str | Path, count: int) -> list[Path]:
    """Return the files that `count` frames become: one, or frame_0001.png, frame_0002.png... for frame.png."""
    path = Path(path)
    if path.suffix.lower() != ".png":
        return [path]
    return [path.with_stem(f"{path.stem}_{i + 1:04d}") for i in range(count)]


@contextmanager
def record(path: str | Path, *, fps: float, count: int, job: str = "") -> "Iterator[Reel]":
    """Yield something that takes `count` frames and writes them to `path`.

    Args:
        path: .png (a sequence), .gif or .mp4.
        fps: frames per second; a sequence of pictures has none.
        count: frames to come.
        job: what the frames show, in any words; what was cut off only goes on for the same job.

    Raises:
        StorageError: the disk is full, or the place cannot be written to.
        ConfigError: another suffix, no frame, or MP4 without the extra `video`.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise ConfigError(f"{path}: expected a name that ends in {', '.join(SUFFIXES)}")
    if suffix != ".png" and count < 1:
        raise ConfigError(f"{path}: expected at least one frame, got none")
    if suffix == ".mp4":
        _opencv()
    with writing(path):
        reel = Reel(path, count, job)
        yield reel
        if suffix == ".gif":
            with replacing(path) as beside:
                _write_gif(beside, reel.pictures(), fps)
        elif suffix == ".mp4":
            with replacing(path) as beside:
                _write_mp4(beside, reel.pictures(), fps, path)
        reel.finish()


class Reel:
    """Takes frames in order."""

    def __init__(self, path: Path, count: int, job: str):
        """Go on behind the pictures that an earlier run of the same job left; use `record`."""
        self._part, self._next = path.with_name(f"{path.name}.part"), 0
        self._sequence = path.suffix.lower() == ".png"
        self._paths = paths(path.with_suffix(".png"), count)
        key = self._part / "job"
        if self._part.exists() and not (key.is_file() and key.read_text() == f"{count} {job}"):
            shutil.rmtree(self._part)
        self._part.mkdir(parents=True, exist_ok=True)
        key.write_text(f"{count} {job}")

    def add(self, frame: UInt8[np.ndarray, "H W 3"]) -> None:
        """Append an sRGB frame; all have one size."""
        level = {} if self._sequence else {"compress_level": QUICK}
        with replacing(self._part / self._paths[self._next].name) as beside:
            Image.fromarray(frame).save(beside, format="PNG", **level)
        self._next += 1

    def skip(self) -> bool:
        """Return whether an earlier run of the same job made the next frame, and go past it if so."""
        there = (self._part / self._paths[self._next].name).exists()
        self._next += there
        return there

    def pictures(self) -> list[Path]:
        """Return the pictures so far."""
        return [self._part / path.name for path in self._paths[: self._next]]

    def finish(self) -> None:
        """Give the pictures of a sequence their names; those of a film are thrown away."""
        for path in self._paths[: self._next] if self._sequence else ():
            (self._part / path.name).replace(path)
        shutil.rmtree(self._part)


def _write_gif(path: Path, pictures: Sequence[Path], fps: float) -> None:
    def frame(picture: Path) -> Image.Image:
        with Image.open(picture) as opened:
            return opened.convert("RGB").quantize(256, dither=Image.Dither.FLOYDSTEINBERG)

    first, *rest = pictures
    following = (frame(picture) for picture in rest)  # one at a time in memory
    frame(first).save(path, format="GIF", save_all=True, append_images=following, duration=round(1000 / fps), loop=0)


def _write_mp4(path: Path, pictures: Sequence[Path], fps: float, name: Path) -> None:
    """Write MPEG-4 through OpenCV, whose wheels carry an ffmpeg under the LGPL.

    Raises:
        StorageError: the film does not hold all frames: OpenCV does not say when it cannot write.
    """
    cv2 = _opencv()
    writer: Any = None
    for picture in pictures:
        with Image.open(picture) as opened:
            frame = np.asarray(opened.convert("RGB"))
        size = (frame.shape[1] // 2 * 2, frame.shape[0] // 2 * 2)  # MPEG-4 has even sides
        writer = writer or cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), fps, size)
        writer.write(np.ascontiguousarray(frame[: size[1], : size[0], ::-1]))
    writer.release()
    found = int(cv2.VideoCapture(str(path)).get(cv2.CAP_PROP_FRAME_COUNT))
    if found != len(pictures):
        raise StorageError(
            f"{name}: could not be written (of {len(pictures)} frames {max(found, 0)} are in the film); "
            "make room or choose another place"
        )


def _opencv() -> Any:
    try:
        import cv2
    except ImportError as error:
        raise ConfigError("MP4: expected OpenCV, found none; pip install 'torchmeso[video]', or write .gif") from error
    return cv2
