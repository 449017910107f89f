import math

import pytest
import torch

from torchmeso.algebra import spherical_harmonics
from torchmeso.errors import ConfigError
from torchmeso.geometry import cube_map


@pytest.mark.parametrize("n", [1, 2, 7])
def test_solid_angles_are_the_sphere(n):
    cube = cube_map.texels(n)
    assert len(cube.directions) == len(cube.solid_angle) == 6 * n * n
    assert float(cube.solid_angle.sum()) == pytest.approx(4 * math.pi, rel=1e-13)
    torch.testing.assert_close(cube.directions.norm(dim=1), torch.ones(6 * n * n, dtype=torch.float64))
    assert len(cube.directions.mul(1e6).round().unique(dim=0)) == 6 * n * n


def test_a_face_is_a_sixth_and_its_corner_smaller_than_its_middle():
    face = cube_map.texels(8).solid_angle.reshape(6, 8, 8)
    assert face.sum((1, 2)).tolist() == pytest.approx([4 * math.pi / 6] * 6)
    assert face[0, 0, 0] < 0.4 * face[0, 4, 4]


def test_harmonics_are_projected_onto_themselves():
    """Products of two harmonics summed over the texels: the error falls with the square of their size."""
    errors = []
    for n in (16, 32):
        cube = cube_map.texels(n)
        y = spherical_harmonics.basis(cube.directions, 4)
        found = spherical_harmonics.project(y.mT, cube.directions, cube.solid_angle, 4)
        errors.append(float((found - torch.eye(25, dtype=torch.float64)).abs().max()))
    assert errors[0] < 0.02
    assert errors[1] < 0.3 * errors[0]


@pytest.mark.errors
def test_sizes_are_checked():
    with pytest.raises(ConfigError, match="texels along a face"):
        cube_map.texels(0)
