import math

import numpy as np
import pytest
import torch

from tests.tolerances import FLOAT64
from torchmeso.errors import ConfigError
from torchmeso.geometry import hemisphere
from torchmeso.geometry.directions import from_angles, normalize

SETS = [
    "grid(12, 5, 80)",
    "grid(15, 10, 87.5)",
    "ubo81",
    "ubo151",
    "grid(1, 1, 40)",
    "grid(3, 2, 60)",
    "rings(0: 1, 20.5: 6, 60: 12 @ 7.5)",
]


@pytest.fixture(params=SETS)
def directions(request):
    return hemisphere.parse(request.param)


def lookup(directions, table, w):
    found = hemisphere.interpolate(directions, w)
    return (hemisphere.with_pole(table, directions)[found.node] * found.weight).sum(-1)


def test_ring_angles_of_the_papers_grid():
    rings = hemisphere.grid(12, 5, 80)
    assert rings.theta_deg == pytest.approx([80 * (k + 0.5) / 4.5 for k in range(5)])
    assert rings.theta_deg[-1] == pytest.approx(80)
    assert len(rings) == 60


def test_ubo_sets_have_their_sizes():
    assert len(hemisphere.ubo81()) == 81
    assert len(hemisphere.ubo151()) == 151


def test_ubo151_equals_the_published_directions(data_dir):
    published = np.fromfile(data_dir / "directions" / "xyz_loc.bin", dtype=np.float64)
    xyz = torch.from_numpy(published[: 3 * 151].reshape(3, 151).T.copy())
    torch.testing.assert_close(hemisphere.ubo151().directions(torch.float64), xyz, rtol=0, atol=1e-6)


def test_parse_inverts_the_name(directions):
    assert hemisphere.parse(directions.name) == directions


def test_weights_are_a_partition_of_unity(directions, rng):
    w = normalize(torch.randn(2000, 3, dtype=torch.float64, generator=rng))
    found = hemisphere.interpolate(directions, w)
    assert found.node.min() >= 0
    assert found.node.max() < directions.n_nodes
    assert found.weight.min() >= 0
    torch.testing.assert_close(found.weight.sum(-1), torch.ones(2000, dtype=torch.float64), **FLOAT64)


def test_exact_at_the_samples(directions, rng):
    table = torch.rand(len(directions), dtype=torch.float64, generator=rng)
    torch.testing.assert_close(lookup(directions, table, directions.directions(torch.float64)), table, **FLOAT64)


def test_pole_is_the_mean_of_the_first_ring(rng):
    directions = hemisphere.grid(12, 5, 80)
    table = torch.rand(60, dtype=torch.float64, generator=rng)
    pole = lookup(directions, table, torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64))
    torch.testing.assert_close(pole[0], table[:12].mean(), **FLOAT64)


@pytest.mark.parametrize("axis", [(1.0, 0.3, 0.0), (0.0, 1.0, 0.0), (0.7, -0.7, 0.1)])
def test_continuous_along_great_circles(directions, axis, rng):
    """The largest step of a sweep through pole and horizon shrinks with the step of the angle."""
    table = torch.rand(len(directions), dtype=torch.float64, generator=rng)
    a = normalize(torch.tensor(axis, dtype=torch.float64))
    start = normalize(torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64) - a[2] * a)
    side = torch.linalg.cross(a, start)
    jumps = []
    for n in (20_000, 40_000):
        angle = torch.linspace(-1.8, 1.8, n, dtype=torch.float64)[:, None]  # both ends below the horizon
        jumps.append(lookup(directions, table, angle.cos() * start + angle.sin() * side).diff().abs().max())
    assert jumps[1] <= 0.7 * jumps[0] + 1e-9


def test_continuous_in_azimuth_around_the_pole(directions, rng):
    table = torch.rand(len(directions), dtype=torch.float64, generator=rng)
    phi = torch.linspace(0, 2 * math.pi, 100, dtype=torch.float64)
    near = lookup(directions, table, from_angles(torch.full_like(phi, 1e-9), phi))
    if directions.needs_pole or directions.count[0] == 1:
        assert near.max() - near.min() < 1e-6


def test_held_below_the_last_ring(directions, rng):
    table = torch.rand(len(directions), dtype=torch.float64, generator=rng)
    phi = torch.rand(50, dtype=torch.float64, generator=rng) * 7
    values = [lookup(directions, table, from_angles(torch.full_like(phi, t), phi)) for t in (directions.last, 1.6, 3.0)]
    torch.testing.assert_close(values[1], values[0], **FLOAT64)
    torch.testing.assert_close(values[2], values[0], **FLOAT64)


def test_quadrature_integrates_what_is_interpolated(directions, rng):
    table = torch.rand(len(directions), dtype=torch.float64, generator=rng)
    n = 1200
    theta = (torch.arange(n, dtype=torch.float64) + 0.5) / n * (math.pi / 2)
    phi = (torch.arange(n, dtype=torch.float64) + 0.5) / n * (2 * math.pi)
    t, p = torch.meshgrid(theta, phi, indexing="ij")
    value = lookup(directions, table, from_angles(t, p))
    falloff = torch.where(t > directions.last, t.cos() / math.cos(directions.last), 1.0)
    brute = (value * falloff * t.sin()).sum() * (math.pi / 2 / n) * (2 * math.pi / n)
    torch.testing.assert_close((hemisphere.quadrature(directions) * table).sum(), brute, rtol=2e-5, atol=0)


def test_white_diffuser_has_ambient_one():
    directions = hemisphere.grid(15, 10, 87.5)
    cosine = directions.directions(torch.float64)[:, 2]
    ambient = (hemisphere.quadrature(directions) * cosine).sum() / math.pi
    assert float(ambient) == pytest.approx(1, abs=5e-3)  # the interpolation's own error, 10 rings


def test_gradient(rng):
    directions = hemisphere.grid(5, 4, 75)
    table = torch.rand(20, dtype=torch.float64, generator=rng)
    theta = torch.tensor([0.1, 0.4, 0.9, 1.25], dtype=torch.float64)
    w = from_angles(theta, torch.tensor([0.3, -2.0, 2.9, 1.0], dtype=torch.float64)).requires_grad_()
    assert torch.autograd.gradcheck(lambda w: lookup(directions, table, w), (w,))


def test_integer_tables_get_a_rounded_pole():
    directions = hemisphere.grid(2, 1, 40)
    assert hemisphere.with_pole(torch.tensor([1, 2, 4], dtype=torch.uint8)[:2], directions).tolist() == [1, 2, 2]


@pytest.mark.errors
@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("grid(12)", "expected 'grid"),
        ("ubo82", "expected 'grid"),
        ("grid(12, 5, 95)", "theta: expected a value from 0 to 89.9"),
        ("rings(0: 1, 20)", r"expected 'rings\(theta: count @ phi, ...\)' in degrees, got 'rings\(0: 1, 20\)'"),
        ("rings(0: 1", "expected 'rings"),
        ("rings(20: 1, 0: 1)", "increasing theta"),
        ("grid(0, 5, 80)", "n_phi: expected a value from 1"),
    ],
)
def test_malformed_sets_are_refused(text, message):
    with pytest.raises(ConfigError, match=message):
        hemisphere.parse(text)


@pytest.mark.errors
def test_rings_must_increase():
    with pytest.raises(ConfigError, match="increasing theta"):
        hemisphere.DirectionSet(name="x", theta_deg=(30, 20), count=(3, 3), phi0_deg=(0, 0))
    with pytest.raises(ConfigError, match="as many counts"):
        hemisphere.DirectionSet(name="x", theta_deg=(30,), count=(3, 3), phi0_deg=(0, 0))
