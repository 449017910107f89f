import pytest

from torchmeso.bench import frames
from torchmeso.geometry import hemisphere, shapes
from torchmeso.render.rasterize import rasterize
from torchmeso.render.scene import Material, Object, Scene


def test_table_2_has_the_papers_triangles_and_rates():
    rows = dict(frames.table_2())
    assert list(rows) == ["fig1", "fig12", "fig13", "fig14a", "fig14b", "fig14c"]
    for name, count in (("fig1", 11952), ("fig12", 3200), ("fig13", 11954), ("fig14a", 4276)):
        built = [o.build_shape() for o in rows[name].config.objects]
        assert abs(sum(len(m.faces) for m in built) - count) <= 0.01 * count, name
        assert rows[name].paper is not None


def test_table_2_has_the_papers_materials_at_table_1s_resolutions():
    expected = {"pipes": (64, 60), "brick": (64, 60), "peanut": (128, 96), "weave": (128, 96), "grass": (64, 96),
                "blocks": (64, 60)}  # fmt: skip
    found = {name: {} for name, _ in frames.table_2()}
    for name, timed in frames.table_2():
        for item in timed.config.materials.values():
            assert item.meso is not None
            found[name][item.meso.type] = (item.btf.texels, len(hemisphere.parse(item.btf.lights)))
            assert item.mdf.texels == item.btf.texels
            assert len(hemisphere.parse(item.mdf.views)) == len(hemisphere.parse(item.btf.views))
    assert {k: v for row in found.values() for k, v in row.items()} == expected
    assert [list(row) for row in found.values()] == [
        ["pipes"], ["weave", "peanut"], ["brick", "grass"], ["weave"], ["blocks"], ["brick"]
    ]  # fmt: skip


@pytest.mark.parametrize("coverage", [0.28, 0.5, 1.0])
def test_the_distance_sets_the_coverage(coverage, device):
    timed = frames.knot()
    scene = Scene(objects=(Object(mesh=shapes.torus_knot(triangles=2000), material=Material()),), lights=())
    camera = frames.camera_at(scene, timed, coverage, width=160, height=120)
    layers = rasterize(camera, scene.objects[0].mesh.vertices, scene.objects[0].mesh.faces)
    share = float((layers.start.diff() > 0).double().mean())
    assert abs(share - coverage) < (0.01 if coverage < 1 else 0.05)
