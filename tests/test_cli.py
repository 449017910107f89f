import json
import os
import re
import subprocess
import sys
import time

import pytest
import torch
import yaml
from click.testing import CliRunner

from tests.data import bonn, tg3
from tests.pipeline.small import CONTENT
from torchmeso.backends import opencl
from torchmeso.cli import main
from torchmeso.data import btf, image, mdf
from torchmeso.data.btf import Btf
from torchmeso.data.eigen_btf import EigenBtf
from torchmeso.geometry import hemisphere
from torchmeso.meso.generators import GENERATORS
from torchmeso.pipeline.bake import open_model


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCHMESO_CACHE", str(tmp_path / "cache"))


@pytest.fixture
def small(tmp_path):
    path = tmp_path / "small.yaml"
    path.write_text(yaml.safe_dump(CONTENT))
    return path


def run(*arguments):
    return CliRunner().invoke(main, [str(a) for a in arguments])


def test_info_lists_devices_and_tests_the_chosen_one(device):
    result = run("info", "--device")
    assert result.exit_code == 0
    assert "self-test: exact" in result.stdout
    assert any(d["chosen"] for d in json.loads(run("info", "--device", "--json").stdout))


def test_info_without_a_platform_says_what_to_do(monkeypatch):
    monkeypatch.setattr(opencl, "list_devices", list)
    result = run("info", "--device")
    assert result.exit_code == 0
    assert "no OpenCL platform: everything runs on torch" in result.stdout


def test_info_on_a_file(small):
    assert "objects: torus (brick), plane (clay)" in run("info", small).stdout
    assert json.loads(run("info", small, "--json").stdout)["picture"] == "48 x 36"


def test_a_weave_file_is_baked(tmp_path):
    path = tmp_path / "a.tg3"
    path.write_bytes(tg3.textile([tg3.straight(0), tg3.straight(1, z=0.2)]))
    for suffix, dials in ((".gdm.zarr", ("--layers", 4)), (".mdf.zarr", ("--views", "grid(6, 3, 80)"))):
        out = tmp_path / f"a{suffix}"
        result = run("bake", "--meso", path, "--out", out, "--texels", 8, *dials)
        assert result.exit_code == 0, result.output
        assert "'type': 'textile'" in run("info", out).stdout


def test_from_a_mesostructure_to_a_gdm_model(tmp_path):
    table, factored, coded = (tmp_path / name for name in ("a.gdm.zarr", "a.gdm.meso", "b.gdm.meso"))
    assert run("bake", "--meso", "pipes", "--out", table, "--texels", 6, "--layers", 3).exit_code == 0
    said = run("compress", table, "--method", "svd", "--rank", 3, "--out", factored).stdout
    assert re.search(r"a\.gdm\.meso  rank 3  95 % of the hits within \d+\.\d\d voxels", said)
    assert "rank: 3" in run("info", factored).stdout
    budget = "--size", "60kB", "--fill", "boundary", "--out", factored, "--force"
    assert run("compress", table, "--method", "svd", *budget).exit_code == 0
    assert factored.stat().st_size < 62_000
    assert run("compress", table, "--method", "coded", "--out", coded).exit_code == 0
    assert "exact: yes" in run("info", coded).stdout
    assert "wrong 0.00 %  RMS 0.000 voxels" in run("compare", table, coded).stdout
    assert json.loads(run("compare", table, factored, "--json").stdout)["wrong"] == 0


def test_from_a_mesostructure_to_a_model(tmp_path):
    btf_path, mdf_path, model = tmp_path / "a.btf.zarr", tmp_path / "a.mdf.zarr", tmp_path / "a.meso"
    grid = "grid(4, 2, 80)"
    result = run("bake", "--meso", "brick", "--out", btf_path, "--texels", 8, "--lights", grid, "--views", grid)
    assert result.stdout.strip() == str(btf_path)
    assert run("bake", "--meso", "brick", "--out", mdf_path, "--texels", 16).exit_code == 0
    assert mdf.load(mdf_path).texels == (16, 16)
    assert run("compress", btf_path, "--rank", 3, "--mdf", mdf_path, "--out", model).exit_code == 0
    assert "rank: 3" in run("info", model).stdout
    few = ("--light-terms", 4, "--view-terms", 4, "--unbounded", "--mdf", mdf_path, "--out", model, "--force")
    assert run("compress", btf_path, "--method", "double-sh", *few).exit_code == 0
    assert "coefficients: 4 x 4 of light and view" in run("info", model).stdout
    few = ("--rank", 3, "--light-terms", 4, "--domain", "sphere_projection", "--training", 50, "--ridge", 0)
    assert run("compress", btf_path, "--method", "sh-pca", *few, "--out", model, "--force").exit_code == 0
    said = run("info", model).stdout
    assert "coefficients: 4 of the light" in said
    assert "domain: sphere_projection" in said
    budget = ("--method", "transform", "--psnr", 35, "--mdf", mdf_path, "--out", model, "--force")
    said = run("compress", btf_path, *budget).stdout
    assert said.startswith(f"{model}  PSNR 35.") and "of 8 view components" in said
    assert "PSNR when fitted (dB): 35." in run("info", model).stdout
    assert isinstance(open_model(model, rank=2).btf, EigenBtf)
    assert run("compress", btf_path, "--method", "transform", "--size", "40kB", *budget[4:]).exit_code == 0
    factored = ("--method", "factored", "--rank", 3, "--colour", "log-y", *budget[4:])
    assert "opens as an eigen BTF of rank " in run("compress", btf_path, *factored).stdout
    assert "colour model: 11 (log Y, U/Y, V/Y)" in run("info", model).stdout
    assert isinstance(open_model(model, rank=2).btf, EigenBtf)
    for storage in ("uint8", "adaptive"):
        asked = ("--method", "eigen", "--psnr", 30, "--storage", storage, *budget[4:])
        said = run("compress", btf_path, *asked).stdout
        assert "PSNR 3" in said and "of 8\n" in said
        assert "PSNR when fitted (dB): 3" in run("info", model).stdout
        asked = ("--method", "double-sh", "--size", "20kB", "--unbounded", "--storage", storage, *budget[4:])
        assert " coefficients of light and view" in run("compress", btf_path, *asked).stdout
    assert open_model(model).mdf.texels == (16, 16)


def test_from_pictures_to_a_model(tmp_path):
    names = bonn.write(tmp_path / "set", bonn.codes())
    (tmp_path / "set" / names[1, 2]).unlink()
    assert "missing: 1 of 28 (tl040 pl000 tv050 pv140)" in run("info", tmp_path / "set").stdout
    arguments = "compress", tmp_path / "set", "--rank", 3, "--out", tmp_path / "a.meso"
    refused = run(*arguments)
    assert (refused.exit_code, refused.stderr.count("\n")) == (2, 1)
    assert "pictures are missing: 1 of 28" in refused.stderr
    assert run(*arguments, "--allow-missing").exit_code == 0
    assert "views: rings(0: 1, 50: 3 @ 20)" in run("info", tmp_path / "a.meso").stdout


def test_a_table_is_exported_as_pictures(tmp_path):
    lights = hemisphere.from_rings((0, 40), (1, 6), (0, 0))
    table = Btf(images=torch.rand(7, 7, 3, 3, 3), lights=lights, views=lights)
    btf.save(table, tmp_path / "a.btf.zarr")
    arguments = "export", tmp_path / "a.btf.zarr", "--to", tmp_path / "stack"
    assert run(*arguments).stdout.strip() == str(tmp_path / "stack")
    assert "pictures: 49" in run("info", tmp_path / "stack").stdout
    assert "exists already; give --force" in run(*arguments).stderr
    assert run(*arguments, "--force").exit_code == 0


def test_render_and_compare(small, tmp_path):
    result = run("render", small, "--out", tmp_path / "a.exr", "--json")
    assert json.loads(result.stdout)["counts"]["pixels"] == 48 * 36
    assert run("render", small, "--out", tmp_path / "b.png", "--silhouette", "none").exit_code == 0
    assert run("render", small, "--out", tmp_path / "t.exr", "--truth").exit_code == 0
    result = run("compare", tmp_path / "t.exr", tmp_path / "a.exr", "--out", tmp_path / "d.png", "--json")
    assert json.loads(result.stdout)["psnr"] > 10
    assert image.read(tmp_path / "d.png").shape == (36, 48, 3)
    assert "PSNR inf dB" in run("compare", tmp_path / "a.exr", tmp_path / "a.exr").stdout


def test_render_frames(small, tmp_path):
    result = run("render", small, "--frames", "2", "--path", "light", "--out", tmp_path / "a.png", "--backend", "torch")
    assert result.stdout.split() == [str(tmp_path / "a_0001.png"), str(tmp_path / "a_0002.png")]
    assert "exists already" in run("render", small, "--frames", "2", "--out", tmp_path / "a.png").stderr
    assert run("render", small, "--frames", "2", "--out", tmp_path / "a.gif").exit_code == 0
    for wrong in (("--frames", "2", "--out", tmp_path / "a.exr"), ("--frames", "0", "--out", tmp_path / "b.gif")):
        result = run("render", small, *wrong)
        assert result.exit_code == 2
        assert not (tmp_path / "b.gif").exists()


def test_bake_every_material(small, tmp_path):
    content = yaml.safe_load(small.read_text())
    del content["materials"]["unused"]
    small.write_text(yaml.safe_dump(content))
    result = run("bake", small, "--out", tmp_path / "tables")
    assert [line.rpartition("/")[2] for line in result.stdout.split()] == ["brick.btf.zarr", "brick.mdf.zarr"]


REFUSED = [
    (["info"], "give a FILE or --device"),
    (["info", "none.meso"], " info: error: none.meso: expected a file, found none"),
    (["bake"], "give a CONFIGURATION or --meso"),
    (["bake", "--meso", "brick"], "--meso needs --out"),
    (["bake", "--meso", "brik", "--out", "x.btf.zarr"], "got 'brik'; did you mean 'brick'?"),
    (["bake", "--meso", "no.tg3", "--out", "x.btf.zarr"], "no.tg3: expected a file, found none"),
    (["bake", "--meso", "brick", "--out", "x.btf"], "expected a name that ends in .btf.zarr, .mdf.zarr or .gdm.zarr"),
    (["bake", "--meso", "brick", "--out", "x.mdf.zarr", "--samples", "4"], "MDF tables have no --samples"),
    (["bake", "--meso", "brick", "--out", "x.btf.zarr", "--texels", "999999"], "the limit is 64.0 GiB; lower"),
    (["bake", "--meso", "brick", "--out", "x.btf.zarr", "--lights", "grid(1)"], "expected 'grid(n_phi, n_theta"),
    (["compress", "none.btf.zarr", "--out", "x.meso"], "expected a btf table, found none; bake it first"),
    (["compress", "none.btf.zarr", "--out", "x.zip"], "expected a name that ends in .meso"),
    (["compress", "a", "--energy", "2", "--out", "x.meso"], "--method eigen has no --energy"),
    (["compress", "a", "--method", "transform", "--size", "big", "--out", "x.meso"], "a size like 4MB"),
    (["compress", "a", "--method", "transform", "--energy", "2", "--out", "x.meso"], "transform has no --energy"),
    (["compress", "a", "--method", "sh-pca", "--psnr", "38", "--out", "x.meso"], "--method sh-pca has no --psnr"),
    (["compress", "a", "--colour", "yuv", "--out", "x.meso"], "--method eigen has no --colour"),
    (["compress", "a", "--psnr", "38", "--size", "4MB", "--out", "x.meso"], "--psnr or --size, and not both"),
    (["compress", "a", "--method", "sh-pca", "--storage", "adaptive", "--out", "x.meso"], "has no adaptive steps"),
    (["compress", "a", "--method", "svd", "--out", "x.meso"], "expected a name that ends in .gdm.meso"),
    (["compress", "a", "--method", "svd", "--psnr", "3", "--out", "x.gdm.meso"], "--method svd has no --psnr"),
    (["compress", "a", "--method", "coded", "--rank", "3", "--out", "x.gdm.meso"], "--method coded has no --rank"),
    (
        ["compress", "a", "--method", "svd", "--rank", "3", "--size", "1MB", "--out", "x.gdm.meso"],
        "one of --rank, --si",
    ),
    (["compress", "a", "--fill", "hits", "--out", "x.meso"], "--method eigen has no --fill"),
    (["compress", "a.gdm.zarr", "--method", "svd", "--out", "x.gdm.meso"], "expected a gdm table, found none"),
    (["compare", "a.gdm.zarr", "b.gdm.meso", "--out", "x.png"], "a GDM has none"),
    (["compress", "a", "--unbounded", "--out", "x.meso"], "--method eigen has no --unbounded"),
    (["compress", "a", "--ridge", "0", "--out", "x.meso"], "--method eigen has no --ridge"),
    (["compress", "a", "--method", "double-sh", "--rank", "3", "--out", "x.meso"], "double-sh has no --rank"),
    (["compress", "a", "--method", "sh-pca", "--unbounded", "--out", "x.meso"], "sh-pca has no --unbounded"),
    (["compress", "a", "--method", "sh-pca", "--rank", "99", "--out", "x.meso"], "compress.rank: expected 1 to 75"),
    (["render", "none.yaml", "--out", "x.png"], "expected a configuration (.yaml), found none"),
    (["render", "small.yaml", "--out", "x.gif"], "expected a name that ends in .png or .exr"),
    (["render", "small.yaml", "--out", "small.yaml.png"], "exists already; give --force"),
    (["render", "small.yaml", "--frames", "2", "--truth", "--out", "x.gif"], "--truth makes one picture"),
    (["compare", "none.png", "none.png"], "expected a picture, found none"),
]


@pytest.mark.errors
@pytest.mark.parametrize(("arguments", "message"), REFUSED, ids=range(len(REFUSED)))
def test_bad_input_is_one_sentence_and_status_2(arguments, message, small, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "small.yaml.png").write_bytes(b"x")
    before = sorted(tmp_path.rglob("*"))
    result = run(*arguments)
    assert result.exit_code == 2
    assert message in result.stderr
    assert "Traceback" not in result.stderr
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.errors
def test_debug_keeps_the_traceback():
    result = run("--debug", "info", "none.meso")
    assert result.exception is not None
    assert result.exit_code == 1


@pytest.mark.slow
def test_stopped_bake_leaves_nothing_half_written_and_goes_on(tmp_path):
    """SIGINT in the middle: status 130, no table; the same command then finishes it."""
    out = tmp_path / "a.btf.zarr"
    command = [sys.executable, "-m", "torchmeso", "bake", "--meso", "brick", "--out", str(out), "--texels", "24"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=os.environ.copy())
    part = out.with_name(out.name + ".part") / "done"
    for _ in range(600):
        if part.is_dir() and len(list(part.iterdir())) >= 2:
            break
        time.sleep(0.05)
    process.send_signal(2)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "stopped; run it again to go on" in said
    assert not out.exists()
    done = len(list(part.iterdir()))
    assert done >= 2
    assert subprocess.run(
        [*command, "--samples", "4"], check=True, capture_output=True, text=True
    ).stdout.strip() == str(out)
    assert not part.exists()


def test_every_command_has_help():
    for name in main.commands:
        result = run(name, "--help")
        assert result.exit_code == 0, name
        assert "Usage:" in result.stdout


def test_importing_the_command_line_is_cheap():
    code = "import sys, torchmeso.cli; print('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "False"


def test_png_keeps_colours(tmp_path):
    image.write_png(tmp_path / "a.png", torch.full((2, 2, 3), 0.5))
    assert "largest value: 0.5" in run("info", tmp_path / "a.png").stdout


def test_help_names_every_mesostructure():
    help_ = " ".join(run("bake", "--help").stdout.split())
    for name in GENERATORS:
        assert re.search(rf"\b{name}\b", help_), name


def test_export_writes_a_mesh_that_comes_back(tmp_path):
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl tile\nf 1/1 2/2 3/3\n"
    (tmp_path / "a.obj").write_text(text)
    assert run("export", tmp_path / "a.obj", "--to", tmp_path / "a.glb").stdout == f"{tmp_path / 'a.glb'}\n"
    told = run("info", tmp_path / "a.glb").stdout
    assert "parts: tile" in told
    assert "tangents: from the file" in told


@pytest.mark.errors
def test_a_btf_goes_out_as_bonn_file_and_comes_back(tmp_path):
    table, grid = tmp_path / "a.btf.zarr", "grid(4, 2, 80)"
    run("bake", "--meso", "brick", "--out", table, "--texels", 8, "--lights", grid, "--views", grid, "--samples", 1)
    bonn, plain, model = tmp_path / "a.btf", tmp_path / "b.btf", tmp_path / "a.meso"
    assert run("export", table, "--to", bonn, "--rank", 5).stdout == f"{bonn}\n"
    assert "exists already" in run("export", table, "--to", bonn).stderr
    assert "components: 5, 5, 5" in run("info", bonn).stdout
    assert run("export", bonn, "--to", plain, "--method", "bdi").exit_code == 0
    assert "chunks: 2, full" in run("info", plain).stdout
    assert run("compress", bonn, "--rank", 3, "--out", model).exit_code == 0
    assert "lights: rings(" in run("info", model).stdout
    result = run("export", table, "--to", plain, "--method", "bdi", "--rank", 5, "--force")
    assert (result.exit_code, result.stderr.count("leave --rank out")) == (2, 1)


def test_export_says_what_it_writes(tmp_path):
    result = run("export", "a.obj", "--to", "a.fbx")
    assert result.exit_code == 2
    assert "expected a name that ends in .glb" in result.stderr


@pytest.mark.errors
def test_the_package_has_its_stages_only():
    import torchmeso

    assert torchmeso.render.__name__ == "torchmeso.render"
    with pytest.raises(AttributeError, match="module 'torchmeso' has no attribute 'studios'"):
        torchmeso.studios  # noqa: B018
