import sys

import numpy as np
import pytest
from PIL import Image

from torchmeso.data import video
from torchmeso.errors import ConfigError, StorageError

COLOURS = ((255, 0, 0), (0, 255, 0), (0, 0, 255))


def record(path, fps=10.0):
    with video.record(path, fps=fps, count=len(COLOURS)) as reel:
        for colour in COLOURS:
            reel.add(np.full((33, 50, 3), colour, np.uint8))


def test_a_sequence_of_pictures(tmp_path):
    record(tmp_path / "walk.png")
    names = [tmp_path / f"walk_{i:04d}.png" for i in (1, 2, 3)]
    assert video.paths(tmp_path / "walk.png", 3) == names
    assert sorted(tmp_path.iterdir()) == names
    for name, colour in zip(names, COLOURS, strict=True):
        with Image.open(name) as picture:
            assert picture.getpixel((20, 20)) == colour


def test_a_gif_that_repeats(tmp_path):
    record(tmp_path / "walk.gif")
    with Image.open(tmp_path / "walk.gif") as film:
        assert (film.n_frames, film.info["duration"], film.info["loop"]) == (3, 100, 0)
        for i, colour in enumerate(COLOURS):
            film.seek(i)
            assert film.convert("RGB").getpixel((20, 20)) == colour


def test_mp4(tmp_path):
    cv2 = pytest.importorskip("cv2", reason="the extra `video` is not installed")
    record(tmp_path / "walk.mp4")
    assert [p.name for p in tmp_path.iterdir()] == ["walk.mp4"]
    reader = cv2.VideoCapture(str(tmp_path / "walk.mp4"))
    for colour in COLOURS:
        there, frame = reader.read()
        assert there
        assert frame.shape == (32, 50, 3)
        assert np.abs(frame[16, 25, ::-1].astype(int) - colour).max() < 40
    assert not reader.read()[0]


def test_other_suffixes(tmp_path):
    with pytest.raises(ConfigError, match=r"expected a name that ends in \.png, \.gif, \.mp4"):
        record(tmp_path / "walk.avi")
    with (
        pytest.raises(ConfigError, match="expected at least one frame"),
        video.record(tmp_path / "empty.gif", fps=10, count=0),
    ):
        pass


def add(reel, colour):
    reel.add(np.full((4, 4, 3), colour, np.uint8))


def test_a_sequence_that_was_cut_off_goes_on(tmp_path):
    def first(job):
        with video.record(tmp_path / "a.png", fps=1, count=3, job=job) as reel:
            assert not reel.skip()
            add(reel, COLOURS[0])
            raise KeyboardInterrupt

    for job in ("another", "this"):
        with pytest.raises(KeyboardInterrupt):
            first(job)
    assert [p.name for p in tmp_path.iterdir()] == ["a.png.part"]
    with video.record(tmp_path / "a.png", fps=1, count=3, job="this") as reel:
        assert [reel.skip(), reel.skip()] == [True, False]
        add(reel, COLOURS[1])
        assert not reel.skip()
        add(reel, COLOURS[2])
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a_0001.png", "a_0002.png", "a_0003.png"]


@pytest.mark.parametrize("suffix", ["gif", "mp4"])
def test_a_film_that_was_cut_off_goes_on(suffix, tmp_path):
    if suffix == "mp4":
        pytest.importorskip("cv2", reason="the extra `video` is not installed")
    name = tmp_path / f"a.{suffix}"

    def frame(value):
        return np.full((32, 32, 3), value, np.uint8)

    with pytest.raises(KeyboardInterrupt), video.record(name, fps=10, count=2, job="this") as reel:
        reel.add(frame(40))
        raise KeyboardInterrupt
    assert [p.name for p in tmp_path.iterdir()] == [f"a.{suffix}.part"]
    with video.record(name, fps=10, count=2, job="this") as reel:
        assert [reel.skip(), reel.skip()] == [True, False]
        reel.add(frame(200))
    assert list(tmp_path.iterdir()) == [name]
    assert name.stat().st_size > 0


@pytest.mark.errors
def test_a_film_that_lost_frames_is_not_kept(tmp_path, monkeypatch):
    cv2 = pytest.importorskip("cv2", reason="the extra `video` is not installed")
    real, written = cv2.VideoWriter, []

    class Forgetful:
        """Drops the second frame without a word, as OpenCV does on a full disk."""

        fourcc = staticmethod(real.fourcc)

        def __init__(self, *arguments):
            self._writer = real(*arguments)

        def write(self, frame):
            written.append(frame)
            if len(written) != 2:
                self._writer.write(frame)

        def release(self):
            self._writer.release()

    monkeypatch.setattr(cv2, "VideoWriter", Forgetful)

    def lose():
        with video.record(tmp_path / "a.mp4", fps=1, count=2) as reel:
            reel.add(np.zeros((32, 32, 3), np.uint8))
            reel.add(np.zeros((32, 32, 3), np.uint8))

    with pytest.raises(StorageError, match=r"a\.mp4: could not be written \(of 2 frames 1 are in the film\)"):
        lose()
    assert [p.name for p in tmp_path.iterdir()] == ["a.mp4.part"]  # its pictures wait for another try


def test_a_film_needs_opencv(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(ConfigError, match=r"MP4: expected OpenCV, found none; pip install 'torchmeso\[video\]'"):
        record(tmp_path / "walk.mp4")
    assert not list(tmp_path.iterdir())
