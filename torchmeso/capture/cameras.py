"""Cameras behind one small interface: codes as the sensor gives them, one frame for one exposure.

Test: tests/capture/test_cameras.py
"""

import subprocess
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from PIL import Image

from torchmeso.errors import ConfigError, FormatError, RigError


@runtime_checkable
class Camera(Protocol):
    """Something that takes pictures."""

    @property
    def name(self) -> str:
        """Of its own in a session; that of its files."""
        ...

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of its frames, pixels."""
        ...

    def expose(self, seconds: float, key: str) -> np.ndarray:
        """Return a frame, (H, W) or (H, W, 3), uint8 or uint16, row 0 on top.

        Args:
            seconds: of exposure.
            key: names the exposure: the same one of the same session always has the same.

        Raises:
            RigError: the camera gives none.
        """
        ...


@dataclass(frozen=True, slots=True)
class FolderCamera:
    """Replays the frames of a folder: those of an exposure are called KEY.png or .tif; a / in a key is a folder."""

    name: str
    folder: Path
    size: tuple[int, int]

    def expose(self, seconds: float, key: str) -> np.ndarray:  # noqa: D102
        for suffix in (".png", ".tif", ".tiff"):
            path = self.folder / f"{key}{suffix}"
            if path.exists():
                return read_frame(path)
        raise RigError(f"camera {self.name}: {self.folder} has no picture of {key} (.png or .tif)")


@dataclass(eq=False, slots=True)
class VideoCamera:
    """A camera that OpenCV opens by its number, such as a webcam. Its driver sets how exposures are told."""

    name: str
    number: int
    size: tuple[int, int]
    stale: int = 4  # frames that the driver may still hold from before the lamps changed
    capture: Any = field(default=None)

    @classmethod
    def open(cls, name: str, number: int, size: tuple[int, int]) -> "VideoCamera":
        """Open the camera.

        Raises:
            ConfigError: OpenCV is not installed.
            RigError: there is no such camera, or it has no such size.
        """
        cv2 = _optional("cv2", "opencv-python-headless, in torchmeso[rig]")
        capture = cv2.VideoCapture(number)
        if not capture.isOpened():
            raise RigError(f"camera {name}: number {number} does not open; is it connected, is it another program's?")
        for what, value in ((cv2.CAP_PROP_FRAME_HEIGHT, size[0]), (cv2.CAP_PROP_FRAME_WIDTH, size[1]),
                            (cv2.CAP_PROP_AUTO_EXPOSURE, 1)):  # fmt: skip
            capture.set(what, value)
        return cls(name, number, size, capture=capture)

    def expose(self, seconds: float, key: str) -> np.ndarray:  # noqa: D102
        cv2 = _optional("cv2", "opencv-python-headless, in torchmeso[rig]")
        self.capture.set(cv2.CAP_PROP_EXPOSURE, seconds * 1e4)  # V4L2 counts in tenths of milliseconds
        for _ in range(self.stale):
            self.capture.grab()
        there, frame = self.capture.read()
        if not there:
            raise RigError(f"camera {self.name}: gave no frame of {key}; what was taken stays")
        return np.ascontiguousarray(frame[..., ::-1])  # BGR

    def close(self) -> None:
        """Let other programs have it."""
        self.capture.release()


@dataclass(frozen=True, slots=True)
class PhotoCamera:
    """A still camera that the program gphoto2 drives; pictures come as the camera is set to give them (.jpg, .tif)."""

    name: str
    size: tuple[int, int]
    port: str = ""  # usb:001,004; empty: the only one
    program: str = "gphoto2"

    def expose(self, seconds: float, key: str) -> np.ndarray:  # noqa: D102
        port = ["--port", self.port] if self.port else []
        setting = ["--set-config-value", f"shutterspeed={_shutter(seconds)}"]
        command = [self.program, *port, *setting, "--capture-image-and-download", "--stdout", "--quiet"]
        try:
            run = subprocess.run(command, capture_output=True, check=False, timeout=60 + seconds)
        except FileNotFoundError as error:
            raise RigError(f"camera {self.name}: the program {self.program} is not installed") from error
        except subprocess.TimeoutExpired as error:
            raise RigError(f"camera {self.name}: no picture of {key} within a minute; what was taken stays") from error
        if run.returncode:
            said = run.stderr.decode("utf-8", "replace").strip().splitlines()[-1:] or ["no word"]
            raise RigError(f"camera {self.name}: {self.program} ended with status {run.returncode} ({said[0]})")
        return _decoded(run.stdout, f"camera {self.name}, {key}")


@dataclass(eq=False, slots=True)
class AravisCamera:
    """A GigE or USB3 Vision camera through Aravis (Debian's gir1.2-aravis-0.8), 8 or 16 bits of grey."""

    name: str
    size: tuple[int, int]
    device: Any

    @classmethod
    def open(cls, name: str, address: str) -> "AravisCamera":
        """Open a camera by its name in Aravis; Fake_1 is one that is always there.

        Raises:
            ConfigError: Aravis is not installed.
            RigError: there is no such camera.
        """
        gi = _optional("gi", "Debian's python3-gi and gir1.2-aravis-0.8")
        gi.require_version("Aravis", "0.8")
        aravis = import_module("gi.repository.Aravis")
        try:
            device = aravis.Camera.new(address)
        except Exception as error:  # of GLib
            raise RigError(f"camera {name}: {address} does not open ({error})") from error
        _, _, width, height = device.get_region()
        return cls(name, (height, width), device)

    def expose(self, seconds: float, key: str) -> np.ndarray:  # noqa: D102
        try:
            self.device.set_exposure_time(1e6 * seconds)
            buffer = self.device.acquisition(round(1e6 * (5 + seconds)))
        except Exception as error:
            raise RigError(f"camera {self.name}: gave no frame of {key} ({error}); what was taken stays") from error
        if buffer is None:
            raise RigError(f"camera {self.name}: gave no frame of {key}; what was taken stays")
        data = np.frombuffer(buffer.get_data(), np.uint8)
        codes = data if data.size == self.size[0] * self.size[1] else data.view("<u2").astype(np.uint16)
        return codes.reshape(self.size).copy()


def read_frame(path: Path) -> np.ndarray:
    """Return the codes of a picture file: (H, W) or (H, W, 3), uint8 or uint16.

    Raises:
        FormatError: it is none, or holds other values.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise FormatError(f"{path}: cannot be read ({error.strerror})") from error
    return _decoded(data, str(path))


def _decoded(data: bytes, name: str) -> np.ndarray:
    import io

    try:
        with Image.open(io.BytesIO(data)) as picture:
            frame = np.asarray(picture if picture.mode in ("L", "RGB", "I;16") else picture.convert("RGB"))
    except (OSError, ValueError, SyntaxError) as error:
        raise FormatError(f"{name}: expected a picture, got something else ({error})") from error
    return frame.astype(np.uint16) if frame.dtype.itemsize == 2 else np.array(frame)


def _shutter(seconds: float) -> str:
    """Return an exposure as photographers write it."""
    return f"1/{round(1 / seconds)}" if seconds < 0.4 else f"{seconds:g}"


def _optional(module: str, what: str) -> Any:
    try:
        return import_module(module)
    except ImportError as error:
        raise ConfigError(f"cameras: {module} is not installed; install {what}") from error
