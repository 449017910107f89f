import io
import subprocess
import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from torchmeso.capture import cameras
from torchmeso.capture.cameras import AravisCamera, Camera, FolderCamera, PhotoCamera, VideoCamera, read_frame
from torchmeso.errors import ConfigError, FormatError, RigError

FRAME = np.arange(24, dtype=np.uint8).reshape(4, 6)


def png(frame):
    held = io.BytesIO()
    Image.fromarray(frame).save(held, "png")
    return held.getvalue()


def test_a_folder_replays_its_frames(tmp_path):
    camera = FolderCamera("a", tmp_path, (4, 6))
    assert isinstance(camera, Camera)
    (tmp_path / "btf").mkdir()
    (tmp_path / "btf/0.png").write_bytes(png(FRAME))
    np.testing.assert_array_equal(camera.expose(0.1, "btf/0"), FRAME)
    with pytest.raises(RigError, match="has no picture of btf/1"):
        camera.expose(0.1, "btf/1")
    (tmp_path / "btf/1.png").write_bytes(b"no picture")
    with pytest.raises(FormatError, match="expected a picture"):
        camera.expose(0.1, "btf/1")


@pytest.mark.parametrize("kind", ["grey 16", "colour 8"])
def test_codes_stay_as_they_are(tmp_path, kind):
    frame = 257 * FRAME.astype(np.uint16) if kind == "grey 16" else np.stack([FRAME, FRAME + 1, FRAME + 2], -1)
    (tmp_path / "0.png").write_bytes(png(frame))
    found = cameras.read_frame(tmp_path / "0.png")
    assert found.dtype == frame.dtype
    np.testing.assert_array_equal(found, frame)


def test_opencv(monkeypatch):
    class Capture:
        def __init__(self, number):
            self.number, self.told, self.grabbed = number, {}, 0

        def isOpened(self):
            return self.number == 0

        def set(self, what, value):
            self.told[what] = value

        def grab(self):
            self.grabbed += 1

        def read(self):
            return self.number == 0 and self.grabbed < 9, np.stack([FRAME, FRAME, 9 + FRAME], -1)

        def release(self):
            self.number = -1

    names = {"CAP_PROP_FRAME_HEIGHT": 1, "CAP_PROP_FRAME_WIDTH": 2, "CAP_PROP_AUTO_EXPOSURE": 3, "CAP_PROP_EXPOSURE": 4}
    monkeypatch.setitem(sys.modules, "cv2", SimpleNamespace(VideoCapture=Capture, **names))
    camera = VideoCamera.open("a", 0, (4, 6))
    found = camera.expose(0.02, "k")
    np.testing.assert_array_equal(found[..., 0], 9 + FRAME)
    assert camera.capture.told == {1: 4, 2: 6, 3: 1, 4: 200}
    assert camera.capture.grabbed == 4  # what the driver still held
    camera.expose(0.02, "k")
    with pytest.raises(RigError, match="gave no frame of k"):
        camera.expose(0.02, "k")
    camera.close()
    with pytest.raises(RigError, match="number 1 does not open"):
        VideoCamera.open("a", 1, (4, 6))


def test_gphoto2(monkeypatch):
    asked = []

    def run(command, **_):
        asked.append(command)
        return subprocess.CompletedProcess(command, 0, png(FRAME), b"")

    monkeypatch.setattr(cameras.subprocess, "run", run)
    camera = PhotoCamera("a", (4, 6), port="usb:001,004")
    np.testing.assert_array_equal(camera.expose(0.004, "k"), FRAME)
    camera.expose(2.5, "k")
    assert asked[0][1:5] == ["--port", "usb:001,004", "--set-config-value", "shutterspeed=1/250"]
    assert "shutterspeed=2.5" in asked[1]
    monkeypatch.setattr(
        cameras.subprocess, "run", lambda c, **_: subprocess.CompletedProcess(c, 1, b"", b"no camera\n")
    )
    with pytest.raises(RigError, match=r"ended with status 1 \(no camera\)"):
        camera.expose(1, "k")

    def slow(command, **_):
        raise subprocess.TimeoutExpired(command, 61)

    monkeypatch.setattr(cameras.subprocess, "run", slow)
    with pytest.raises(RigError, match="no picture of k within a minute"):
        camera.expose(1, "k")


def test_a_program_that_is_not_there():
    with pytest.raises(RigError, match="the program no_such_program is not installed"):
        PhotoCamera("a", (4, 6), program="no_such_program").expose(1, "k")


def test_aravis(monkeypatch):
    class Device:
        gives = FRAME.tobytes()

        def get_region(self):
            return 0, 0, 6, 4

        def set_exposure_time(self, microseconds):
            self.exposure = microseconds

        def acquisition(self, timeout):
            return None if self.gives is None else SimpleNamespace(get_data=lambda: self.gives)

    def new(address):
        if address != "Fake_1":
            raise RuntimeError("no such device")
        return Device()

    gi = ModuleType("gi")
    gi.require_version = lambda *_: None
    monkeypatch.setitem(sys.modules, "gi", gi)
    monkeypatch.setitem(sys.modules, "gi.repository", ModuleType("gi.repository"))
    monkeypatch.setitem(sys.modules, "gi.repository.Aravis", SimpleNamespace(Camera=SimpleNamespace(new=new)))
    camera = AravisCamera.open("a", "Fake_1")
    np.testing.assert_array_equal(camera.expose(0.01, "k"), FRAME)
    assert camera.device.exposure == pytest.approx(1e4)
    camera.device.gives = (300 * FRAME.astype("<u2")).tobytes()
    np.testing.assert_array_equal(camera.expose(0.01, "k"), 300 * FRAME.astype(np.uint16))
    camera.device.gives = None
    with pytest.raises(RigError, match="gave no frame of k"):
        camera.expose(0.01, "k")
    camera.device = None
    with pytest.raises(RigError, match=r"gave no frame of k \(.*; what was taken stays"):
        camera.expose(0.01, "k")
    with pytest.raises(RigError, match="Fake_2 does not open"):
        AravisCamera.open("a", "Fake_2")


def test_the_real_fake_camera():
    pytest.importorskip("gi.repository.Aravis")
    camera = AravisCamera.open("a", "Fake_1")
    assert camera.expose(0.01, "k").shape == camera.size


def test_what_is_not_installed_is_said(monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(ConfigError, match=r"cv2 is not installed; install opencv-python-headless, in torchmeso\[rig\]"):
        VideoCamera.open("a", 0, (4, 6))


@pytest.mark.errors
def test_a_frame_that_is_not_there(tmp_path):
    with pytest.raises(FormatError, match=r"none\.png: cannot be read \(No such file"):
        read_frame(tmp_path / "none.png")
