import pytest
import torch

from torchmeso.bench import minify
from torchmeso.data.eigen_btf import EigenBtf
from torchmeso.geometry import hemisphere
from torchmeso.render.rasterize import rasterize
from torchmeso.render.scene import Material


def checkers():
    """A board of eight by eight fields, the same for every light and view."""
    field = (torch.arange(64)[:, None] // 8 + torch.arange(64) // 8) % 2
    lights = hemisphere.grid(4, 2, 80)
    maps = field.float()[None, :, :, None, None].expand(len(lights), 64, 64, 1, 3)
    return EigenBtf(
        maps=maps.contiguous(), weights=torch.ones(len(lights), 1), scale=torch.ones(1, 3), offset=torch.zeros(1, 3),
        lights=lights, views=lights,
    )  # fmt: skip


def test_the_floor_fills_the_picture_and_reaches_from_half_a_texel_to_sixteen():
    scene, camera = minify.floor_scene(Material(btf=checkers())), minify.floor_camera()
    item = scene.objects[0].mesh
    layers = rasterize(minify.floor_camera(80, 60), item.vertices, item.faces)
    assert (layers.start.diff() == 1).all()
    side = minify.texels_per_pixel(scene, camera)
    assert float(side.min()) == pytest.approx(0.6, abs=0.15)
    assert float(side.max()) == pytest.approx(16, abs=1)


def test_a_sequence_that_jumps_flickers_more():
    calm = torch.linspace(0, 1, 5)[:, None, None, None].expand(5, 4, 4, 3)
    jumps = calm + 0.3 * (torch.arange(5) % 2)[:, None, None, None]
    assert float(minify._change(calm)) == pytest.approx(0.25)
    assert float(minify._change(jumps)) > 1.1 * 0.25
