import pytest
import torch

from tests.pipeline.small import small
from torchmeso.data import image
from torchmeso.errors import FormatError, human_size
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


@pytest.mark.errors
def test_unknown_files(tmp_path):
    with pytest.raises(FormatError, match="found none"):
        describe.file(tmp_path / "none.png")
    (tmp_path / "a.txt").write_text("x")
    with pytest.raises(FormatError, match=r"expected a table \(\.btf\.zarr"):
        describe.file(tmp_path / "a.txt")
