from dataclasses import replace

import pytest
import torch

from tests.data.test_gdm import layered
from torchmeso.compress import gdm_svd
from torchmeso.compress.gdm_svd import GdmSvdOptions
from torchmeso.errors import ConfigError
from torchmeso.meso import bake_gdm, generators
from torchmeso.meso.bake_gdm import GdmOptions


@pytest.fixture(scope="module")
def weave():
    return bake_gdm.in_memory(generators.weave(), GdmOptions(texels=10, layers=5, n_theta=6, n_phi=8))


def hits_of(table):
    return ~table.left & ~(table.occupancy > 0.5)[..., None, None]


def rms(table, factored):
    off = (factored.expanded().distance.double() - table.distance.double())[hits_of(table)]
    return float(off.square().mean().sqrt())


def test_the_matrix_has_the_order_of_the_paper():
    """Rows (y, x, phi), columns (direction row, layer); what leaves is the way to the boundary."""
    table = layered(-0.27)
    A, hits = gdm_svd.matrix(table)
    assert A.shape == (5 * 5 * 8, 8 * 9)
    row, column = (2 * 5 + 3) * 8 + 5, 4 * 9 + 6
    torch.testing.assert_close(A[row, column].double(), table.distance[6, 2, 3, 3, 5], rtol=1e-6, atol=1e-7)
    assert hits[row, column] == hits_of(table)[6, 2, 3, 3, 5]
    up, layer = 0, 7
    assert not hits[row, up * 9 + layer]
    torch.testing.assert_close(A[row, up * 9 + layer], torch.tensor(0.05), rtol=1e-5, atol=1e-6)
    assert (A[row, :1] == 0).all()  # inside of material


def test_all_components_of_the_boundary_matrix_are_the_table(weave):
    """What is left is the rounding of weights to bytes, of the longest distance times the root of the rank."""
    table = gdm_svd.fit(weave, GdmSvdOptions(rank=40, fill="boundary"))
    assert rms(weave, table) <= 1.0


def test_the_boundary_fit_is_the_singular_value_decomposition(weave):
    """Float64 SVD of the same matrix: no model of the rank has a smaller squared error."""
    A, _ = gdm_svd.matrix(weave)
    s = torch.linalg.svdvals(A.double())
    least = float(s[6:].square().sum().sqrt())
    found = gdm_svd.fit(weave, GdmSvdOptions(rank=6, fill="boundary"))
    weight = found.offset + found.scale * found.weights.float()
    product = torch.einsum("hwpr,rtz->hwptz", weight, found.maps).reshape(A.shape)
    assert least <= float((product - A).double().norm()) <= 1.02 * least


@pytest.mark.parametrize("rank", [2, 4, 8])
def test_hits_alone_are_fitted_better_than_with_what_leaves(weave, rank):
    alone, filled = (rms(weave, gdm_svd.fit(weave, GdmSvdOptions(rank=rank, fill=f))) for f in ("hits", "boundary"))
    assert alone < 0.9 * filled


def test_a_budget_is_kept_and_not_wasted(weave):
    found = gdm_svd.fit_to(weave, size=4000)
    assert gdm_svd.stored_bytes(found) <= 4000
    assert gdm_svd.stored_bytes(gdm_svd.fit(weave, GdmSvdOptions(rank=found.rank + 1))) > 4000
    close = gdm_svd.fit_to(weave, within=0.15)
    assert gdm_svd.error(weave, close) <= 0.15
    assert gdm_svd.error(weave, gdm_svd.fit(weave, GdmSvdOptions(rank=close.rank - 1))) > 0.15


@pytest.mark.parametrize("level", [-5.0, 0.1])
def test_empty_and_solid_volumes_are_fitted(level):
    table = layered(level)
    found = gdm_svd.fit(table, GdmSvdOptions(rank=2))
    whole = found.expanded()
    assert torch.equal(whole.left, table.left)
    assert whole.distance.any() == hits_of(table).any()
    assert torch.isfinite(found.maps).all()


def test_one_ring_beside_each_pole_is_enough():
    gdm = bake_gdm.in_memory(generators.pipes(), GdmOptions(texels=1, layers=2, n_theta=2, n_phi=3))
    found = gdm_svd.fit(gdm, GdmSvdOptions(rank=2))
    assert torch.equal(found.expanded().left, gdm.left)


@pytest.mark.errors
def test_ranks_and_budgets_that_cannot_be_kept_are_refused(weave):
    with pytest.raises(ConfigError, match=r"compress\.rank: expected 1 to 40 for this table, got 41"):
        gdm_svd.fit(weave, GdmSvdOptions(rank=41))
    with pytest.raises(ConfigError, match=r"compress\.rank"):
        GdmSvdOptions(rank=0)
    with pytest.raises(ConfigError, match=r"compress\.size: expected at least \d+ bytes"):
        gdm_svd.fit_to(weave, size=10)
    with pytest.raises(ConfigError, match=r"compress\.error: expected at least .* voxels, which rank 40"):
        gdm_svd.fit_to(replace(weave), within=-1.0)
    with pytest.raises(ConfigError, match="either --size or --error"):
        gdm_svd.fit_to(weave)
