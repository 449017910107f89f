import torch

from torchmeso.bench import gdm_error
from torchmeso.meso import bake_gdm, generators
from torchmeso.meso.bake_gdm import GdmOptions, RayCastGdm


def test_a_table_of_pipes_is_close_to_cast_rays():
    meso = generators.pipes()
    gdm = bake_gdm.in_memory(meso, GdmOptions(texels=24, layers=10, n_theta=12, n_phi=24))
    found = gdm_error.against_rays(gdm, RayCastGdm(meso, gdm.cap), 3000)
    assert found.agree.double().mean() > 0.95
    assert found.off.median() < 0.5


def test_pixels_near_an_outline():
    mask = torch.zeros(40, 40, dtype=torch.bool)
    mask[:, 20:] = True
    near = gdm_error.near_outline(mask)
    assert near[:, 12:28].all()
    assert not near[:, :12].any()
    assert not near[:, 28:].any()
