import math

import pytest
import torch

from torchmeso.data import gdm as gdm_data
from torchmeso.data.mdf import MIN_COS
from torchmeso.errors import ConfigError, SizeError
from torchmeso.geometry.directions import normalize
from torchmeso.meso import bake_gdm, generators, mesostructure
from torchmeso.meso.bake_gdm import GdmOptions, RayCastGdm
from torchmeso.meso.bake_mdf import RayCastMdf
from torchmeso.meso.mesostructure import Mesostructure
from torchmeso.transport.tracer import Geometry

SMALL = GdmOptions(texels=12, layers=7, n_theta=6, n_phi=8)
FINE = GdmOptions(texels=12, layers=7, n_theta=6, n_phi=8, storage="float32")


def box(low, high, h):
    """Closed boxes, outwards."""
    corner = torch.cartesian_prod(*(torch.tensor([0.0, 1.0]) for _ in range(3)))
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    one = torch.tensor([[q[i], q[j], q[k]] for q in quads for i, j, k in ((0, 1, 2), (0, 2, 3))])
    low, high = torch.tensor(low), torch.tensor(high)
    vertices = (low[:, None] + corner * (high - low)[:, None]).reshape(-1, 3)
    faces = (one + 8 * torch.arange(len(low))[:, None, None]).reshape(-1, 3)
    geometry = Geometry(
        vertices=vertices, faces=faces, part=torch.zeros(len(faces), dtype=torch.long),
        palette=mesostructure.palette(((0.2, 0.4, 0.6), 0.3, 0.04)),
    )  # fmt: skip
    return Mesostructure(geometry=geometry, h=h)


def test_three_cases_of_two_boxes_that_overlap(rng):
    """Inside either or both, and exact distances elsewhere; the lower box reaches over the tile's border."""
    low, high = [[0.2, 0.2, -0.3], [0.5, 0.5, -0.2]], [[0.6, 0.6, -0.1], [1.1, 0.9, -0.05]]
    caster = RayCastGdm(box(low, high, 0.4), cap=1.0)
    place = torch.rand(4000, 3, generator=rng) * torch.tensor([1.0, 1.0, -0.4])
    shift = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    truth = torch.zeros(4000, dtype=torch.bool)
    for a, b in zip(torch.tensor(low), torch.tensor(high), strict=True):
        for s in shift:
            truth |= ((place + s > a) & (place + s < b)).all(-1)
    near = torch.zeros_like(truth)
    for a, b in zip(torch.tensor(low), torch.tensor(high), strict=True):
        for s in shift:
            near |= ((place + s - a).abs() < 1e-3).any(-1) | ((place + s - b).abs() < 1e-3).any(-1)
    assert torch.equal(caster.inside(place)[~near], truth[~near])
    down = torch.tensor([0.0, 0.0, -1.0]).expand(4000, 3)
    t, face = caster.cast(place, down, truth)
    over = (
        (place[:, 0] < 0.45) & (place[:, 0] > 0.2) & (place[:, 1] > 0.2) & (place[:, 1] < 0.45) & (place[:, 2] > -0.1)
    )
    torch.testing.assert_close(t[over], (place[over, 2] + 0.1), rtol=0, atol=2e-6)
    assert (face[over] >= 0).all()


@pytest.mark.parametrize("name", ["brick", "weave", "chain", "grass"])
def test_the_table_equals_the_ray_cast_at_its_samples(name):
    meso = generators.GENERATORS[name]()
    gdm = bake_gdm.in_memory(meso, FINE)
    caster = RayCastGdm(meso, FINE.cap)
    layer, row, column = torch.meshgrid(torch.arange(7), torch.arange(12), torch.arange(12), indexing="ij")
    place = torch.stack([(column + 0.5) / 12, 1 - (row + 0.5) / 12, -meso.h + meso.h * layer / 6], -1).reshape(-1, 3)
    inside = caster.inside(place)
    assert torch.equal(inside, gdm.occupancy.flatten() > 0.5)
    for theta, phi in ((0, 1), (2, 3), (5, 7)):
        w = gdm.directions.directions()[theta, phi].expand(len(place), 3)
        t, _ = caster.cast(place, w, inside)
        left, distance = gdm.left[..., theta, phi].flatten(), gdm.distance[..., theta, phi].flatten()
        assert (distance[inside] == 0).all()
        hit = ~inside & ~left
        assert (distance[hit] - t[hit]).abs().max() <= 1.1 * bake_gdm.BEHIND if hit.any() else True
        end = gdm.boundary(place, w)
        assert (t[left] >= end[left]).all()


@pytest.mark.parametrize("name", ["brick", "spheres", "weave"])
def test_from_the_top_it_is_the_mdf(name, rng):
    """Identity: D(u, v, wo) = d(u, v, 0, -wo), and `left` where there is no hit."""
    meso = generators.GENERATORS[name](**({"backing": False} if name == "weave" else {}))
    down = normalize(torch.randn(2000, 3, generator=rng))
    wo = torch.cat([down[:, :2], down[:, 2:].abs()], -1)
    wo = wo[wo[:, 2] > max(MIN_COS, 0.4)]
    uv = torch.rand(len(wo), 2, generator=rng)
    D = RayCastMdf(meso).evaluate(uv, wo)
    place = torch.cat([uv, torch.zeros(len(uv), 1)], -1)
    outside = torch.zeros(len(uv), dtype=torch.bool)
    t, _ = RayCastGdm(meso, 1.0).cast(place, -wo, outside)
    torch.testing.assert_close(torch.where(D.isinf(), 0, t), torch.where(D.isinf(), 0, D), rtol=0, atol=4e-4)
    assert (t[D.isinf()] > meso.h / wo[D.isinf(), 2] - 1e-3).all()


def test_points_on_a_plateau_look_up_freely():
    """A brick's top lies at the reference plane: a ray that leaves it upwards is not stopped by the brick itself."""
    gdm = bake_gdm.in_memory(generators.brick(), SMALL)
    climbing = gdm.directions.directions()[..., 2] > 0
    assert gdm.left[-1][..., climbing].all()
    assert not (gdm.occupancy[-1] > 0.5).any()
    falling = gdm.distance[-1][..., ~climbing]
    assert (falling.amin(-1) == 0).any()  # on a brick


def test_error_falls_with_voxels_and_directions(rng):
    meso = generators.spheres()
    caster = RayCastGdm(meso, 1.0)
    place = torch.rand(4000, 3, generator=rng) * torch.tensor([1.0, 1.0, -meso.h])
    w = normalize(torch.randn(4000, 3, generator=rng))
    inside = caster.inside(place)
    errors = []
    for texels, layers, n in ((6, 4, 6), (12, 7, 12), (24, 13, 24)):
        options = GdmOptions(texels=texels, layers=layers, n_theta=n // 2, n_phi=n)
        gdm = bake_gdm.in_memory(meso, options)
        t, _ = caster.cast(place, w, inside)
        truth = torch.minimum(t, gdm.boundary(place, w))
        found = gdm.evaluate(place, w)
        errors.append(float((found.distance - truth)[~inside].abs().mean()))
    assert errors[2] < errors[1] < errors[0]
    assert errors[2] < 0.5 * errors[0]


def test_matter_is_that_of_the_nearest_surface():
    gdm = bake_gdm.in_memory(box([[-0.5, -0.5, -0.4]], [[1.5, 1.5, -0.2]], 0.4), FINE)
    found = gdm.matter_at(torch.tensor([[0.3, 0.4, -0.19], [0.7, 0.1, -0.05]]))
    torch.testing.assert_close(found.normal, torch.tensor([[0.0, 0.0, 1.0]]).expand(2, 3), rtol=0, atol=1e-5)
    torch.testing.assert_close(found.albedo[0], torch.tensor([0.2, 0.4, 0.6]), rtol=0, atol=1e-5)
    torch.testing.assert_close(found.alpha, torch.full((2,), 0.3), rtol=0, atol=1e-5)


def test_supersampling_gives_shares():
    meso = generators.spheres()
    plain = bake_gdm.in_memory(meso, SMALL).occupancy
    assert set(plain.unique().tolist()) == {0.0, 1.0}
    shares = bake_gdm.in_memory(meso, GdmOptions(texels=12, layers=7, n_theta=6, n_phi=8, supersample=3)).occupancy
    assert len(shares.unique()) > 10
    assert abs(float(shares.mean() - plain.mean())) < 0.05


def test_cut_off_bake_goes_on_with_the_same_bits(tmp_path):
    meso = generators.brick()
    whole, resumed = tmp_path / "whole.gdm.zarr", tmp_path / "resumed.gdm.zarr"
    bake_gdm.bake(meso, SMALL, whole, about={"source": "test"})

    def stop_early(share):
        if share > 0.4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        bake_gdm.bake(meso, SMALL, resumed, about={"source": "test"}, progress=stop_early)
    assert not resumed.exists()
    bake_gdm.bake(meso, SMALL, resumed, about={"source": "test"})
    a, b, c = gdm_data.load(whole), gdm_data.load(resumed), bake_gdm.in_memory(meso, SMALL)
    for name in ("distance", "left", "occupancy", "matter"):
        assert torch.equal(getattr(a, name), getattr(b, name))
        assert torch.equal(getattr(a, name), getattr(c, name))


@pytest.mark.errors
def test_absurd_sizes_are_refused():
    with pytest.raises(SizeError, match=r"bake\.gdm: needs .* GiB of memory, the limit is 8\.0 GiB; lower"):
        GdmOptions(texels=512, layers=64)
    for wrong in ({"texels": 0}, {"layers": 1}, {"cap": 0.0}, {"supersample": 0}):
        with pytest.raises(ConfigError, match=f"bake\\.gdm\\.{next(iter(wrong))}"):
            GdmOptions(**wrong)
    assert math.isfinite(GdmOptions().cap)
