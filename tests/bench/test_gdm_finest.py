import torch

from torchmeso.bench import gdm_finest
from torchmeso.bench.gdm_finest import Ray, Unbaked
from torchmeso.bench.suite import Context
from torchmeso.data import gdm_query
from torchmeso.geometry.directions import normalize
from torchmeso.geometry.sphere import SphereGrid
from torchmeso.meso import bake_gdm, generators
from torchmeso.meso.bake_gdm import GdmOptions, RayCastGdm


def questions(n, h, rng):
    place = torch.rand(n, 3, generator=rng, dtype=torch.float64)
    place[:, 2] *= -h
    return place, normalize(torch.randn(n, 3, generator=rng, dtype=torch.float64))


def test_samples_that_are_cast_are_those_of_a_baked_table(rng):
    """But for the poles, which a table fills from the ring beside them."""
    meso = generators.pipes()
    baked = bake_gdm.in_memory(meso, GdmOptions(texels=12, layers=6, n_theta=6, n_phi=8, storage="float32"))
    cast = Unbaked(RayCastGdm(meso, baked.cap), baked.voxels, baked.directions)
    place, w = questions(2000, meso.h, rng)
    w = w[w[:, 2].abs() < 0.9]
    place = place[: len(w)]
    found, right = gdm_query.query(cast, place, w), baked.evaluate(place, w)
    assert torch.equal(cast.solid[torch.arange(12 * 12 * 6)], baked.solid)
    assert (found.left == right.left).double().mean() > 0.999
    same = found.left == right.left
    torch.testing.assert_close(found.distance[same], right.distance[same], rtol=0, atol=1e-5)


def test_codes_are_those_of_bytes(rng):
    meso = generators.pipes()
    baked = bake_gdm.in_memory(meso, GdmOptions(texels=8, layers=4, n_theta=4, n_phi=6))
    cast = Unbaked(RayCastGdm(meso, baked.cap), baked.voxels, SphereGrid(n_theta=4, n_phi=6), codes=255)
    voxel = torch.arange(8 * 8 * 4).reshape(-1, 8)
    node = 6 + torch.arange(24).reshape(-1, 4)[torch.randint(6, (len(voxel),), generator=rng)]
    found, right = cast.samples(voxel, node, torch.float32), baked.samples(voxel, node, torch.float32)
    torch.testing.assert_close(found[1], right[1])
    torch.testing.assert_close(found[0] * found[1], right[0] * right[1], rtol=0, atol=1e-6)


def test_the_limit_of_tables_is_the_ray(rng):
    meso = generators.pipes()
    caster = RayCastGdm(meso, 1.0)
    place, w = questions(500, meso.h, rng)
    found = Ray(caster).evaluate(place, w)
    t, _ = caster.cast(place.float(), w.float(), torch.zeros(500, dtype=torch.bool))
    hits = ~found.left
    torch.testing.assert_close(found.distance[hits], t[hits].double(), rtol=0, atol=1e-6)


def test_maps_begin_with_the_ray():
    caster = RayCastGdm(generators.pipes(), 1.0)
    names = [name for name, *_ in gdm_finest.maps(caster, Context())]
    assert names[0] == "ray"
    assert gdm_finest.FINEST in names
    assert len(set(names)) == len(names)
