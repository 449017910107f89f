import pytest
import torch
from click.testing import CliRunner

from tests.synthesize import looks
from tests.synthesize.test_parameterize import CORNERS, write
from tests.synthesize.test_quad_tiling import CUBE
from torchmeso import config
from torchmeso.cli import main
from torchmeso.data import image, tile_set, tiled_surface
from torchmeso.errors import ConfigError
from torchmeso.pipeline import bake, describe, scene, truth
from torchmeso.pipeline.render import Painter

TILES = {"size": 16, "band": 8, "patch": 8, "refine": 1, "candidates": 2, "kind": "any"}


def run(*arguments):
    return CliRunner().invoke(main, [*map(str, arguments)])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("dress")
    rng = torch.Generator().manual_seed(3)
    image.write_png(folder / "p.png", looks.noise(24, 28, rng))
    write(folder / "box.obj", CORNERS, CUBE.tolist())
    options = [x for name, value in TILES.items() for x in (f"--{name}", value)]
    found = run("synthesize", folder / "p.png", "--method", "wang", *options, "--out", folder / "a.tiles")
    assert found.exit_code == 0, found.output
    return folder


def settings(folder, material, body):
    return config.parse({
        "materials": {"m": {"albedo_map": "p.png", **material}},
        "objects": [{"mesh": "box.obj", "material": "m", "translate": [-0.5, -0.5, -0.5], **body}],
        "lights": [{"type": "directional", "direction": [1, 2, 3]}],
        "ambient": 0.3,
        "camera": {"eye": [1.2, 1.0, 2], "width": 64, "height": 48},
        "render": {"filtering": False, "shadows": False},
        "truth": {"samples": 1, "bounces": 0},
    }, folder=folder)  # fmt: skip


def painted(wanted, backend="torch"):
    built = scene.build(wanted, bake.prepare(wanted))
    return Painter(built, wanted.render, backend).paint(wanted.camera.build()).rgb.clone()


def test_a_surface_is_laid_out_and_shown(folder):
    out = folder / "box.surface"
    found = run(
        "tile", folder / "a.tiles", folder / "box.obj", "--split", 3, "--out", out, "--debug-pictures", folder / "d"
    )
    assert found.exit_code == 0 and "108 triangles in 54 quads" in found.output, found.output
    assert (folder / "d" / "surface.png").is_file()
    about = describe.file(out)
    assert about["kind"] == "tiled surface" and about["quads by"] == "quads" and about["made from"] == "box.obj"
    # The file, and the mesh laid out by the configuration, with the same tiles.
    one = painted(settings(folder, {"quilting": "a.tiles"}, {"mesh": "box.surface"}))
    other = painted(settings(folder, {"quilting": "a.tiles"}, {"surface": {"split": 3}}))
    assert one.equal(other) and len(one.reshape(-1, 3).unique(dim=0)) > 300


def test_both_backends_show_the_same(folder, device):
    wanted = settings(folder, {"wang": TILES}, {"surface": {"split": 2}})
    difference = (painted(wanted) - painted(wanted, "opencl")).abs().amax(-1)
    assert int((difference > 1 / 255).sum()) <= 4


def test_the_truth_has_the_same_tiles(folder):
    wanted = settings(folder, {"wang": TILES}, {"surface": {"split": 3}})
    error = (painted(wanted) - truth.render(wanted).rgb).abs().amax(-1)
    assert float((error > 0.02).float().mean()) < 0.02
    plain = settings(folder, {"quilting": "a.tiles"}, {"surface": {"split": 3, "seed": 1}})
    assert float((painted(wanted) - painted(plain)).abs().mean()) > 0.01


def test_re_dressing_is_another_set_for_the_same_surface(folder):
    surface = tiled_surface.load(folder / "box.surface")
    rng = torch.Generator().manual_seed(8)
    image.write_png(folder / "q.png", looks.noise(20, 20, rng))
    options = [x for name, value in TILES.items() for x in (f"--{name}", value)]
    assert run("synthesize", folder / "q.png", "--method", "wang", *options, "--out", folder / "b.tiles").exit_code == 0
    other = settings(folder, {"albedo_map": "q.png", "quilting": "b.tiles"}, {"mesh": "box.surface"})
    rgb = painted(other)
    assert rgb.isfinite().all() and not rgb.equal(
        painted(settings(folder, {"quilting": "a.tiles"}, {"mesh": "box.surface"}))
    )
    assert len(surface.jumps) > 0


@pytest.mark.errors
def test_bad_arguments_are_one_sentence(folder):
    for arguments, text in (
        ([folder / "box.obj", "--out", folder / "x.quilt"], "expected a name that ends in .surface"),
        ([folder / "none.obj", "--out", folder / "x.surface"], "expected a mesh file, found none"),
        ([folder / "box.obj", "--plane", "3x3", "--out", folder / "x.surface"], "--plane: belongs to a plane"),
        (["--by", "cube", "--out", folder / "x.quilt"], "--by: belongs to a MESH; leave it out"),
    ):
        found = run("tile", folder / "a.tiles", *arguments)
        assert found.exit_code == 2 and text in found.output and len(found.output.splitlines()) == 1
    for material, body, text in (
        ({"quilting": "a.tiles"}, {}, "material 'm' and its object must both be of tiles"),
        ({}, {"surface": {}}, "material 'm' and its object must both be of tiles"),
        ({"wang": TILES}, {"surface": {}, "tiles": 2}, "quads take the place of 'unwrap', 'tiles' and 'uv_set'"),
        ({"wang": TILES, "quilting": "a.tiles"}, {"surface": {}}, "'wang' cuts tiles from a BTF or an 'albedo_map'"),
    ):
        with pytest.raises(ConfigError, match=text.replace("(", "\\(")):
            settings(folder, material, body)


def test_features_and_corner_samples_by_hand_are_on_the_tiles(folder):
    """The same rectangle of the exemplar in the middle of every fourth tile, and corners where they were asked for."""
    corners = [[0, 0], [0, 12], [12, 0], [12, 12]]
    features = [{"on": "tile", "number": k, "at": [6, 6], "taken": [3, 4], "size": [4, 5]} for k in range(0, 96, 4)]
    image.write_png(folder / "mask.png", torch.ones(2, 2, 3))
    on_edge = {"on": "horizontal", "number": 1, "at": [3, 7], "taken": [10, 10], "mask": "mask.png"}
    wanted = settings(
        folder, {"wang": {**TILES, "corners": corners, "features": [*features, on_edge]}}, {"surface": {}}
    )
    shown = bake.prepare(wanted)["m"].tiles.shown()
    rows, columns = torch.meshgrid(torch.arange(3, 7), torch.arange(4, 9), indexing="ij")
    assert bool((shown[::4, 6:10, 6:11] == rows * 28 + columns).all())
    # An edge's lower half is the upper half of the tiles below it; a feature across it is on tiles above and below.
    north = tile_set_colours(folder)[:, 0] == 1
    assert bool((shown[north][:, 0, 7:9] == torch.tensor([11 * 28 + 10, 11 * 28 + 11])).all())
    # The right half of the corner sample's lower half is where tiles begin.
    assert bool((shown[:, 0, 1:3] >= 0).all())


def tile_set_colours(folder):
    return tile_set.load(folder / "a.tiles").colours


@pytest.mark.errors
def test_features_without_room_are_one_sentence(folder):
    base = {"on": "tile", "number": 0, "at": [6, 6], "taken": [3, 4]}
    for feature, text in (
        ({**base, "size": [4, 40]}, "feature: expected to find room on tile 0"),
        ({**base, "at": [0, 6], "size": [2, 2]}, "feature: expected to find room on tile 0"),
        ({**base, "taken": [22, 4], "size": [4, 4]}, "feature: expected texels of the exemplar, 28 x 24"),
        ({**base, "number": 96, "size": [2, 2]}, "feature: expected some texels on one of"),
    ):
        with pytest.raises(ConfigError, match=text):
            bake.prepare(settings(folder, {"wang": {**TILES, "features": [feature]}}, {"surface": {}}))
    with pytest.raises(ConfigError, match=r"expected exactly one of 'size' .* and 'mask'"):
        settings(folder, {"wang": {**TILES, "features": [base]}}, {"surface": {}})
    with pytest.raises(ConfigError, match=r"wang\.corners: expected 4 places"):
        bake.prepare(settings(folder, {"wang": {**TILES, "corners": [[0, 0]]}}, {"surface": {}}))
