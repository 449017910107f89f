import pytest
import torch

from tests.data import btf_bytes
from tests.pipeline.small import small
from torchmeso.compress import rti
from torchmeso.data import eigen_btf, hsh, image, ptm
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


def test_models_of_streams(tmp_path):
    found = bake.open_model(bake.prepare(small()) and bake.model_path(small().materials["brick"]))
    eigen_btf.save(found.btf, tmp_path / "a.meso", coded=True, psnr=31.4)
    about = describe.file(tmp_path / "a.meso")
    assert (about["texels"], about["storage"]) == ("8 x 8", "uint8, adaptive steps, entropy-coded")
    assert about["PSNR when fitted (dB)"] == 31.4


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


def test_bonn_files(tmp_path):
    values = btf_bytes.random_values()
    (tmp_path / "a.btf").write_bytes(btf_bytes.dfmf(values, size=2))
    assert describe.file(tmp_path / "a.btf") == {
        "kind": "Bonn BTF (!DFMF08FCR, version 4)",
        "lights": "6, rings(20: 2 @ 10, 60: 4)",
        "views": "4, rings(0: 1, 30: 3)",
        "texels": "5 x 3",
        "channels": "a, b, c",
        "colour model": "0 (RGB)",
        "cos(theta_i)": "held",
        "components": "15, 15, 15",
        "storage": "float16",
        "measured with": "dome, camera, lamp",
        "pixels per mm": 12.5,
        "on disk": human_size((tmp_path / "a.btf").stat().st_size),
    }
    scattered = [(10.0, 0.0), (40.0, 5.0), (40.0, 20.0), (40.0, 90.0), (60.0, 0.0), (70.0, 3.0)]
    (tmp_path / "b.btf").write_bytes(btf_bytes.bdi(values, lights=scattered, cosine=0))
    about = describe.file(tmp_path / "b.btf")
    assert about["lights"] == "6, not all on rings of even steps"
    assert (about["cos(theta_i)"], about["chunks"]) == ("not held (multiplied in)", "2, full")
    (tmp_path / "c.btf").write_bytes(btf_bytes.pvf(values, version=1))
    about = describe.file(tmp_path / "c.btf")
    assert (about["cos(theta_i)"], about["components"]) == ("not told (taken as held)", "6 for each view")


@pytest.mark.errors
def test_unknown_files(tmp_path):
    with pytest.raises(FormatError, match="found none"):
        describe.file(tmp_path / "none.png")
    (tmp_path / "a.txt").write_text("x")
    with pytest.raises(FormatError, match=r"expected a table \(\.btf\.zarr"):
        describe.file(tmp_path / "a.txt")
