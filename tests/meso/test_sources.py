import torch

from torchmeso.data import image
from torchmeso.meso.generators import GENERATORS
from torchmeso.meso.sources import SOURCES, SUFFIXES


def test_every_generator_is_a_source():
    assert set(SOURCES) == {*GENERATORS, "pictures", "scan", "mesh", "textile"}


def test_pictures_become_a_height_field(tmp_path):
    ramp = torch.linspace(0, 1, 16)[None, :, None].expand(16, 16, 3)
    image.write_png(tmp_path / "d.png", ramp)
    image.write_png(tmp_path / "a.png", ramp)
    grey = SOURCES["pictures"](displacement=str(tmp_path / "d.png"), h=0.2, texels=8)
    assert grey.h == 0.2
    assert torch.allclose(grey.geometry.palette.albedo, torch.tensor([[0.6, 0.6, 0.6]]))
    coloured = SOURCES["pictures"](
        displacement=str(tmp_path / "d.png"), albedo=str(tmp_path / "a.png"), h=0.2, texels=8
    )
    assert coloured.geometry.albedo_map is not None
    assert torch.allclose(coloured.geometry.palette.albedo, torch.ones(1, 3))


def test_a_suffix_names_a_reader_of_files():
    assert set(SUFFIXES.values()) <= set(SOURCES)
    assert SUFFIXES[".tg3"] == "textile"


def test_a_mesh_file_is_moved_to_the_top_of_the_slab(tmp_path):
    (tmp_path / "a.obj").write_text("v 0 0 0.5\nv 1 0 0.5\nv 0 1 0.2\nf 1 2 3\n")
    tile = SOURCES["mesh"](path=str(tmp_path / "a.obj"), h=0.4, colour=(0.1, 0.2, 0.3))
    assert float(tile.geometry.vertices[:, 2].max()) == 0
    assert torch.allclose(tile.geometry.palette.albedo, torch.tensor([[0.1, 0.2, 0.3]]))
