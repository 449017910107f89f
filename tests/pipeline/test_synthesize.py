import pytest
import torch
from click.testing import CliRunner

from tests.synthesize import looks
from torchmeso import config
from torchmeso.cli import main
from torchmeso.data import eigen_btf, image, quilting_map, sh_pca_btf
from torchmeso.errors import ConfigError
from torchmeso.pipeline import bake, describe
from torchmeso.synthesize import patch_error, quilting


def run(*arguments):
    return CliRunner().invoke(main, ["synthesize", *map(str, arguments)])


@pytest.fixture
def picture(rng, tmp_path):
    image.write_png(tmp_path / "p.png", looks.noise(20, 24, rng))
    return tmp_path / "p.png"


def test_a_picture_becomes_a_map_and_debug_pictures(picture, tmp_path):
    found = run(
        picture, "--size", "40x30", "--patch", 8, "--debug-pictures", tmp_path / "d", "--out", tmp_path / "a.quilt"
    )
    assert found.exit_code == 0, found.output
    assert "40 x 30 texels from 24 x 20" in found.output and len(found.output.splitlines()) == 1
    quilting_ = quilting_map.load(tmp_path / "a.quilt")
    assert quilting_.texels == (30, 40) and quilting_.source == (20, 24)
    assert sorted(p.name for p in (tmp_path / "d").iterdir()) == ["cuts.png", "look.png", "map.png", "seams.png"]
    about = describe.file(tmp_path / "a.quilt")
    assert about["kind"] == "quilting map" and about["patch"] == 8 and about["made from"] == "p.png"


def test_a_picture_is_quilted_straight_into_a_picture(picture, tmp_path):
    assert run(picture, "--size", 32, "--tileable", "--seed", 3, "--out", tmp_path / "a.png").exit_code == 0
    codes = image.read_codes(picture.read_bytes(), "p").reshape(-1, 3).tolist()
    found = image.read_codes((tmp_path / "a.png").read_bytes(), "a")
    assert found.shape == (32, 32, 3) and all(c in codes for c in found.reshape(-1, 3).tolist())


@pytest.mark.parametrize(("kind", "container"), [(looks.eigen, eigen_btf), (looks.sh_pca, sh_pca_btf)])
def test_a_model_gives_the_map_that_the_library_gives(kind, container, rng, tmp_path):
    model = kind(rng, size=(12, 12))
    container.save(model, tmp_path / "m.meso")
    found = run(tmp_path / "m.meso", "--size", 20, "--bands", 2, "--seed", 5, "--out", tmp_path / "a.quilt")
    assert found.exit_code == 0, found.output
    source = patch_error.exemplar(model, patch_error.Metric(bands=2))
    expected = quilting.grow(source, (20, 20), rng=torch.Generator().manual_seed(5)).map
    assert quilting_map.load(tmp_path / "a.quilt").index.equal(expected.index)


@pytest.mark.errors
@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--size", "4by4"], "--size: expected numbers like 256 or 400x300, got '4by4'"),
        (["--patch", "21"], "expected at most the exemplar's shorter side, 20 texels, got 21"),
        (["--patch", "8", "--overlap", "5"], "expected at most half a patch of 8 texels, got 5"),
        (["--tolerance", "-1"], "quilting.tolerance: expected a value from 0"),
        (["--bands", "2"], "a picture has neither views nor harmonics"),
        (["--size", "1", "--tileable"], "has to be as large as a patch"),
        (["--out", "a.meso"], "expected a name that ends in .quilt, or for a picture in .png"),
    ],
)
def test_bad_input_is_one_sentence(arguments, text, picture, tmp_path):
    found = run(picture, "--out", tmp_path / "a.quilt", *arguments)
    assert found.exit_code == 2 and text in found.output and len(found.output.splitlines()) == 1
    assert not (tmp_path / "a.quilt").exists()


@pytest.mark.errors
def test_other_files_are_no_exemplars(tmp_path):
    (tmp_path / "a.txt").write_text("x")
    assert "expected a model (.meso) or a picture" in run(tmp_path / "a.txt", "--out", tmp_path / "a.quilt").output
    (tmp_path / "a.quilt").write_text("x")
    assert "exists already" in run(tmp_path / "a.txt", "--out", tmp_path / "a.quilt").output


def test_a_single_texel_and_tolerance_0(picture, tmp_path):
    assert run(picture, "--size", 1, "--out", tmp_path / "a.quilt").exit_code == 0
    assert run(picture, "--size", 30, "--tolerance", 0, "--out", tmp_path / "b.quilt").exit_code == 0


def test_a_configuration_lays_pictures_out_by_a_map(picture, tmp_path):
    assert run(picture, "--size", 60, "--tileable", "--out", tmp_path / "a.quilt").exit_code == 0
    content = {
        "materials": {"m": {"albedo_map": "p.png", "quilting": "a.quilt"}},
        "objects": [{"shape": "plane", "material": "m", "tiles": 4}],
        "camera": {"eye": [0, 2, 0.1], "width": 8, "height": 8},
    }
    settings = config.parse(content, folder=tmp_path)
    material = bake.prepare(settings)["m"].material
    assert material.btf.quilting.texels == (60, 60) and material.btf.quilting.source == (20, 24)


@pytest.mark.errors
@pytest.mark.parametrize("material", [{"albedo": [1, 1, 1]}, {"model": "a.gdm.zarr"}])
def test_a_map_needs_something_to_lay_out(material, tmp_path):
    content = {
        "materials": {"m": {**material, "quilting": "a.quilt"}},
        "objects": [{"shape": "plane", "material": "m"}],
        "camera": {"eye": [0, 2, 0.1]},
    }
    with pytest.raises(ConfigError, match="'quilting' lays out a BTF, an MDF or pictures"):
        config.parse(content, folder=tmp_path)
