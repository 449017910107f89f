import pytest

from tests.render.scenes import camera, sun
from torchmeso.bench import vdm
from torchmeso.bench.vdm import VdmOptions
from torchmeso.bench.vdm_frame import VdmFrames, look
from torchmeso.geometry import shapes
from torchmeso.geometry.rays import RayScene
from torchmeso.meso import bake_gdm, generators
from torchmeso.meso.bake_gdm import GdmOptions
from torchmeso.meso.displace import displace

BODIES = {
    "torus": (shapes.torus(triangles=400, tiles=(6, 2)), camera((0.0, 2.04, 2.21), fov_deg=40)),
    "plane": (shapes.plane(triangles=32, tiles=(3, 3)), camera((0.3, 1.5, 2.0), fov_deg=50)),
}


@pytest.fixture(scope="module")
def weave():
    meso = generators.weave()
    table = vdm.bake(meso, VdmOptions(texels=24, views="grid(12, 6, 87.5)", curvatures=9))
    return meso, table, bake_gdm.in_memory(meso, GdmOptions(texels=16, layers=6, n_theta=2, n_phi=4))


@pytest.mark.parametrize("name", BODIES)
def test_the_kernel_shows_what_the_formula_says(weave, device, name):
    """But for pixels where the table is about to change its mind."""
    _, table, gdm = weave
    mesh, view = BODIES[name]
    frames = VdmFrames(mesh, table, gdm, view, sun(0.5, 0.8, 0.4))
    frames.draw(view)
    found, exact = frames.seen, look(mesh, table, view)
    alike = ((found.t - exact.t).abs() < 1e-3) | (found.t.isinf() & exact.t.isinf())
    assert alike.double().mean() > 0.99  # measured 0.998
    seen = found.t.isfinite()
    assert 0.2 < seen.double().mean() < 0.95
    assert ((found.place - exact.place).abs().amax(-1) < 5e-3)[seen & alike].double().mean() > 0.99
    assert (frames.rgb[seen].amax(-1) > 0).double().mean() > 0.95
    assert (frames.rgb[~seen] == 0).all()


@pytest.mark.slow
@pytest.mark.parametrize(("name", "bound"), [("plane", 0.02), ("torus", 0.06)])
def test_a_frame_is_close_to_the_displaced_mesh(weave, name, bound):
    """Distances beside rays at the same weave as triangles: exact on a plane but for the table's size."""
    meso, table, _ = weave
    mesh, view = BODIES[name]
    twin = displace(mesh, meso, max_edge=0.1)
    origin, direction, _ = view.rays(view.pixel_centres().reshape(-1, 2))
    truth = RayScene(twin.vertices, twin.faces).first_hit(origin.float(), direction.float()).t
    found = look(mesh, table, view).t.flatten()
    both = found.isfinite() & truth.isfinite()
    assert (found.isfinite() == truth.isfinite()).double().mean() > 0.9
    assert (found - truth)[both].abs().median() / mesh.scale.mean() < bound
