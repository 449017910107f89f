import pytest
import torch

from tests.pipeline.small import small
from torchmeso.errors import BackendError
from torchmeso.geometry import shapes
from torchmeso.meso import generators
from torchmeso.meso.bake_mdf import RayCastMdf
from torchmeso.pipeline import scene as scenes
from torchmeso.pipeline import truth
from torchmeso.pipeline.bake import prepare, silent
from torchmeso.pipeline.render import Painter, render
from torchmeso.render.frame import FrameOptions
from torchmeso.render.scene import Material, Object, Scene


def test_picture_looks_like_the_truth():
    """The same scene twice: objects in the same pixels, brightness alike."""
    settings = small()
    made = render(settings)
    found = truth.render(settings)
    assert (made.picture.owner == found.owner).float().mean() > 0.97
    both = (made.picture.owner == 0) & (found.owner == 0)
    assert torch.isclose(
        made.picture.rgb[both].mean(), found.rgb[both].mean(), rtol=0.3
    )  # two rings of four directions
    assert torch.isfinite(made.picture.rgb).all()


def test_same_bits_from_the_cache():
    assert torch.equal(render(small()).picture.rgb, render(small()).picture.rgb)


def test_auto_falls_back_to_torch_where_kernels_cannot_read_a_material(device):
    mesh = shapes.sphere(triangles=100)
    scene = Scene(objects=(Object(mesh=mesh, material=Material(mdf=RayCastMdf(generators.sheet()))),), lights=())
    view = small().camera.build()
    with pytest.warns(UserWarning, match="expected an MDF of 8 bits, got RayCastMdf; use the torch backend"):
        picture = Painter(scene, FrameOptions(), "auto").paint(view)
    assert picture.rgb.shape == (36, 48, 3)
    with pytest.raises(BackendError):
        Painter(scene, FrameOptions(), "opencl")


def test_both_backends_show_the_same(device):
    shown = []
    for backend in ("torch", "opencl"):
        config = small(backend=backend)
        assets = prepare(config, silent)
        shown.append(Painter(scenes.build(config, assets), config.render, backend).show(config.camera.build()).copy())
    assert abs(shown[0].astype(int) - shown[1]).max() <= 1
