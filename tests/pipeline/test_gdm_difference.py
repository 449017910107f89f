from dataclasses import replace

import pytest
import torch

from tests.data.test_gdm import layered
from torchmeso.compress import gdm_svd as fits
from torchmeso.compress.gdm_svd import GdmSvdOptions
from torchmeso.data import gdm, gdm_coded, gdm_svd
from torchmeso.errors import ShapeError
from torchmeso.pipeline import gdm_difference
from torchmeso.pipeline.bake import open_gdm


@pytest.fixture
def table(tmp_path):
    exact = layered(-0.27)
    codes = replace(exact, distance=gdm_coded.codes_of(exact))
    gdm.save(codes, tmp_path / "a.gdm.zarr")
    return codes


def test_a_table_does_not_differ_from_its_exact_code(table, tmp_path):
    gdm_coded.save(table, tmp_path / "a.gdm.meso")
    found = gdm_difference.compare(tmp_path / "a.gdm.zarr", tmp_path / "a.gdm.meso")
    assert (found.wrong, found.rms, found.p95, found.max_error) == (0, 0, 0, 0)


def test_differences_are_counted_in_voxels(table, tmp_path):
    left = table.left.clone()
    left[0, 0, 0, 0, 0] ^= True
    hits = ~left & ~(table.occupancy > 0.5)[..., None, None]
    farther = torch.where(hits, table.distance.clamp(max=250) + 2, table.distance)
    changed = replace(table, distance=torch.where(hits, farther, table.distance), left=left)
    gdm.save(changed, tmp_path / "b.gdm.zarr")
    found = gdm_difference.compare(tmp_path / "a.gdm.zarr", tmp_path / "b.gdm.zarr")
    assert found.wrong == pytest.approx(1 / left.numel())
    assert found.p95 == pytest.approx(2 * table.cap / 255 / table.voxel)


def test_models_open_as_the_tables_they_stand_for(table, tmp_path):
    factored = fits.fit(table, GdmSvdOptions(rank=3))
    gdm_svd.save(factored, tmp_path / "a.gdm.meso")
    opened = open_gdm(tmp_path / "a.gdm.meso")
    assert torch.equal(opened.distance, factored.expanded().distance)
    assert open_gdm(tmp_path / "a.gdm.meso", rank=1).distance.shape == table.distance.shape
    assert torch.equal(open_gdm(tmp_path / "a.gdm.zarr").distance, table.distance)


@pytest.mark.errors
def test_tables_of_other_sizes_are_refused(table, tmp_path):
    gdm.save(layered(-0.27, texels=4), tmp_path / "b.gdm.zarr")
    with pytest.raises(ShapeError, match=r"b\.gdm\.zarr: expected \(9, 5, 5, 6, 8\), h 0\.4, cap 2 as in"):
        gdm_difference.compare(tmp_path / "a.gdm.zarr", tmp_path / "b.gdm.zarr")
