import math

import pytest
import torch

from tests.pipeline.small import small
from torchmeso.data import image
from torchmeso.errors import ConfigError
from torchmeso.pipeline import animate


def test_a_turntable_goes_around_what_is_looked_at():
    config = small(camera={"eye": [0, 2.2, 3.2], "at": [0, 0.2, 0.2], "width": 48, "height": 36})
    eyes = torch.stack([camera.eye for camera, _ in animate.turn(config, 4, "turntable")])
    expected = torch.tensor([[0, 2.2, 3.2], [3, 2.2, 0.2], [0, 2.2, -2.8], [-3, 2.2, 0.2]], dtype=torch.float64)
    torch.testing.assert_close(eyes, expected, atol=1e-12, rtol=0)


def test_lights_go_around_and_the_camera_rests():
    lights = [
        {"type": "directional", "direction": [1, 1, 0]},
        {"type": "point", "position": [2, 1, 0], "intensity": [1, 1, 1]},
        {"type": "spot", "position": [2, 1, 0], "at": [1, 0, 0], "intensity": [1, 1, 1]},
    ]
    (first, _), (second, (sun, point, spot)) = list(animate.turn(small(lights=lights), 4, "light"))[:2]
    assert torch.equal(first.eye, second.eye)
    torch.testing.assert_close(sun.direction, torch.tensor([0, 1, -1]) / math.sqrt(2))
    torch.testing.assert_close(point.position, torch.tensor([0.0, 1, -2], dtype=torch.float64))
    torch.testing.assert_close(spot.axis, torch.tensor([0.0, -1, 1]) / math.sqrt(2), atol=1e-6, rtol=0)


@pytest.mark.parametrize("backend", ["torch", "opencl"])
def test_frames_of_a_turn(backend, tmp_path, device):
    seen = []
    files = animate.render(
        small(backend=backend), tmp_path / "a.png", frames=3, way="light", report=lambda what, share: seen.append(share)
    )
    assert [f.name for f in files] == ["a_0001.png", "a_0002.png", "a_0003.png"]
    pictures = [image.read(f) for f in files]
    assert all(p.shape == (36, 48, 3) for p in pictures)
    assert not torch.equal(pictures[0], pictures[1])
    assert seen[-1] == 1


def test_no_frames(tmp_path):
    with pytest.raises(ConfigError, match="frames"):
        animate.render(small(), tmp_path / "a.png", frames=0)
