"""Frames one after the other: a sequence of PNG, an animated GIF, or MP4.

A film is written beside its name and renamed when it is whole. The pictures of a sequence wait in `<name>.part` until
all are there; a job that was cut off goes on behind the last one.

Test: tests/data/test_video.py
"""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from torchmeso.data.store import replacing, writing
from torchmeso.errors import ConfigError, StorageError

SUFFIXES = (".png", ".gif", ".mp4")


class Reel(Protocol):
    """Takes frames in order."""

    def add(self, frame: UInt8[np.ndarray, "H W 3"]) -> None:
        """Append an sRGB frame; all have one size."""
        ...

    def skip(self) -> bool:
        """Return whether an earlier run of the same job made the next frame, and go past it if so."""
        ...


def paths(path: str | Path, count: int) -> list[Path]:
    """Return the files that `count` frames become: one, or frame_0001.png, frame_0002.png... for frame.png."""
    path = Path(path)
    if path.suffix.lower() != ".png":
        return [path]
    return [path.with_stem(f"{path.stem}_{i + 1:04d}") for i in range(count)]


@contextmanager
def record(path: str | Path, *, fps: float, count: int, job: str = "") -> Iterator[Reel]:
    """Yield something that takes `count` frames and writes them to `path`.

    Args:
        path: .png (a sequence), .gif or .mp4.
        fps: frames per second; a sequence of pictures has none.
        count: frames to come.
        job: what the frames show, in any words; a sequence that was cut off only goes on for the same job.

    Raises:
        StorageError: the disk is full, or the place cannot be written to.
        ConfigError: another suffix, or MP4 without the extra `video`.
    """
    suffix = Path(path).suffix.lower()
    if suffix == ".png":
        with writing(path):
            reel = _Sequence(Path(path), count, job)
            yield reel
            reel.finish()
    elif suffix == ".gif":
        reel = _Gif()
        yield reel
        with replacing(path) as beside:
            reel.write(beside, fps)
    elif suffix == ".mp4":
        with replacing(path) as beside:
            reel = _Mp4(beside, fps)
            try:
                yield reel
            finally:
                reel.close()
            reel.check(path)
    else:
        raise ConfigError(f"{path}: expected a name that ends in {', '.join(SUFFIXES)}")


class _Sequence:
    def __init__(self, path: Path, count: int, job: str):
        self._part, self._paths, self._next = path.with_name(f"{path.name}.part"), paths(path, count), 0
        key = self._part / "job"
        if self._part.exists() and not (key.is_file() and key.read_text() == f"{count} {job}"):
            shutil.rmtree(self._part)
        self._part.mkdir(parents=True, exist_ok=True)
        key.write_text(f"{count} {job}")

    def add(self, frame: UInt8[np.ndarray, "H W 3"]) -> None:
        with replacing(self._part / self._paths[self._next].name) as beside:
            Image.fromarray(frame).save(beside, format="PNG")
        self._next += 1

    def skip(self) -> bool:
        there = (self._part / self._paths[self._next].name).exists()
        self._next += there
        return there

    def finish(self) -> None:
        for path in self._paths[: self._next]:
            (self._part / path.name).replace(path)
        shutil.rmtree(self._part)


class _Gif:
    def __init__(self) -> None:
        self._frames: list[Image.Image] = []

    def add(self, frame: UInt8[np.ndarray, "H W 3"]) -> None:
        self._frames.append(Image.fromarray(frame).quantize(256, dither=Image.Dither.FLOYDSTEINBERG))

    def skip(self) -> bool:
        return False

    def write(self, path: Path, fps: float) -> None:
        if not self._frames:
            raise ConfigError(f"{path}: expected at least one frame, got none")
        first, *rest = self._frames
        first.save(path, format="GIF", save_all=True, append_images=rest, duration=round(1000 / fps), loop=0)


class _Mp4:
    """MPEG-4 through OpenCV, whose wheels carry an ffmpeg under the LGPL."""

    def __init__(self, path: Path, fps: float):
        try:
            import cv2
        except ImportError as error:
            raise ConfigError(
                "MP4: expected OpenCV, found none; pip install 'torchmeso[video]', or write .gif"
            ) from error
        self._cv2: Any = cv2
        self._path, self._fps, self._count, self._writer = path, fps, 0, None

    def add(self, frame: UInt8[np.ndarray, "H W 3"]) -> None:
        if self._writer is None:
            size = (frame.shape[1] // 2 * 2, frame.shape[0] // 2 * 2)  # MPEG-4 has even sides
            code = self._cv2.VideoWriter.fourcc(*"mp4v")
            self._writer, self._size = self._cv2.VideoWriter(str(self._path), code, self._fps, size), size
        self._writer.write(np.ascontiguousarray(frame[: self._size[1], : self._size[0], ::-1]))
        self._count += 1

    def skip(self) -> bool:
        return False

    def close(self) -> None:
        if self._writer is not None:
            self._writer.release()

    def check(self, path: str | Path) -> None:
        """Raise StorageError unless the film holds all frames: OpenCV does not say when it cannot write."""
        found = int(self._cv2.VideoCapture(str(self._path)).get(self._cv2.CAP_PROP_FRAME_COUNT))
        if self._count and found != self._count:
            raise StorageError(
                f"{path}: could not be written (of {self._count} frames {max(found, 0)} are in the film); "
                "make room or choose another place"
            )
