import math

import pytest
import torch

from torchmeso.algebra import spherical_harmonics
from torchmeso.data import environment, image
from torchmeso.data.environment import FACES, Environment
from torchmeso.errors import ConfigError, FormatError, ShapeError


def white(height=8):
    return Environment(radiance=torch.ones(height, 2 * height, 3), rotation=torch.eye(3))


def turn_about_x(angle):
    c, s = math.cos(angle), math.sin(angle)
    return torch.tensor([[1.0, 0, 0], [0, c, -s], [0, s, c]])


def cube_of(function, n=8):
    """A cube map of a function of direction."""
    blank = Environment(radiance=torch.zeros(6, n, n, 3), layout="cube", rotation=torch.eye(3))
    return function(blank.texels().directions).float().reshape(6, n, n, 1).expand(-1, -1, -1, 3).contiguous()


@pytest.mark.parametrize(
    "made", [white(), Environment(radiance=torch.ones(6, 5, 5, 3), layout="cube", rotation=torch.eye(3))]
)
def test_texels_cover_the_sphere(made):
    w, solid_angle, radiance = made.texels()
    torch.testing.assert_close(solid_angle.sum(), torch.tensor(4 * math.pi, dtype=torch.float64))
    torch.testing.assert_close(w.norm(dim=1), torch.ones(len(w), dtype=torch.float64))
    torch.testing.assert_close(made.irradiance(), torch.full((3,), 4 * math.pi, dtype=torch.float64))
    assert len(radiance) == len(w)


def test_up_ahead_and_right_of_a_lat_long_map():
    w = white(64).texels().directions.reshape(64, 128, 3)
    for (row, column), wanted in {(0, 5): (0, 1, 0), (32, 64): (0, 0, -1), (32, 96): (1, 0, 0)}.items():
        assert float(w[row, column] @ torch.tensor(wanted, dtype=torch.float64)) > 0.998


def test_cube_and_lat_long_agree_on_a_smooth_function():
    def shine(w):
        return 2 + w[:, 0] + 0.5 * w[:, 1] * w[:, 2]

    flat = white(64)
    flat = Environment(
        radiance=shine(flat.texels().directions).float().reshape(64, 128, 1).expand(-1, -1, 3), rotation=torch.eye(3)
    )
    cube = Environment(radiance=cube_of(shine, 32), layout="cube", rotation=torch.eye(3))
    torch.testing.assert_close(flat.harmonics(2), cube.harmonics(2), rtol=0, atol=1e-2)  # measured 1.4e-3


def test_harmonics_of_a_turned_map_are_the_turned_harmonics(rng):
    radiance = torch.rand(16, 32, 3, generator=rng)
    still = Environment(radiance=radiance, rotation=torch.eye(3))
    R = turn_about_x(0.7)
    turned = Environment(radiance=radiance, rotation=R, exposure=1.0)
    wanted = 2 * spherical_harmonics.rotate(still.harmonics(4).mT, R.double()).mT
    torch.testing.assert_close(turned.harmonics(4), wanted, rtol=1e-6, atol=1e-6)  # a float32 rotation


@pytest.mark.parametrize("shape", list(FACES))
def test_every_layout_of_a_cube_map_reads_the_same(shape, tmp_path):
    cube = cube_of(lambda w: 2 + w[:, 0] + 0.3 * w[:, 1] - 0.2 * w[:, 2] + w[:, 0] * w[:, 1])
    picture = torch.zeros(shape[0] * 8, shape[1] * 8, 3)
    for face, (row, column) in zip(cube, FACES[shape], strict=True):
        turned = shape == (4, 3) and (row, column) == (3, 1)
        picture[8 * row : 8 * row + 8, 8 * column : 8 * column + 8] = face.flip(0, 1) if turned else face
    image.write_exr(tmp_path / "cube.exr", picture)
    found = environment.read(tmp_path / "cube.exr")
    assert found.layout == "cube" and torch.equal(found.radiance, cube)


def test_faces_of_a_cross_meet_at_their_edges(tmp_path):
    # A cross is a net of the cube: neighbours in the picture are neighbours on the sphere.
    w = cube_of(lambda w: w[:, 0])[..., 0], cube_of(lambda w: w[:, 1])[..., 0], cube_of(lambda w: w[:, 2])[..., 0]
    faces = torch.stack(w, -1)
    places = FACES[3, 4]
    net = torch.full((24, 32, 3), math.nan)
    for face, (row, column) in zip(faces, places, strict=True):
        net[8 * row : 8 * row + 8, 8 * column : 8 * column + 8] = face
    step = (net[:, 1:] - net[:, :-1]).norm(dim=-1), (net[1:] - net[:-1]).norm(dim=-1)
    assert max(float(x[x.isfinite()].max()) for x in step) < 0.3
    upright = torch.full((32, 24, 3), math.nan)
    for k, (row, column) in enumerate(FACES[4, 3]):
        upright[8 * row : 8 * row + 8, 8 * column : 8 * column + 8] = faces[k].flip(0, 1) if k == 5 else faces[k]
    step = (upright[1:] - upright[:-1]).norm(dim=-1)
    assert float(step[step.isfinite()].max()) < 0.3


def test_one_texel_is_light_from_everywhere(tmp_path):
    image.write_exr(tmp_path / "one.exr", torch.full((1, 1, 3), 0.5))
    c = environment.read(tmp_path / "one.exr").irradiance()
    torch.testing.assert_close(c, torch.full((3,), 2 * math.pi, dtype=torch.float64))


def test_large_maps_are_averaged_without_losing_energy(monkeypatch, rng):
    monkeypatch.setattr(environment, "MOST_ROWS", 8)
    radiance = torch.rand(32, 64, 3, generator=rng)
    radiance[3, 5] = 1e4
    whole, less = (Environment(radiance=x, rotation=torch.eye(3)) for x in (radiance, environment.reduced(radiance)))
    assert less.radiance.shape == (8, 16, 3)
    torch.testing.assert_close(less.irradiance(), whole.irradiance(), rtol=1e-6, atol=0)


def test_values_that_are_no_light_are_cleaned_and_counted(tmp_path):
    radiance = torch.ones(2, 4, 3)
    radiance[0, 0, 0], radiance[0, 1], radiance[1, 2, 1] = math.nan, -1.0, math.inf
    image.write_exr(tmp_path / "bad.exr", radiance)
    with pytest.warns(UserWarning, match="of 24 values 1 not a number, 3 below 0, 1 infinite"):
        found = environment.read(tmp_path / "bad.exr").radiance
    assert found[0, 0].tolist() == [0, 1, 1] and found[0, 1].tolist() == [0, 0, 0] and float(found.max()) == 1


def test_a_black_map_is_said_to_be_black(tmp_path):
    image.write_exr(tmp_path / "black.exr", torch.zeros(2, 4, 3))
    with pytest.warns(UserWarning, match="sends no light"):
        assert float(environment.read(tmp_path / "black.exr").irradiance().sum()) == 0


@pytest.mark.errors
def test_what_is_no_map_is_refused(tmp_path):
    image.write_exr(tmp_path / "odd.exr", torch.ones(5, 7, 3))
    with pytest.raises(FormatError, match=r"2 : 1.*got 7 x 5"):
        environment.read(tmp_path / "odd.exr")
    image.write_exr(tmp_path / "none.exr", torch.full((2, 4, 3), math.nan))
    with pytest.raises(FormatError, match="none that is a finite number"):
        environment.read(tmp_path / "none.exr")


@pytest.mark.errors
@pytest.mark.parametrize(
    "change, error, text",
    [
        ({"layout": "ball"}, ConfigError, "expected lat_long or cube, got 'ball'"),
        ({"radiance": torch.ones(4, 4)}, ShapeError, "environment: expected shape"),
        ({"radiance": torch.ones(0, 4, 3)}, ShapeError, "at least one texel"),
        ({"radiance": -torch.ones(2, 4, 3)}, ShapeError, "got -1"),
        ({"rotation": 2 * torch.eye(3)}, ShapeError, "orthonormal"),
        ({"exposure": 99.0}, ConfigError, "environment.exposure"),
    ],
)
def test_an_environment_that_means_no_light_is_refused(change, error, text):
    with pytest.raises(error, match=text):
        Environment(**{"radiance": torch.ones(2, 4, 3), "rotation": torch.eye(3), **change})
