"""A sky by formula, clear to hazy, so that there is distant light without a file.

Luminance and chromaticity of the sky are Perez functions whose coefficients are linear in turbidity (preetham1999sky,
section 3 and appendix 2): 2 is very clear, 10 hazy. The sun is a lobe of one texel that carries the sunlight left by
Rayleigh scattering and aerosol (appendix 1, without ozone and water), in red, green and blue; the ground below the
horizon reflects a fifth of what falls on it. +y is up.

Radiance 1 is `UNIT`: under a clear noon a white diffuser comes out near 1.

Test: tests/data/test_sky.py
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.data.environment import Environment
from torchmeso.errors import check_range

UNIT = 30.0
"""kcd / m^2."""

SUNLIGHT = 127.5
"""klx of the sun above the atmosphere."""

GROUND = 0.2
"""Share of light that the ground reflects."""

WAVELENGTHS = (0.65, 0.55, 0.45)
"""Of red, green and blue, in micrometres."""

# Coefficients A to E, each (of T, constant): of luminance Y and of the chromaticities x and y.
PEREZ = {
    "Y": ((0.1787, -1.4630), (-0.3554, 0.4275), (-0.0227, 5.3251), (0.1206, -2.5771), (-0.0670, 0.3703)),
    "x": ((-0.0193, -0.2592), (-0.0665, 0.0008), (-0.0004, 0.2125), (-0.0641, -0.8989), (-0.0033, 0.0452)),
    "y": ((-0.0167, -0.2608), (-0.0950, 0.0092), (-0.0079, 0.2102), (-0.0441, -1.6537), (-0.0109, 0.0529)),
}

# Chromaticity of the zenith: rows T^2, T, 1; columns theta_s^3, theta_s^2, theta_s, 1.
ZENITH = {
    "x": (
        (0.00166, -0.00375, 0.00209, 0.0),
        (-0.02903, 0.06377, -0.03202, 0.00394),
        (0.11693, -0.21196, 0.06052, 0.25886),
    ),
    "y": (
        (0.00275, -0.00610, 0.00317, 0.0),
        (-0.04214, 0.08970, -0.04153, 0.00516),
        (0.15346, -0.26756, 0.06670, 0.26688),
    ),
}

TO_RGB = ((3.2406, -1.5372, -0.4986), (-0.9689, 1.8758, 0.0415), (0.0557, -0.2040, 1.0570))
"""Linear sRGB of CIE XYZ (IEC 61966-2-1)."""


def build(
    *, elevation_deg: float = 45.0, azimuth_deg: float = 30.0, turbidity: float = 3.0, height: int = 128
) -> Environment:
    """Return the sky as a lat-long map of height x 2 height texels.

    Args:
        elevation_deg: of the sun above the horizon, 1 to 90.
        azimuth_deg: of the sun, from -z towards +x.
        turbidity: haze, 2 to 10.
        height: rows of the map, 2 to 4096.

    Raises:
        ConfigError: an argument is out of range.
    """
    check_range("sky.elevation_deg", elevation_deg, 1, 90)
    check_range("sky.azimuth_deg", azimuth_deg, -3600, 3600)
    check_range("sky.turbidity", turbidity, 2, 10)
    check_range("sky.height", height, 2, 4096)
    blank = torch.zeros(height, 2 * height, 3, dtype=torch.float64)
    w, solid_angle, _ = Environment(radiance=blank, rotation=torch.eye(3)).texels()
    theta_s, azimuth = math.radians(90 - elevation_deg), math.radians(azimuth_deg)
    sun = torch.tensor(
        [math.sin(theta_s) * math.sin(azimuth), math.cos(theta_s), -math.sin(theta_s) * math.cos(azimuth)]
    )
    up = w[:, 1] > 0
    rgb = blank.reshape(-1, 3)
    rgb[up] = sky(w[up], sun.double(), turbidity)
    # The lobe's texel is one above the horizon.
    nearest = torch.where(up, w @ sun.double(), -2).argmax()
    rgb[nearest] += sunlight(theta_s, turbidity) / solid_angle[nearest]
    falls = (solid_angle[up] * w[up, 1]) @ rgb[up]
    rgb[~up] = GROUND / math.pi * falls
    return Environment(radiance=(rgb / UNIT).float().reshape(height, 2 * height, 3), rotation=torch.eye(3))


def sky(w: Float[Tensor, "n 3"], sun: Float[Tensor, "3"], turbidity: float) -> Float[Tensor, "n 3"]:
    """Return the radiance of the sky towards `w` above the horizon, kcd / m^2 in linear sRGB (preetham1999sky)."""
    T, theta_s = turbidity, math.acos(float(sun[1].clamp(-1, 1)))
    chi = (4 / 9 - T / 120) * (math.pi - 2 * theta_s)
    zenith = {"Y": max((4.0453 * T - 4.9710) * math.tan(chi) - 0.2155 * T + 2.4192, 0.0)}
    for name, rows in ZENITH.items():
        powers = [sum(a * theta_s**k for a, k in zip(row, (3, 2, 1, 0), strict=True)) for row in rows]
        zenith[name] = powers[0] * T * T + powers[1] * T + powers[2]
    cosine, angle = w[:, 1].clamp(min=1e-3), (w @ sun).clamp(-1, 1).acos()
    still = torch.tensor([1.0, theta_s], dtype=w.dtype)
    Y, x, y = (
        zenith[name] * _perez(name, T, cosine, angle) / _perez(name, T, still[:1], still[1:])
        for name in ("Y", "x", "y")
    )
    xyz = torch.stack([x / y * Y, Y, (1 - x - y) / y * Y], -1)
    return (xyz @ torch.tensor(TO_RGB, dtype=w.dtype).mT).clamp(min=0)


def _perez(name: str, T: float, cosine: Tensor, angle: Tensor) -> Tensor:
    """Return F = (1 + A exp(B / cos theta)) (1 + C exp(D gamma) + E cos^2 gamma)."""
    A, B, C, D, E = (slope * T + constant for slope, constant in PEREZ[name])
    return (1 + A * (B / cosine).exp()) * (1 + C * (D * angle).exp() + E * angle.cos().square())


def sunlight(theta_s: float, turbidity: float) -> Float[Tensor, "3"]:
    """Return the sun's irradiance at normal incidence, klx, behind the air on its way."""
    elevation = 90 - math.degrees(theta_s)
    mass = 1 / (math.cos(theta_s) + 0.15 * (elevation + 3.885) ** -1.253)
    wavelength = torch.tensor(WAVELENGTHS, dtype=torch.float64)
    haze = 0.04608 * turbidity - 0.04586
    depth = 0.008735 * wavelength**-4.08 + haze * wavelength**-1.3
    return SUNLIGHT * (-mass * depth).exp()
