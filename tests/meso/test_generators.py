"""Laws of every built-in tile; closed forms stand in the tests of the files they are made in."""

import inspect

import pytest
import torch

from tests.meso.looks import looks, wrong
from torchmeso.errors import MesoError
from torchmeso.geometry.rays import RayScene
from torchmeso.meso.bake_mdf import RayCastMdf
from torchmeso.meso.generators import GENERATORS

OPEN = {"chain", "grid"}
"""Rays pass through these as they are; weave and grass have a backing unless told otherwise."""


@pytest.mark.parametrize("name", list(GENERATORS))
def test_everything_repeats(name, rng):
    caster = RayCastMdf(GENERATORS[name]())
    uv, wo = looks(rng, 75)
    shift = torch.tensor([2.0, -3.0], dtype=torch.float64)
    assert wrong(caster.evaluate(uv, wo), caster.evaluate(uv + shift, wo), 1e-4) < 2e-3


@pytest.mark.parametrize("name", list(GENERATORS))
def test_rays_go_on_across_the_border(name, rng):
    """Nine copies side by side as one finite mesh give the same distances as the wrapped tile."""
    meso = GENERATORS[name]()
    uv, wo = looks(rng, 45, n=1500)
    uv = uv / 40 + torch.randint(0, 2, uv.shape, generator=rng)  # within a twentieth of a corner of the tile
    ahead = 1e-4 / wo[:, 2:]
    start = torch.cat([uv, torch.zeros_like(ahead)], 1) + ahead * wo
    g, n = meso.geometry, len(meso.geometry.vertices)
    shifts = torch.tensor([[i, j, 0] for i in (-1, 0, 1) for j in (-1, 0, 1)])
    field = RayScene(
        (g.vertices + shifts[:, None]).reshape(-1, 3), (g.faces + n * torch.arange(9)[:, None, None]).reshape(-1, 3)
    )
    hits = field.first_hit(start.float(), -wo.float())
    expected = torch.where(hits.face >= 0, (hits.t.double() - ahead[:, 0]).clamp(min=0), torch.inf)
    assert wrong(RayCastMdf(meso).evaluate(uv, wo), expected, 2e-4) < 5e-3


@pytest.mark.parametrize("name", list(GENERATORS))
def test_top_and_depth(name):
    meso = GENERATORS[name]()
    z = meso.geometry.vertices[:, 2]
    assert float(z.min()) >= -meso.h - 1e-6
    if name != "sheet":
        assert float(z.max()) == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("name", list(GENERATORS))
def test_only_open_tiles_let_rays_through(name, rng):
    D = RayCastMdf(GENERATORS[name]()).evaluate(*looks(rng, 60))
    assert bool(D.isinf().any()) == (name in OPEN)
    assert float(D.isinf().double().mean()) < 0.75


ODD = {int: (-1, 0, 1, 3, 10**6, 2**40), float: (-1.0, 0.0, 1e-30, 1e30)}


@pytest.mark.errors
@pytest.mark.parametrize("name", list(GENERATORS))
def test_numbers_out_of_range_are_refused_or_make_a_tile(name):
    """Nothing else leaves, and nothing takes all memory to find out."""
    for key, parameter in inspect.signature(GENERATORS[name]).parameters.items():
        for value in ODD.get(type(parameter.default), ()):
            try:
                GENERATORS[name](**{key: value})
            except MesoError:
                continue
