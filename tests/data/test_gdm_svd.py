from dataclasses import replace

import pytest
import torch

from tests.data.test_gdm import GRID, layered
from torchmeso.compress import gdm_svd as fits
from torchmeso.compress.gdm_svd import GdmSvdOptions
from torchmeso.data import gdm_coded, gdm_svd
from torchmeso.errors import FormatError, ShapeError
from torchmeso.geometry.directions import normalize


@pytest.fixture(scope="module")
def factored():
    return fits.fit(layered(-0.27), GdmSvdOptions(rank=5))


def test_a_query_reads_the_product_at_its_samples(factored):
    """By hand: at a voxel and in a direction of the grid, offset + scale * code times the eigen-map."""
    row, column, texel, layer = 4, 2, (3, 1), 6
    weight = factored.offset.double() + factored.scale.double() * factored.weights[texel[0], texel[1], column]
    expected = (weight * factored.maps[:, row, layer].double()).sum()
    place = torch.tensor([(texel[1] + 0.5) / 5, 1 - (texel[0] + 0.5) / 5, -0.4 + 0.4 * layer / 8], dtype=torch.float64)
    w = GRID.directions(torch.float64)[row - 1, column]
    found = factored.evaluate(place[None], w[None])
    assert not found.left.any()
    torch.testing.assert_close(found.distance[0], expected, rtol=1e-6, atol=1e-7)


def test_it_evaluates_as_the_table_it_stands_for(factored, rng):
    place = 3 * torch.rand(4000, 3, generator=rng, dtype=torch.float64) - 1
    place[:, 2] = -0.4 * torch.rand(4000, generator=rng, dtype=torch.float64)
    w = normalize(torch.randn(4000, 3, generator=rng, dtype=torch.float64))
    between = w[:, 2].abs() < 0.92  # outside of the poles, whose means are of codes there and of sums here
    whole, parts = factored.expanded().evaluate(place, w), factored.evaluate(place, w)
    assert torch.equal(whole.left, parts.left)
    assert (whole.distance - parts.distance).abs()[between].max() <= 0.52 * factored.cap / 255


def test_the_table_it_stands_for_keeps_bits_and_material(factored):
    table, whole = layered(-0.27), factored.expanded()
    assert torch.equal(whole.left, table.left)
    assert torch.equal(whole.occupancy, table.occupancy)
    assert torch.equal(whole.matter, table.matter)
    assert (whole.voxels, whole.directions, factored.rank) == (table.voxels, table.directions, 5)
    assert factored.held_bytes == 5 * 5 * 8 * 5 + 4 * (5 * 8 * 9 + 10)


def test_bits_are_those_of_the_azimuths(rng):
    bits = torch.rand(3, 11, generator=rng) > 0.5
    assert torch.equal(gdm_svd.unpacked_bits(gdm_svd.packed_bits(bits), 11), bits)


def test_a_file_holds_all_of_it_and_its_first_components_alone(factored, tmp_path):
    gdm_svd.save(factored, tmp_path / "a.gdm.meso")
    again, less = (gdm_svd.load(tmp_path / "a.gdm.meso", rank=rank) for rank in (None, 2))
    for name in ("weights", "scale", "offset", "maps", "left", "occupancy"):
        assert torch.equal(getattr(again, name), getattr(factored, name))
    torch.testing.assert_close(again.matter, factored.matter, rtol=1e-3, atol=0)
    assert (again.h, again.cap, less.rank) == (factored.h, factored.cap, 2)
    assert torch.equal(less.weights, factored.weights[..., :2])


@pytest.mark.errors
def test_files_that_hold_no_factored_gdm_are_refused(factored, tmp_path):
    gdm_coded.save(layered(-0.2), tmp_path / "a.gdm.meso")
    with pytest.raises(FormatError, match="expected a factored GDM, found"):
        gdm_svd.load(tmp_path / "a.gdm.meso")
    gdm_svd.save(factored, tmp_path / "b.gdm.meso")
    with pytest.raises(FormatError, match="expected at least one component, got 0"):
        gdm_svd.load(tmp_path / "b.gdm.meso", rank=0)


@pytest.mark.errors
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"scale": torch.ones(4)}, r"gdm\.scale: expected shape"),
        ({"offset": torch.full((5,), torch.nan)}, r"gdm\.offset: expected finite"),
        ({"left": torch.zeros(9, 5, 5, 8, 2, dtype=torch.uint8)}, r"gdm\.left: expected shape"),
        ({"weights": torch.zeros(0, 5, 8, 5, dtype=torch.uint8)}, "at least one component of two layers of one voxel"),
    ],
)
def test_parts_that_do_not_match_are_refused(factored, change, message):
    with pytest.raises(ShapeError, match=message):
        replace(factored, **change)
