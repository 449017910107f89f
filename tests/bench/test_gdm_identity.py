import pytest
import torch

from torchmeso.bench import gdm_identity
from torchmeso.meso import bake_gdm, bake_mdf, generators
from torchmeso.meso.bake_gdm import GdmOptions
from torchmeso.meso.bake_mdf import MdfOptions


@pytest.mark.parametrize("name", ["weave", "chain", "pipes"])
def test_the_top_of_a_gdm_is_an_mdf(name):
    """At the samples both have: the same rays, told apart by the step of the codes and by what lies on a surface."""
    meso = generators.GENERATORS[name]()
    gdm = bake_gdm.in_memory(meso, GdmOptions(texels=16, layers=8, n_theta=8, n_phi=8, storage="float32"))
    options = MdfOptions(texels=16, views=gdm_identity.views_of(gdm), storage="float32")
    mdf = bake_mdf.in_memory(meso, options)
    found = gdm_identity.at_nodes(gdm, mdf)
    assert found.agree.double().mean() > 0.999
    assert len(found.off) > 1000
    assert found.off.quantile(0.99) < 3e-4  # rays of both begin 1e-4 tiles before the plane, one along it, one above


def test_views_are_the_ends_of_downward_rays():
    gdm = bake_gdm.in_memory(generators.sheet(), GdmOptions(texels=2, layers=2, n_theta=16, n_phi=32))
    assert gdm_identity.views_of(gdm) == "grid(32, 8, 84.375)"
    from torchmeso.geometry import hemisphere

    wo = hemisphere.parse("grid(32, 8, 84.375)").directions(torch.float64)
    w = gdm.directions.directions(torch.float64).reshape(-1, 3)
    assert (torch.cdist(-wo, w).min(1).values < 1e-6).all()


@pytest.mark.errors
def test_tables_of_other_samples_are_refused():
    gdm = bake_gdm.in_memory(generators.sheet(), GdmOptions(texels=2, layers=2, n_theta=4, n_phi=4))
    mdf = bake_mdf.in_memory(generators.sheet(), MdfOptions(texels=3, views="grid(4, 2, 67.5)"))
    with pytest.raises(ValueError, match="at the texels and downward directions"):
        gdm_identity.at_nodes(gdm, mdf)
