from dataclasses import replace

import pytest
import torch

from torchmeso.data import image
from torchmeso.errors import ConfigError
from torchmeso.geometry.camera import Camera
from torchmeso.render import film
from torchmeso.render.film import Picture


def picture(rng):
    owner = torch.tensor([[-1, 0, 0], [1, -2, -1]])
    return Picture(
        rgb=torch.rand(2, 3, 3, generator=rng), depth=torch.rand(2, 3, generator=rng), owner=owner,
        shadowed=torch.zeros(1, 2, 3, dtype=torch.bool), counts={}, seconds={},
    )  # fmt: skip


def test_coverage_counts_objects(rng):
    assert picture(rng).coverage == pytest.approx(4 / 6)


def test_exr_keeps_values_and_depth(tmp_path, rng):
    import OpenEXR

    p = picture(rng)
    film.write(p, tmp_path / "a.exr")
    assert torch.equal(image.read(tmp_path / "a.exr"), p.rgb)
    depth = OpenEXR.File(str(tmp_path / "a.exr")).channels()["Z"].pixels
    assert torch.equal(torch.from_numpy(depth), p.depth)


def test_png_is_srgb(tmp_path, rng):
    p = picture(rng)
    film.write(p, tmp_path / "a.png")
    assert (image.read(tmp_path / "a.png") - p.rgb).abs().max() < 0.01


def test_the_mean_of_pictures(rng):
    """Colours are averaged; what cannot be is the first picture's, also where the next is drawn over it."""
    pictures = [replace(picture(rng), seconds={"frame": 1.0}) for _ in range(3)]
    shared = pictures[0].depth.clone()

    cameras = [Camera(eye=torch.zeros(3), axes=torch.eye(3), width=3, height=2) for _ in pictures]

    def paint(camera):
        seen = pictures[cameras.index(camera)]
        shared.copy_(seen.depth)
        return replace(seen, depth=shared)

    mean = film.average(paint, cameras)
    torch.testing.assert_close(mean.rgb, torch.stack([p.rgb for p in pictures]).mean(0))
    assert torch.equal(mean.depth, pictures[0].depth)
    assert mean.seconds == {"frame": 3.0}


@pytest.mark.errors
def test_no_picture_has_no_mean():
    with pytest.raises(ConfigError, match="expected at least one camera"):
        film.average(lambda camera: None, [])


@pytest.mark.errors
def test_other_suffixes_are_refused(tmp_path, rng):
    with pytest.raises(ConfigError, match=r"expected a name that ends in \.png or \.exr"):
        film.write(picture(rng), tmp_path / "a.tiff")
    assert not list(tmp_path.iterdir())


@pytest.mark.errors
def test_no_pictures_have_no_sum():
    with pytest.raises(ConfigError, match="expected at least one picture, got none"):
        film.total([])
