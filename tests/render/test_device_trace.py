import pytest
import torch

from tests.render.test_gdm_trace import rays_into
from torchmeso.geometry import shapes, shell
from torchmeso.geometry.shell import BORDER, BOTTOM, TOP
from torchmeso.meso import bake_gdm, generators
from torchmeso.meso.bake_gdm import GdmOptions
from torchmeso.render import gdm_trace
from torchmeso.render.device_trace import DeviceTrace

BODIES = {
    "torus": lambda n=300: shapes.torus(triangles=n, tiles=(6, 2)),
    "plane": lambda n=50: shapes.plane(triangles=n, tiles=(3, 3)),
}


@pytest.fixture(scope="module")
def weave():
    return bake_gdm.in_memory(generators.weave(), GdmOptions(texels=20, layers=7, n_theta=8, n_phi=16, cap=0.7))


@pytest.mark.parametrize("name", BODIES)
def test_rays_pass_the_same_prisms_as_in_float64(name, rng):
    body = BODIES[name]()
    built = shell.build(body, 0.2)
    entries, _, _ = rays_into(built, "open", 8000, rng)
    truth = gdm_trace.trace(built, None, entries, floor=False)
    found = DeviceTrace(built, body, None, floor=False).trace(entries)
    same = (found.prisms == truth.prisms) & (found.prism == truth.prism) & (found.through == truth.through)
    assert same.double().mean() > 0.9995
    far = (found.t - truth.t).abs()[same]
    assert far.quantile(0.999) < 1e-4
    assert ((found.place - truth.place).abs().amax(1)[same] < 1e-3).double().mean() > 0.999


@pytest.mark.parametrize("queries", [1, 4])
def test_material_is_met_where_torch_meets_it(weave, queries, rng):
    body = BODIES["torus"]()
    built = shell.build(body, weave.h)
    entries, _, _ = rays_into(built, "solid", 6000, rng)
    truth = gdm_trace.trace(built, weave, entries, queries=queries)
    found = DeviceTrace(built, body, weave, queries=queries).trace(entries)
    same = (found.hit == truth.hit) & (found.prism == truth.prism)
    assert same.double().mean() > 0.999
    both = same & truth.hit
    assert both.double().mean() > 0.5
    assert (found.t - truth.t).abs()[both].quantile(0.99) < 1e-4


@pytest.mark.parametrize("onto", ["faces", "edges", "vertices"])
@pytest.mark.parametrize("name", BODIES)
def test_every_ray_comes_out_again(name, onto, rng):
    body = BODIES[name]()
    built = shell.build(body, 0.2)
    entries, _, _ = rays_into(built, "open", 50000, rng, onto=onto)
    found = DeviceTrace(built, body, None, floor=False).trace(entries)
    assert not found.hit.any()
    enters = found.t.isfinite()
    assert enters.double().mean() > 0.9
    assert torch.isin(found.through[enters], torch.tensor([TOP, BOTTOM, BORDER])).all()
    assert (found.prisms >= 0).all()
    assert torch.isfinite(found.place).all()


def test_no_rays_are_no_error(weave):
    body = BODIES["plane"]()
    nothing = gdm_trace.Entries(torch.zeros(0, 3), torch.zeros(0, 3), *(torch.zeros(0, dtype=torch.long),) * 2)
    assert len(DeviceTrace(shell.build(body, weave.h), body, weave).trace(nothing).hit) == 0
