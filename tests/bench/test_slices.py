import torch

from tests.render.scenes import camera, sun
from torchmeso.bench.slices import Slices, nearest_solid
from torchmeso.geometry import shapes
from torchmeso.meso import bake_gdm, generators
from torchmeso.meso.bake_gdm import GdmOptions


def test_the_kernel_draws_what_the_formula_says(device):
    """All but pixels at the edges of triangles, which the formula snaps to a grid of 1/256 pixel."""
    mesh = shapes.torus(triangles=400, tiles=(5, 2))
    gdm = bake_gdm.in_memory(generators.weave(), GdmOptions(texels=16, layers=6, n_theta=2, n_phi=4))
    view = camera((0.0, 2.04, 2.21), fov_deg=40)
    for floor in (True, False):
        peer = Slices(mesh, gdm, view, sun(0.5, 0.8, 0.4), floor=floor)
        peer.draw(view)
        exact = nearest_solid(mesh, gdm, view, floor=floor)
        alike = (peer.depth - exact).abs() < 1e-4 * exact
        alike |= peer.depth.isinf() & exact.isinf()
        assert alike.double().mean() > 0.99
        seen = peer.depth.isfinite()
        assert 0.2 < seen.double().mean() < 0.9
        assert (peer.rgb[seen].amax(-1) > 0).double().mean() > 0.95
        assert (peer.rgb[~seen] == 0).all()


def test_another_view_needs_more_room(device):
    mesh = shapes.torus(triangles=400, tiles=(5, 2))
    gdm = bake_gdm.in_memory(generators.sheet(), GdmOptions(texels=2, layers=2, n_theta=2, n_phi=4))
    far, near = camera((0.0, 40.0, 40.0), fov_deg=40), camera((0.0, 2.04, 2.21), fov_deg=40)
    peer = Slices(mesh, gdm, far, sun(0.0, 1.0, 0.0))
    for view in (far, near):
        peer.draw(view)
        alike = (peer.depth - nearest_solid(mesh, gdm, view)).abs() < 1e-3
        assert (alike | peer.depth.isinf()).double().mean() > 0.99
    assert torch.isfinite(peer.depth).any()
