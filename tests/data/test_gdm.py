from dataclasses import replace

import pytest
import torch

from tests.tolerances import FLOAT64
from torchmeso.data import gdm as gdm_module
from torchmeso.data import gdm_query
from torchmeso.data.gdm import Gdm
from torchmeso.errors import ConfigError, FormatError, ShapeError
from torchmeso.geometry.directions import normalize
from torchmeso.geometry.sphere import SphereGrid
from torchmeso.meso import bake_gdm, generators
from torchmeso.meso.bake_gdm import GdmOptions, RayCastGdm

GRID = SphereGrid(n_theta=6, n_phi=8)
H = 0.4


def layered(level, *, texels=5, layers=9, cap=2.0, dtype=torch.float64):
    """A half-space of material below z = level: every distance is known."""
    z = (-H + H * torch.arange(layers, dtype=torch.float64) / (layers - 1))[:, None, None, None, None]
    climb = GRID.directions(torch.float64)[..., 2]
    way = (level - z) / climb
    shape = (layers, texels, texels, 6, 8)
    solid = (z < level).expand(layers, texels, texels, 1, 1)[..., 0, 0]
    left = ((climb > 0) | (way > cap)).expand(shape) & ~solid[..., None, None]
    distance = torch.where(left | solid[..., None, None], 0, way.clamp(0).expand(shape))
    matter = torch.zeros(layers, texels, texels, 10)
    matter[..., 2] = 1
    matter[..., 3:7] = 0.5
    return Gdm(
        distance=distance.to(dtype), left=left, occupancy=solid.float(), matter=matter, h=H, cap=cap,
    )  # fmt: skip


def points(n, rng):
    place = 3 * torch.rand(n, 3, generator=rng, dtype=torch.float64) - 1
    place[:, 2] = -H * torch.rand(n, generator=rng, dtype=torch.float64)
    return place, GRID.directions(torch.float64).reshape(-1, 3)[torch.randint(48, (n,), generator=rng)]


def test_exact_before_a_plane_between_the_layers(rng):
    """The corners inside solid say nothing, and the others carry their distance to the point."""
    level = -0.27
    gdm = layered(level)
    place, w = points(5000, rng)
    found = gdm.evaluate(place, w)
    step = H / 8
    outside = place[:, 2] > level + step / 2
    down = outside & (w[:, 2] < 0) & ((level - place[:, 2]) / w[:, 2] < gdm.cap - 0.5)
    torch.testing.assert_close(found.distance[down], ((level - place[:, 2]) / w[:, 2])[down], **FLOAT64)
    assert not found.left[down].any()
    up = outside & (w[:, 2] > 0)
    assert found.left[up].all()
    torch.testing.assert_close(found.distance[up], (-place[:, 2] / w[:, 2]).clamp(max=gdm.cap)[up], **FLOAT64)
    inside = place[:, 2] < level - step
    assert (found.distance[inside] == 0).all()
    assert not found.left[inside].any()


def test_repeats_in_u_and_v_and_holds_in_z(rng):
    gdm = layered(-0.2)
    place, w = points(200, rng)
    for shift in ((1.0, 0.0, 0.0), (-3.0, 7.0, 0.0)):
        moved = gdm.evaluate(place + torch.tensor(shift, dtype=torch.float64), w)
        torch.testing.assert_close(moved.distance, gdm.evaluate(place, w).distance, rtol=0, atol=1e-9)
    above = place.clone()
    above[:, 2] = 0.3
    on_top = place.clone()
    on_top[:, 2] = 0
    torch.testing.assert_close(gdm.evaluate(above, w).distance, gdm.evaluate(on_top, w).distance, **FLOAT64)


def test_a_ray_that_never_climbs_ends_at_the_cap(rng):
    gdm = layered(-0.2)
    place, _ = points(50, rng)
    level = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64).expand(50, 3)
    assert (gdm.boundary(place, level) == gdm.cap).all()
    assert torch.isfinite(gdm.evaluate(place, level).distance).all()


def test_bytes_are_as_good_as_their_step(rng):
    exact = layered(-0.27)
    codes = (exact.distance * (255 / exact.cap)).round().clamp(0, 255).to(torch.uint8)
    coarse = Gdm(distance=codes, left=exact.left, occupancy=exact.occupancy, matter=exact.matter, h=H, cap=exact.cap)
    place = points(3000, rng)[0]
    w = normalize(torch.randn(3000, 3, generator=rng, dtype=torch.float64))
    a, b = exact.evaluate(place, w), coarse.evaluate(place, w)
    assert torch.equal(a.left, b.left)
    assert (a.distance - b.distance).abs().max() <= 0.51 * exact.cap / 255 + 1e-9


def test_the_safe_way_ends_before_a_plane(rng):
    """However steep its neighbours are; and where it is short, that is by the size of a cell."""
    level = -0.27
    gdm = layered(level)
    place, w = points(4000, rng)
    outside = place[:, 2] > level
    safe = gdm_query.safe_way(gdm, place, w)
    truth = torch.where(w[:, 2] < 0, (level - place[:, 2]) / w[:, 2], torch.inf)
    assert (safe[outside] <= truth[outside] + 1e-9).all()
    assert (safe >= 0).all()
    near = outside & (truth < gdm.cap / 4)
    assert (truth - safe)[near].mean() < 0.5 * gdm.voxel


def test_rays_asked_again_end_closer_to_the_material(rng):
    meso = generators.pipes()
    gdm = bake_gdm.in_memory(meso, GdmOptions(texels=16, layers=8, n_theta=8, n_phi=12))
    rays = RayCastGdm(meso, gdm.cap)
    place = torch.rand(3000, 3, generator=rng)
    place[:, 2] *= -gdm.h
    place = place[~rays.inside(place)]
    w = normalize(torch.randn(len(place), 3, generator=rng))
    t, _ = rays.cast(place, w, torch.zeros(len(place), dtype=torch.bool))
    meets = t < gdm.boundary(place, w)
    found = [gdm_query.approach(gdm, place.double(), w.double(), queries=n) for n in (1, 2, 16)]
    once = gdm.evaluate(place.double(), w.double())
    assert all(torch.equal(a, b) for a, b in zip(found[0], once, strict=True))
    off = [float((x.distance - t).abs()[meets & ~x.left].quantile(0.9)) for x in found]
    assert off[2] < off[1] < off[0]


def test_rays_that_meet_nothing_go_to_the_end(rng):
    gdm = layered(-5.0)  # farther below than the longest distance
    place, w = points(200, rng)
    found = gdm_query.approach(gdm, place, w, queries=8)
    assert found.left.all()
    torch.testing.assert_close(found.distance, gdm.boundary(place, w), **FLOAT64)


def test_gradient_moves_the_hit_with_the_point(rng):
    gdm = layered(-0.27)
    place, _ = points(100, rng)
    place[:, 2] = -0.1
    w = GRID.directions(torch.float64)[4, 2].expand(100, 3)
    place.requires_grad_(True)
    gdm.evaluate(place, w).distance.sum().backward()
    expected = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64) / -w[:, 2:]
    torch.testing.assert_close(place.grad, expected.expand(100, 3), rtol=0, atol=1e-9)


def test_matter_is_that_of_the_corners_that_have_some(rng):
    gdm = layered(-0.2)
    gdm.matter[4:] = 0  # nothing is near the upper layers
    place, _ = points(300, rng)
    found = gdm.matter_at(place)
    torch.testing.assert_close(found.normal.norm(dim=-1), torch.ones(300, dtype=torch.float64), **FLOAT64)
    near = place[:, 2] < -H + 3.5 * H / 8
    torch.testing.assert_close(
        found.albedo[near], torch.full((int(near.sum()), 3), 0.5, dtype=torch.float64), **FLOAT64
    )
    assert (found.alpha >= 0.02).all()


def test_a_file_holds_all_of_it(tmp_path):
    gdm = layered(-0.2, dtype=torch.float32)
    gdm_module.save(gdm, tmp_path / "a.gdm.zarr")
    again = gdm_module.load(tmp_path / "a.gdm.zarr")
    for name in ("distance", "left", "occupancy", "matter"):
        assert torch.equal(getattr(gdm, name), getattr(again, name))
    assert (again.h, again.cap, again.voxels, again.directions) == (H, 2.0, (9, 5, 5), GRID)
    with pytest.raises(FormatError, match="expected a gdm table, found none"):
        gdm_module.load(tmp_path / "b.gdm.zarr")


@pytest.mark.errors
@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"left": torch.zeros(2, 2, dtype=torch.bool)}, ShapeError, r"gdm\.left: expected shape"),
        ({"distance": torch.zeros(9, 5, 5, 6, 8, dtype=torch.int64)}, ShapeError, "expected uint8, float16"),
        ({"occupancy": torch.full((9, 5, 5), 2.0)}, ShapeError, r"gdm\.occupancy: expected finite values from 0 to 1"),
        ({"matter": torch.full((9, 5, 5, 10), torch.nan)}, ShapeError, r"gdm\.matter: expected finite values, got nan"),
        ({"distance": torch.full((9, 5, 5, 6, 8), torch.inf)}, ShapeError, r"gdm\.distance: expected finite values"),
        ({"distance": torch.full((9, 5, 5, 6, 8), -0.1)}, ShapeError, r"gdm\.distance: expected finite values from 0"),
        ({"h": 0.0}, ConfigError, r"gdm\.h"),
        ({"cap": -1.0}, ConfigError, r"gdm\.cap"),
    ],
)
def test_parts_that_do_not_match_are_refused(change, error, message):
    gdm = layered(-0.2)
    parts = {n: getattr(gdm, n) for n in ("distance", "left", "occupancy", "matter", "h", "cap")}
    with pytest.raises(error, match=message):
        Gdm(**{**parts, **change})


@pytest.mark.errors
def test_one_layer_is_refused():
    with pytest.raises(ShapeError, match="at least two layers"):
        Gdm(
            distance=torch.zeros(1, 4, 4, 6, 8), left=torch.zeros(1, 4, 4, 6, 8, dtype=torch.bool),
            occupancy=torch.zeros(1, 4, 4), matter=torch.zeros(1, 4, 4, 10), h=0.1, cap=1.0,
        )  # fmt: skip


def test_material_that_turns_away_does_not_count():
    """A sheet thinner than a voxel: the corners know its two sides, and only the one towards the viewer is seen."""
    gdm = layered(-0.2)
    matter = torch.zeros(*gdm.voxels, 10)
    matter[..., 2], matter[..., 3:6], matter[..., 6] = 1, torch.tensor([0.2, 0.4, 0.6]), 0.3
    matter[:, :, ::2, 2], matter[:, :, ::2, 3] = -1, 0.8
    gdm = replace(gdm, matter=matter)
    place = torch.tensor([[1 / gdm.voxels[2], 0.5, -0.1]]).repeat(3, 1)  # between two columns
    wo = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.6, -0.8], [1.0, 0.0, 0.0]])
    found = gdm.matter_at(place, wo)
    torch.testing.assert_close(found.normal[:2], torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]))
    torch.testing.assert_close(found.albedo[:2, 0], torch.tensor([0.2, 0.8]))
    # Seen from the side no corner turns to the viewer: what is known of the material, and a normal that points up.
    torch.testing.assert_close(found.normal[2], torch.tensor([0.0, 0.0, 1.0]))
    assert 0.2 < float(found.albedo[2, 0]) < 0.8
