import math

import pytest
import torch

from torchmeso.bench import light, light_error
from torchmeso.bench.suite import Context
from torchmeso.data.environment import Environment
from torchmeso.transport import light_sampling


def test_names_are_no_beginnings_of_one_another():
    names = [m.name for m in light.MEASUREMENTS]
    assert len(set(names)) == len(names)


@pytest.fixture
def small_maps(monkeypatch, rng):
    radiance = torch.rand(8, 16, 3, generator=rng)
    radiance[2, 3] = 50.0
    made = Environment(radiance=radiance, rotation=torch.eye(3))
    monkeypatch.setattr(light_error, "_maps", lambda: iter([("small", made), ("none", None)]))
    monkeypatch.setattr(light_error, "REFERENCE", 300)
    monkeypatch.setattr(light_error, "points_of_a_knot", lambda some=light_error.points_of_a_knot: some(16))


def test_rows_of_sampling(small_maps):
    rows = {row.id: row for row in light_error.sampling(Context(quick=True))}
    assert rows["light.sampling.none"].value is None
    assert rows["light.sampling.small.200.quadtree"].value < rows["light.sampling.small.50.quadtree"].value
    assert rows["light.sampling.small.50.quadtree"].value < rows["light.sampling.small.50.uniform"].value
    assert rows["light.bias.small.50"].value >= 0


def test_flicker_of_the_reference_is_the_unit(small_maps, monkeypatch):
    ours = light_sampling.directions
    monkeypatch.setattr(light_error, "REFERENCE", 200)
    monkeypatch.setattr(light_sampling, "directions", lambda texels, count, method="quadtree": ours(texels, count))
    row = next(iter(light_error.flicker(Context(quick=True))))
    assert row.value == pytest.approx(1) and row.goal == pytest.approx(1)


def test_rows_of_energy_and_bands(small_maps):
    (row,) = light_error.energy(Context())
    assert row.met
    rows = list(light_error.bands(Context()))
    assert rows[-1].value < rows[0].value


def test_what_a_cap_leaves_is_its_integral():
    left = light_error._of_a_cap(math.pi / 2, 2)
    half = torch.tensor([0.5, 0, -math.sqrt(3) / 4, 0, 0, 0, 0, 0, 0], dtype=torch.float64)
    torch.testing.assert_close(left, half)
