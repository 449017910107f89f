"""Frames one after the other: a sequence of PNG, an animated GIF, or MP4.

A film is written beside its name and renamed when it is whole; each PNG of a sequence likewise.

Test: tests/data/test_video.py
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from torchmeso.data.store import replacing
from torchmeso.errors import ConfigError

SUFFIXES = (".png", ".gif", ".mp4")


class Reel(Protocol):
    """Takes frames in order."""

    def add(self, frame: UInt8[np.ndarray, "H W 3"]) -> None:
        """Append an sRGB frame; all have one size."""
        ...


def paths(path: str | Path, count: int) -> list[Path]:
    """Return the files that `count` frames become: one, or frame_0001.png, frame_0002.png... for frame.png."""
    path = Path(path)
    if path.suffix.lower() != ".png":
        return [path]
    return [path.with_stem(f"{path.stem}_{i + 1:04d}") for i in range(count)]


@contextmanager
def record(path: str | Path, *, fps: float, count: int) -> Iterator[Reel]:
    """Yield something that takes `count` frames and writes them to `path`.

    Args:
        path: .png (a sequence), .gif or .mp4.
        fps: frames per second; a sequence of pictures has none.
        count: frames to come.

    Raises:
        ConfigError: another suffix, or MP4 without the extra `video`.
    """
    suffix = Path(path).suffix.lower()
    if suffix == ".png":
        yield _Sequence(paths(path, count))
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
    else:
        raise ConfigError(f"{path}: expected a name that ends in {', '.join(SUFFIXES)}")


class _Sequence:
    def __init__(self, names: list[Path]):
        self._names = iter(names)

    def add(self, frame: UInt8[np.ndarray, "H W 3"]) -> None:
        with replacing(next(self._names)) as beside:
            Image.fromarray(frame).save(beside, format="PNG")


class _Gif:
    def __init__(self) -> None:
        self._frames: list[Image.Image] = []

    def add(self, frame: UInt8[np.ndarray, "H W 3"]) -> None:
        self._frames.append(Image.fromarray(frame).quantize(256, dither=Image.Dither.FLOYDSTEINBERG))

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
        # OpenCV goes by the suffix, which the file beside does not have.
        self._path, self._draft, self._fps, self._writer = path, path.with_suffix(".mp4"), fps, None

    def add(self, frame: UInt8[np.ndarray, "H W 3"]) -> None:
        if self._writer is None:
            size = (frame.shape[1] // 2 * 2, frame.shape[0] // 2 * 2)  # MPEG-4 has even sides
            code = self._cv2.VideoWriter.fourcc(*"mp4v")
            self._writer, self._size = self._cv2.VideoWriter(str(self._draft), code, self._fps, size), size
        self._writer.write(np.ascontiguousarray(frame[: self._size[1], : self._size[0], ::-1]))

    def close(self) -> None:
        if self._writer is not None:
            self._writer.release()
        if self._draft != self._path and self._draft.exists():
            self._draft.replace(self._path)
