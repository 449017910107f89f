import pytest
import torch
import trimesh

from torchmeso.data.height_field import HeightField
from torchmeso.errors import GeometryError
from torchmeso.meso import mesostructure
from torchmeso.meso.bake_mdf import RayCastMdf
from torchmeso.meso.mesostructure import Mesostructure


def test_height_field_passes_through_its_samples(rng):
    z = -0.2 * torch.rand(8, 12, generator=rng)
    z = z - z.max()
    meso = mesostructure.from_height_field(HeightField(height=z, albedo=None, h=0.2))
    from torchmeso.data.address import texel_centres

    uv = texel_centres(8, 12).reshape(-1, 2)
    D = RayCastMdf(meso).evaluate(uv, torch.tensor([0.0, 0.0, 1.0]).expand(len(uv), 3))
    torch.testing.assert_close(D, -z.flatten(), rtol=0, atol=2e-5)


def test_height_field_is_closed_over_the_border(rng):
    z = -0.2 * torch.rand(5, 5, generator=rng)
    meso = mesostructure.from_height_field(HeightField(height=z - z.max(), albedo=None, h=0.2))
    uv = torch.rand(5000, 2, generator=rng)
    D = RayCastMdf(meso).evaluate(uv, torch.tensor([0.0, 0.0, 1.0]).expand(5000, 3))
    assert torch.isfinite(D).all()


@pytest.mark.parametrize("texels", [5, 48, 100])
def test_border_has_no_crack(texels, rng):
    """Rays straight down on the vertices of the border themselves; most texel counts are no powers of two."""
    z = -0.2 * torch.rand(texels, texels, generator=rng)
    meso = mesostructure.from_height_field(HeightField(height=z - z.max(), albedo=None, h=0.2))
    uv = meso.geometry.vertices[:, :2]
    D = RayCastMdf(meso).evaluate(uv, torch.tensor([0.0, 0.0, 1.0]).expand(len(uv), 3))
    assert torch.isfinite(D).all()


def test_colour_follows_the_picture():
    albedo = torch.zeros(4, 4, 3)
    albedo[0, :, 0] = 1  # the top row is red
    field = HeightField(height=torch.zeros(4, 4), albedo=albedo, h=0.1)
    meso = mesostructure.from_height_field(field, albedo=(1, 1, 1))
    from torchmeso.transport.tracer import TileTracer

    o = torch.tensor([[0.4, 0.875, 1e-4], [0.4, 0.3, 1e-4]])
    surface = TileTracer(meso.geometry, 0.1).trace(o, torch.tensor([[0.0, 0, -1]] * 2))
    torch.testing.assert_close(surface.material.albedo[:, 0], torch.tensor([1.0, 0.0]), rtol=0, atol=1e-6)


def test_any_triangle_tile(tmp_path):
    pyramid = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 0.3]],
                              [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]], process=False)  # fmt: skip
    pyramid.export(tmp_path / "tile.ply")
    meso = mesostructure.from_file(tmp_path / "tile.ply", albedo=(0.1, 0.2, 0.3))
    assert meso.h == pytest.approx(0.3)
    D = RayCastMdf(meso).evaluate(torch.tensor([[0.5, 0.5], [0.25, 0.5]]), torch.tensor([[0.0, 0, 1]] * 2))
    torch.testing.assert_close(D, torch.tensor([0.0, 0.15]), rtol=0, atol=1e-5)


@pytest.mark.errors
def test_material_outside_the_slab_is_refused(tmp_path):
    box = trimesh.creation.box()
    box.export(tmp_path / "box.ply")
    with pytest.raises(GeometryError, match=r"expected z from -0\.5 to 0"):
        mesostructure.from_file(tmp_path / "box.ply", h=0.5)
    good = mesostructure.from_file(tmp_path / "box.ply")
    empty = type(good.geometry)(
        vertices=good.geometry.vertices,
        faces=good.geometry.faces[:0],
        part=good.geometry.part[:0],
        palette=good.geometry.palette,
    )
    with pytest.raises(GeometryError, match="at least one triangle"):
        Mesostructure(geometry=empty, h=1)
