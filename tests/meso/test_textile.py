"""Yarns against elliptic cylinders, and tiles against themselves moved."""

import math
import random
import re

import pytest
import torch

from tests.data import tg3
from tests.meso.looks import looks, wrong
from torchmeso.data import texgen
from torchmeso.errors import ConfigError, GeometryError, MesoError, SizeError
from torchmeso.meso import bake_gdm, solid, textile
from torchmeso.meso.bake_gdm import GdmOptions, RayCastGdm
from torchmeso.meso.bake_mdf import RayCastMdf

A, B = 0.2, 0.1


def build(tmp_path, content, **dials):
    (tmp_path / "a.tg3").write_bytes(content)
    found = texgen.read(tmp_path / "a.tg3")
    coats = [((k / max(len(found.yarns) - 1, 1), 0.5, 0.5), 0.3, 0.04) for k in range(len(found.yarns))]
    return textile.from_textile(found, coats, **dials)


def cylinder(tmp_path, axis=0, **dials):
    """A straight yarn in a tile of side 3, in tile units with half axes A and B."""
    section = tg3.section({"type": "CSectionEllipse", "Width": 6 * A, "Height": 6 * B})
    content = tg3.textile([tg3.straight(axis, period=3.0, z=7.0, sections=tg3.constant(section))])
    return build(tmp_path, content, **dials)


def plain_weave(low=(0.0, 0.0), height=0.2):
    """Two yarns each way over a tile of side 2, half of it as repeats; `low` is the corner that is shown."""
    section = tg3.constant(tg3.section({"type": "CSectionEllipse", "Width": 0.6, "Height": height}))
    repeats = [(1, 1, 0), (1, -1, 0)]
    over, under = [(0, 0.5, 0.2), (1, 0.5, -0.2), (2, 0.5, 0.2)], [(0.0, 0.5, -0.2), (0, 1.5, 0.2), (0, 2.5, -0.2)]
    along = tg3.yarn(over, sections=section, repeats=repeats)
    across = tg3.yarn(under, sections=section, repeats=repeats)
    return tg3.textile([along, across], (low, (low[0] + 2, low[1] + 2)))


def distance_to_cylinder(uv, wo):
    """From the reference plane along -wo to the cylinder along u through v = 0.5 and its copies."""
    best = torch.full((len(uv),), torch.inf, dtype=torch.float64)
    for k in range(-6, 7):
        y, z = uv[:, 1] % 1 - 0.5 - k, torch.full_like(uv[:, 1], B)
        dy, dz = -wo[:, 1] / A, -wo[:, 2] / B
        a, b, c = dy**2 + dz**2, y / A * dy + z / B * dz, (y / A) ** 2 + (z / B) ** 2 - 1
        disc = b**2 - a * c
        t = (-b - disc.clamp(min=0).sqrt()) / a
        best = torch.where((disc > 0) & (t >= 0), torch.minimum(best, t), best)
    return best


def test_a_straight_yarn_is_an_elliptic_cylinder(tmp_path, rng):
    meso = cylinder(tmp_path, segments=256)
    assert meso.h == pytest.approx(2 * B, rel=1e-5)
    uv, wo = looks(rng, 70)
    expected = distance_to_cylinder(uv, wo)
    assert wrong(RayCastMdf(meso).evaluate(uv, wo), expected, 1e-3) < 1e-2  # rays that graze it
    place = torch.rand(4000, 3, generator=rng) * torch.tensor([1.0, 1.0, -meso.h])
    truth = ((place[:, 1] - 0.5) / A) ** 2 + ((place[:, 2] + B) / B) ** 2
    found = RayCastGdm(meso, 0.5).inside(place)
    sure = (truth - 1).abs() > 1e-2
    assert torch.equal(found[sure], (truth < 1)[sure])


@pytest.mark.parametrize("axis", [0, 1])
def test_the_share_of_solid_is_that_of_the_section(tmp_path, axis):
    meso = cylinder(tmp_path, axis, segments=64)
    gdm = bake_gdm.in_memory(meso, GdmOptions(texels=24, layers=33, n_theta=2, n_phi=3, supersample=2))
    share = gdm.occupancy.mean((1, 2))
    share = float((share[1:] + share[:-1]).mean() / 2)  # trapezoids: the outer layers are half voxels
    assert share == pytest.approx(math.pi * A * B / (2 * B), rel=2e-2)


def test_sections_that_change_fill_their_mean_area(tmp_path, rng):
    sizes = [tg3.section({"type": "CSectionEllipse", "Width": w, "Height": 0.4}) for w in (0.4, 0.8)]
    sections = tg3.several("CYarnSectionInterpPosition", sizes, [0.0, 0.5], Ramped=1)
    meso = build(tmp_path, tg3.textile([tg3.straight(sections=sections)]), segments=64)
    place = torch.rand(20000, 3, generator=rng) * torch.tensor([1.0, 1.0, -meso.h])
    half = 0.2 + 0.2 * (1 - (2 * place[:, 0] - 1).abs())
    truth = ((place[:, 1] - 0.5) / half) ** 2 + ((place[:, 2] + 0.2) / 0.2) ** 2
    found, sure = RayCastGdm(meso, 0.5).inside(place), (truth - 1).abs() > 2e-2
    assert torch.equal(found[sure], (truth < 1)[sure])
    assert float(found.float().mean()) == pytest.approx(math.pi / 4 * 0.6 * 0.4 / 0.4, abs=0.015)


def test_a_yarn_wider_than_the_tile_overlaps_its_copies(tmp_path, rng):
    section = tg3.section({"type": "CSectionEllipse", "Width": 1.6, "Height": 0.4})
    meso = build(tmp_path, tg3.textile([tg3.straight(sections=tg3.constant(section))]), segments=128)
    place = torch.rand(4000, 3, generator=rng) * torch.tensor([1.0, 1.0, -meso.h])
    truth, sure = torch.zeros(4000, dtype=torch.bool), torch.ones(4000, dtype=torch.bool)
    for k in (-1, 0, 1):
        gap = ((place[:, 1] - 0.5 - k) / 0.8) ** 2 + ((place[:, 2] + 0.2) / 0.2) ** 2
        truth |= gap < 1
        sure &= (gap - 1).abs() > 2e-2
    assert torch.equal(RayCastGdm(meso, 0.5).inside(place)[sure], truth[sure])


def test_moving_the_domain_moves_the_tile(tmp_path, rng):
    """Distances do not know where the border lies, nor do the insides."""
    uv, wo = looks(rng, 75)
    here, there = build(tmp_path, plain_weave()), build(tmp_path, plain_weave((0.74, -1.1)))
    offset = torch.tensor([0.37, -0.55], dtype=torch.float64)
    a, b = RayCastMdf(here).evaluate(uv, wo), RayCastMdf(there).evaluate(uv - offset, wo)
    assert wrong(a, b, 1e-4) < 2e-3
    assert a.isinf().any()
    place = torch.rand(4000, 3, generator=rng) * torch.tensor([1.0, 1.0, -here.h])
    moved = place - torch.cat([offset, offset.new_zeros(1)]).float()
    one, other = RayCastGdm(here, 1.0).inside(place), RayCastGdm(there, 1.0).inside(moved)
    assert (one != other).float().mean() < 2e-3
    assert 0.2 < one.float().mean() < 0.6


def test_a_yarn_far_from_its_domain_comes_home(tmp_path):
    """Places a thousand tiles away keep their precision, and the tile is the same."""
    section = tg3.constant(tg3.section({"type": "CSectionEllipse", "Width": 0.5, "Height": 0.25}))
    near = [(0, 0.5, 0), (0.5, 0.5, 0.25), (1, 0.5, 0)]
    far = [(x + 4096, y - 4096, z) for x, y, z in near]
    repeats = [(1, 0, 0), (0, 1, 0)]
    here, there = (
        build(tmp_path, tg3.textile([tg3.yarn(nodes, sections=section, repeats=repeats)], ((0, 0), (1, 1))))
        for nodes in (near, far)
    )
    torch.testing.assert_close(here.geometry.vertices, there.geometry.vertices, rtol=0, atol=2e-6)


def test_the_border_is_crossed_without_a_crack(tmp_path):
    meso = build(tmp_path, plain_weave())
    found = solid.bodies(meso.geometry, meso.h)
    assert (found >= 0).all()
    assert len(found.unique()) == 4  # two yarns and their two copies
    rows = torch.rand(500, dtype=torch.float64)
    wo = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(500, 3)
    caster = RayCastMdf(meso)
    for flip in (False, True):
        left = torch.stack([torch.full((500,), 1e-7).double(), rows], -1)
        right = torch.stack([torch.full((500,), 1 - 1e-7).double(), rows], -1)
        if flip:
            left, right = left.flip(1), right.flip(1)
        assert wrong(caster.evaluate(left, wo), caster.evaluate(right, wo), 1e-5) == 0


def test_over_and_under(tmp_path):
    """Straight down on the crossings: the yarn that a node lifts is met first."""
    meso = build(tmp_path, plain_weave(), backing=False)
    wo = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(4, 3)
    uv = torch.tensor([[0.0, 0.25], [0.5, 0.25], [0.0, 0.75], [0.5, 0.75]], dtype=torch.float64)
    place = torch.cat([uv, torch.zeros(4, 1)], -1).float()
    caster = RayCastGdm(meso, 1.0)
    t, face = caster.cast(place, -wo.float(), torch.zeros(4, dtype=torch.bool))
    assert t.max() < 1e-3
    red = caster.matter(place, -wo.float(), t, face)[:, 3]
    assert red.tolist() == [0.0, 1.0, 1.0, 0.0]


def test_a_yarn_that_ends_is_closed(tmp_path, rng):
    section = tg3.constant(tg3.section({"type": "CSectionRectangle", "Width": 0.4, "Height": 0.2}))
    stub = tg3.yarn([(0.2, 0.5, 0), (0.7, 0.5, 0)], periodic=0, sections=section)
    meso = build(tmp_path, tg3.textile([stub], ((0, 0), (1, 1))))
    assert (solid.bodies(meso.geometry, meso.h) >= 0).all()
    place = torch.rand(3000, 3, generator=rng) * torch.tensor([1.0, 1.0, -meso.h])
    truth = (place[:, 0] > 0.2) & (place[:, 0] < 0.7) & ((place[:, 1] - 0.5).abs() < 0.2)
    edge = ((place[:, 0] - 0.45).abs() - 0.25).abs() < 1e-3
    edge |= ((place[:, 1] - 0.5).abs() - 0.2).abs() < 1e-3
    edge |= ((place[:, 2] + 0.1).abs() - 0.1).abs() < 1e-3
    assert torch.equal(RayCastGdm(meso, 0.5).inside(place)[~edge], truth[~edge])


def test_warp_and_weft_have_their_coats(tmp_path):
    (tmp_path / "a.tg3").write_bytes(plain_weave())
    path = str(tmp_path / "a.tg3")
    warp, weft = (0.9, 0.8, 0.7), (0.1, 0.2, 0.3)
    found = textile.from_tg3(path=path, colour=warp, weft_colour=weft, roughness=0.2, weft_roughness=0.6, backing=True)
    palette = found.geometry.palette
    torch.testing.assert_close(palette.albedo, torch.tensor([weft, warp, (0.03, 0.03, 0.03)]))
    torch.testing.assert_close(palette.alpha, torch.tensor([0.6, 0.2, 1.0]))
    assert set(found.geometry.part.tolist()) == {0, 1, 2}
    own = textile.from_tg3(path=path, colours=[warp, warp])
    torch.testing.assert_close(own.geometry.palette.albedo[:2], torch.tensor([warp, warp]))


def test_dials_bring_it_nearer(tmp_path):
    sizes = [len(build(tmp_path, plain_weave(), along=n, segments=n).geometry.faces) for n in (8, 16)]
    assert 3.5 < sizes[1] / sizes[0] < 4.1


def test_unlike_sides_are_told(tmp_path):
    yarn = tg3.yarn([(0, 0.5, 0), (1, 0.5, 0)], repeats=[(1, 0, 0), (0, 1.02, 0)])
    with pytest.warns(UserWarning, match=r"sides of the tile are 1 and 1\.02; x and y are scaled apart by 1\.02"):
        meso = build(tmp_path, tg3.textile([yarn]))
    assert meso.h == pytest.approx(0.1 / 1.02**0.5, rel=1e-4)


def test_real_weaves(data_dir, rng):
    meso = textile.from_tg3(path=str(data_dir / "volume" / "polyester.tg3"))
    assert meso.h == pytest.approx(0.09 / 0.44, rel=1e-4)
    found = solid.bodies(meso.geometry, meso.h)
    assert len(found.unique()) == 4
    assert (found >= 0).all()
    place = torch.rand(20000, 3, generator=rng) * torch.tensor([1.0, 1.0, -meso.h])
    share = float(RayCastGdm(meso, 0.5).inside(place).float().mean())
    bent = 0.44 * (1 + (math.pi * 0.025 / 0.22) ** 2 / 4)  # length of a sine of that height
    assert share == pytest.approx(4 * math.pi * 0.09 * 0.02 * bent / (0.44**2 * 0.09), abs=0.015)
    built = textile.from_tg3(path=str(data_dir / "volume" / "2dweave.tg3"))
    assert built.h == pytest.approx(2 / 20, rel=1e-4)
    assert len(solid.bodies(built.geometry, built.h).unique()) == 8


@pytest.mark.errors
@pytest.mark.filterwarnings("ignore:textile. the sides")
def test_damaged_numbers_give_only_our_errors(tmp_path):
    chance = random.Random(1)
    numbers = ["0", "-0.5", "1e-300", "1e6", "1e-7", "3.7", "0.1", "2", "-1"]
    whole, refused = plain_weave().decode(), 0
    places = [m.span() for m in re.finditer(r"-?[0-9]+\.[0-9]+", whole)]
    for _ in range(100):
        content = whole
        for start, end in sorted(chance.sample(places[1:], chance.choice((1, 1, 2))), reverse=True):
            content = content[:start] + chance.choice(numbers) + content[end:]
        try:
            build(tmp_path, content.encode(), along=4, segments=4)
        except MesoError as error:
            refused += 1
            assert "\n" not in str(error)
    assert 15 < refused < 100


@pytest.mark.errors
def test_what_is_no_tile_is_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"textile\.colours: expected a value from 2 to 2, got 1"):
        (tmp_path / "a.tg3").write_bytes(plain_weave())
        textile.from_tg3(path=str(tmp_path / "a.tg3"), colours=[(1.0, 1.0, 1.0)])
    with pytest.raises(ConfigError, match=r"textile\.segments: expected a value from 3"):
        build(tmp_path, plain_weave(), segments=2)
    with pytest.raises(ConfigError, match=r"textile\.along: expected a value from 2"):
        build(tmp_path, plain_weave(), along=1)
    with pytest.raises(SizeError, match=r"textile: needs .*lower along or segments"):
        build(tmp_path, plain_weave(), along=4096, segments=4096)
    long = tg3.yarn([(0, 0.5, 0), (40.5, 0.5, 0)], periodic=0)
    with pytest.raises(GeometryError, match="yarns that reach over at most 32 tiles, got a longer one"):
        build(tmp_path, tg3.textile([long], ((0, 0), (1, 1))), along=4)
    with pytest.raises(ConfigError, match=r"textile\.h: expected a value from 0\.3 to 10, got 0\.1"):
        build(tmp_path, plain_weave(), h=0.1)
