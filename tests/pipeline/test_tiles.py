import pytest
import torch
from click.testing import CliRunner

from tests.synthesize import looks
from torchmeso.cli import main
from torchmeso.data import eigen_btf, image, quilting_map, tile_set
from torchmeso.pipeline import describe
from torchmeso.synthesize import patch_error, tiling, wang

SMALL = ("--method", "wang", "--size", 16, "--band", 8, "--patch", 8, "--refine", 1, "--candidates", 2)


def run(*arguments):
    return CliRunner().invoke(main, [*map(str, arguments)])


@pytest.fixture
def picture(rng, tmp_path):
    image.write_png(tmp_path / "p.png", looks.noise(24, 28, rng))
    return tmp_path / "p.png"


@pytest.fixture
def tiles(picture, tmp_path):
    found = run("synthesize", picture, *SMALL, "--out", tmp_path / "a.tiles", "--debug-pictures", tmp_path / "d")
    assert found.exit_code == 0, found.output
    assert "16 tiles of 16 x 16 texels from 28 x 24" in found.output and len(found.output.splitlines()) == 1
    return tmp_path / "a.tiles"


def test_a_picture_becomes_tiles_a_map_and_pictures(tiles, picture, tmp_path):
    assert sorted(p.name for p in (tmp_path / "d").iterdir()) == ["plane.png", "seams.png", "tiles.png"]
    about = describe.file(tiles)
    assert about["kind"] == "tiles" and about["band"] == 8 and about["set"] == "edges" and about["made from"] == "p.png"
    found = run("tile", tiles, "--plane", "5x3", "--seed", 2, "--out", tmp_path / "a.quilt")
    assert found.exit_code == 0 and "80 x 48 texels from 28 x 24" in found.output
    laid = quilting_map.load(tmp_path / "a.quilt")
    set_ = tile_set.load(tiles)
    assert laid.index.equal(set_.lay(tiling.plane(set_, 3, 5, seed=2)).index) and laid.tileable
    found = run("tile", tiles, "--order", "scanlines", "--exemplar", picture, "--plane", 4, "--out", tmp_path / "a.png")
    assert found.exit_code == 0, found.output
    codes = image.read_codes(picture.read_bytes(), "p").reshape(-1, 3).tolist()
    shown = image.read_codes((tmp_path / "a.png").read_bytes(), "a")
    assert shown.shape == (64, 64, 3) and all(c in codes for c in shown.reshape(-1, 3).tolist())


def test_a_model_gives_the_tiles_that_the_library_gives(rng, tmp_path):
    model = looks.eigen(rng, size=(20, 20))
    eigen_btf.save(model, tmp_path / "m.meso")
    found = run(
        "synthesize", tmp_path / "m.meso", *SMALL, "--seed", 5, "--kind", "corners", "--out", tmp_path / "a.tiles"
    )
    assert found.exit_code == 0, found.output
    options = wang.WangOptions(size=16, band=8, patch=8, refine=1, candidates=2, kind="corners")
    expected = wang.grow(patch_error.exemplar(model), options, rng=torch.Generator().manual_seed(5)).set
    assert tile_set.load(tmp_path / "a.tiles").shown().equal(expected.shown())


@pytest.mark.errors
@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--size", "16x8"], "--size: expected the side of a tile like 64, got '16x8'"),
        (["--overlap", "4"], "--overlap: not an option of --method wang"),
        (["--out", "a.quilt"], "a.quilt: expected a name that ends in .tiles"),
        (["--band", "5"], "wang.band: expected an even number of texels, got 5"),
    ],
)
def test_bad_tiles_are_one_sentence(arguments, text, picture, tmp_path):
    found = run("synthesize", picture, "--method", "wang", "--out", tmp_path / "a.tiles", *arguments)
    assert found.exit_code == 2 and text in found.output and len(found.output.splitlines()) == 1
    assert not (tmp_path / "a.tiles").exists()


@pytest.mark.errors
def test_bad_tilings_are_one_sentence(tiles, picture, rng, tmp_path):
    image.write_png(tmp_path / "other.png", looks.noise(8, 8, rng))
    for arguments, text in (
        (["--plane", "4by4"], "--plane: expected numbers like 256 or 400x300, got '4by4'"),
        (["--out", tmp_path / "b.png"], "expected a name that ends in .quilt"),
        (["--exemplar", picture], "expected a name that ends in .png"),
        (["--exemplar", tmp_path / "other.png", "--out", tmp_path / "b.png"], "expected the 28 x 24 texels"),
    ):
        found = run("tile", tiles, "--out", tmp_path / "b.quilt", *arguments)
        assert found.exit_code == 2 and text in found.output and len(found.output.splitlines()) == 1
    assert "--colours: not an option of --method quilting" in run(
        "synthesize", picture, "--colours", 3, "--out", tmp_path / "c.quilt"
    ).output  # fmt: skip
