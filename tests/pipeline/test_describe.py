import pytest
import torch

from tests.pipeline.small import small
from torchmeso.compress import rti
from torchmeso.data import hsh, image, ptm
from torchmeso.data import rti as rti_files
from torchmeso.data.rti import LightSet
from torchmeso.errors import FormatError, human_size
from torchmeso.geometry import hemisphere
from torchmeso.pipeline import bake, describe


def test_tables_and_models():
    bake.prepare(small())
    brick = small().materials["brick"]
    btf_table, mdf_table = bake.table_paths(brick)
    about = describe.file(btf_table)
    assert about["lights"] == "8, grid(4, 2, 80)"
    assert about["texels"] == "8 x 8"
    assert about["made from"] == {"type": "brick"}
    about = describe.file(mdf_table)
    assert about["entries without a hit"] == 0
    about = describe.file(bake.model_path(brick))
    assert (about["rank"], about["storage"]) == (2, "uint8")
    assert about["MDF"] == "grid(6, 3, 87.5), h = 0.1 tiles"
    assert about["MDF data"] == human_size(18 * 16**2)
    # Eight lights, 8 x 8 texels, two terms of rgb in bytes; float32 weights of eight views, scales and offsets.
    assert about["BTF data"] == human_size(8 * 8 * 8 * 2 * 3 + 4 * (8 * 2 + 2 * 2 * 3))


def test_other_files(tmp_path):
    image.write_png(tmp_path / "a.png", torch.ones(3, 5, 3))
    assert describe.file(tmp_path / "a.png")["size"] == "5 x 3"
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    assert "unwrap: true" in describe.file(tmp_path / "a.obj")["texture coordinates"]
    (tmp_path / "b.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n")
    assert describe.file(tmp_path / "b.obj")["components"] == "1, 0 closed"


def test_rti_files(tmp_path):
    w = hemisphere.from_rings((0, 30, 60), (1, 5, 7), (0, 0, 0)).directions()
    files = tuple(tmp_path / f"{k}.png" for k in range(len(w)))
    for file in files:
        image.write_png(file, torch.ones(3, 5, 3))
    lights = LightSet(files=files, directions=w)
    rti_files.write(lights, tmp_path / "a.lp")
    about = describe.file(tmp_path / "a.lp")
    assert (about["lights"], about["lowest light"], about["texels"]) == (13, "60 deg from above", "5 x 3")
    ptm.write(rti.fit_ptm(lights), tmp_path / "a.ptm")
    assert describe.file(tmp_path / "a.ptm")["format"] == "LRGB"
    hsh.write(rti.fit_hsh(lights), tmp_path / "a.rti")
    assert describe.file(tmp_path / "a.rti")["terms"] == 9


@pytest.mark.errors
def test_unknown_files(tmp_path):
    with pytest.raises(FormatError, match="found none"):
        describe.file(tmp_path / "none.png")
    (tmp_path / "a.txt").write_text("x")
    with pytest.raises(FormatError, match=r"expected a table \(\.btf\.zarr"):
        describe.file(tmp_path / "a.txt")
