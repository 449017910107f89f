import math

import pytest
import torch

from torchmeso.errors import ConfigError, ShapeError
from torchmeso.geometry.light import DirectionalLight, PointLight, SpotLight, illuminate

WHITE = torch.ones(3)


def test_directional_light_is_the_same_everywhere(rng):
    light = DirectionalLight(direction=torch.tensor([0.0, 0.0, 1.0]), irradiance=math.pi * WHITE)
    wi, distance, E = illuminate(light, torch.rand(5, 3, generator=rng))
    assert (wi == torch.tensor([0.0, 0.0, 1.0])).all()
    assert distance.isinf().all()
    assert (math.pi == E).all()


def test_point_light_falls_off_with_the_square():
    light = PointLight(position=torch.tensor([0.0, 0.0, 2.0]), intensity=8 * WHITE)
    wi, distance, E = illuminate(light, torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, -2.0]]))
    assert distance.tolist() == [2, 4]
    assert E[:, 0].tolist() == [2, 0.5]
    assert wi[0].tolist() == [0, 0, 1]


def test_spot_light_has_a_cone():
    light = SpotLight(
        position=torch.zeros(3), axis=torch.tensor([0.0, 0.0, -1.0]), intensity=WHITE, inner_deg=20, outer_deg=30
    )
    angle = torch.tensor([0.0, 19.0, 25.0, 31.0]).deg2rad()
    _, _, E = illuminate(light, torch.stack([angle.sin(), torch.zeros(4), -angle.cos()], -1))
    assert E[0, 0] == pytest.approx(1)
    assert E[1, 0] == pytest.approx(1)
    assert 0 < E[2, 0] < 1
    assert E[3, 0] == 0


def test_light_at_the_point_itself_stays_finite():
    light = PointLight(position=torch.zeros(3), intensity=WHITE)
    wi, _, E = illuminate(light, torch.zeros(1, 3))
    assert torch.isfinite(wi).all()
    assert torch.isfinite(E).all()


@pytest.mark.errors
def test_malformed_lights_are_refused():
    with pytest.raises(ShapeError, match=r"light.direction: expected shape \(3\)"):
        DirectionalLight(direction=torch.zeros(2), irradiance=WHITE)
    with pytest.raises(ConfigError, match="inner_deg: expected a value from 0 to 30"):
        SpotLight(position=torch.zeros(3), axis=WHITE / 3**0.5, intensity=WHITE, inner_deg=40, outer_deg=30)
    up = torch.tensor([0.0, 1.0, 0.0])
    with pytest.raises(ShapeError, match=r"light.direction \(its length\): expected finite values from 0.999 to 1.001"):
        DirectionalLight(direction=up * 0, irradiance=WHITE)
    with pytest.raises(ShapeError, match=r"light.irradiance: .* from 0 to 1e\+20, got nan at \(0,\) and 2 more of 3"):
        DirectionalLight(direction=up, irradiance=WHITE * math.nan)
    with pytest.raises(ShapeError, match=r"light\.intensity: expected finite values from 0"):
        PointLight(position=up, intensity=-WHITE)
