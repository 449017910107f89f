import pytest

from torchmeso.bench import scenes
from torchmeso.render.rasterize import rasterize


@pytest.mark.parametrize("case", list(scenes.silhouette_cases()))
def test_every_case_is_in_the_picture(case):
    """Closed, inside the frame, and covering a good part of it."""
    body, camera = scenes.silhouette_cases()[case]
    assert bool(body.closed.all())
    layers = rasterize(camera, body.vertices, body.faces)
    covered = (layers.start.diff() > 0).reshape(camera.height, camera.width)
    assert 0.15 < covered.float().mean() < 0.8
    border = covered[0].any() | covered[-1].any() | covered[:, 0].any() | covered[:, -1].any()
    assert not bool(border)
