import torch

from torchmeso.bench import colour
from torchmeso.render.rasterize import rasterize
from torchmeso.render.scene import Material, Scene, assemble
from torchmeso.render.scene import Object as SceneObject


def test_close_up_fills_the_picture():
    """Every pixel shows the material, so that no background flatters a figure."""
    settings = colour.close_up()
    objects = tuple(SceneObject(mesh=o.build_shape(), material=Material()) for o in settings.objects)
    world = assemble(Scene(objects=objects, lights=()))
    layers = rasterize(settings.camera.build(), world.vertices, world.faces)
    assert (layers.start.diff() > 0).all()


def test_rows_name_what_they_are_compared_with():
    true = torch.rand(32, 32, 3)
    full = (true + 0.05).clamp(max=1)
    rows = list(
        colour._colour_rows("btf.rank.4", "rank 4", full * 0.9, full, true, {"series": "rank", "x": 4, "ms": 1.0})
    )
    names = [r.id for r in rows if r.unit == "dB"]
    assert names == ["btf.rank.4.psnr_vs_full", "btf.rank.4.psnr_vs_truth"]
    assert all(r.curve is not None and r.curve["x"] == 4 for r in rows)
