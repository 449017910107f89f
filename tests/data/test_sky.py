import math

import pytest
import torch

from torchmeso.data import sky
from torchmeso.errors import ConfigError


def luminance(rgb):
    return rgb.double() @ torch.tensor([0.2126, 0.7152, 0.0722], dtype=torch.float64)


def towards(theta, phi=0.0):
    return torch.tensor([[math.sin(theta) * math.sin(phi), math.cos(theta), -math.sin(theta) * math.cos(phi)]]).double()


def test_the_zenith_has_the_luminance_of_the_formula():
    theta_s, T = 0.6, 4.0
    wanted = (4.0453 * T - 4.9710) * math.tan((4 / 9 - T / 120) * (math.pi - 2 * theta_s)) - 0.2155 * T + 2.4192
    found = luminance(sky.sky(towards(0.0), towards(theta_s)[0], T))
    assert float(found) == pytest.approx(wanted, rel=1e-3)  # sRGB's matrix is given to four digits


def test_a_clear_sky_is_blue_above_and_the_low_sun_red():
    zenith = sky.sky(towards(0.0), towards(0.8)[0], 2.0)[0]
    assert zenith[2] > 1.5 * zenith[0]
    low, high = sky.sunlight(math.radians(88), 3.0), sky.sunlight(math.radians(20), 3.0)
    assert low[0] > 3 * low[2] and bool((high > low).all())


def test_the_sun_stands_where_it_is_asked_for_and_carries_its_light():
    made = sky.build(elevation_deg=40, azimuth_deg=90, turbidity=3, height=64)
    w, solid_angle, radiance = made.texels()
    brightest = int(luminance(radiance).argmax())
    assert float(w[brightest] @ towards(math.radians(50), math.pi / 2)[0]) > math.cos(math.radians(2.5))
    sun = float(luminance(radiance)[brightest] * solid_angle[brightest]) * sky.UNIT
    assert sun == pytest.approx(float(luminance(sky.sunlight(math.radians(50), 3.0))), rel=0.01)


@pytest.mark.parametrize("elevation", [1.0, 45.0, 90.0])
@pytest.mark.parametrize("turbidity", [2.0, 10.0])
def test_any_sky_is_light_and_not_far_from_day(elevation, turbidity):
    made = sky.build(elevation_deg=elevation, turbidity=turbidity, height=16)
    assert bool(made.radiance.isfinite().all()) and float(made.radiance.min()) >= 0
    w, solid_angle, radiance = made.texels()
    white = float(luminance((solid_angle * w[:, 1].clamp(min=0)) @ radiance) / math.pi)
    assert 0.01 < white < 3


def test_the_ground_reflects_a_fifth_of_what_falls_on_it():
    made = sky.build(height=32)
    w, solid_angle, radiance = made.texels()
    falls = (solid_angle * w[:, 1].clamp(min=0)) @ radiance
    torch.testing.assert_close(radiance[-1], 0.2 / math.pi * falls, rtol=1e-5, atol=1e-6)


@pytest.mark.errors
@pytest.mark.parametrize("wrong", [{"elevation_deg": 0}, {"turbidity": 1}, {"height": 1}, {"azimuth_deg": 1e5}])
def test_a_sky_out_of_range_is_refused(wrong):
    with pytest.raises(ConfigError, match=f"sky.{next(iter(wrong))}"):
        sky.build(**wrong)
