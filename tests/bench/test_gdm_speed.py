import pytest
import torch

from torchmeso.bench import gdm_speed
from torchmeso.bench.suite import Context
from torchmeso.geometry import shapes, shell
from torchmeso.geometry.directions import normalize
from torchmeso.render.device_trace import DeviceTrace


@pytest.mark.parametrize("kind", ["faces", "edges", "vertices", "fins", "grazing"])
def test_rays_come_in_as_their_kind_says(kind, rng):
    mesh = shapes.torus(triangles=200, tiles=(6, 2))
    built = shell.build(mesh, 0.2)
    entries = gdm_speed.random_entries(built, 2000, kind, rng)
    torch.testing.assert_close(entries.direction.norm(dim=1), torch.ones(2000, dtype=torch.float64))
    face = built.vertices[built.tets[entries.tet].gather(1, shell.OUTWARD[entries.corner])]
    normal = normalize(torch.linalg.cross(face[:, 1] - face[:, 0], face[:, 2] - face[:, 0]))
    slope = (entries.direction * normal).sum(1)
    assert (slope <= 1e-9).all()
    if kind == "grazing":
        assert (slope > -0.002).all()
    found = DeviceTrace(built, mesh, None, floor=False).trace(entries)
    assert (found.prisms >= 0).all()


def test_rows_of_the_figure_have_its_triangles():
    for name, count in (("teapot", 4276), ("vase", 8640), ("torus", 4880), ("bird", 11603), ("dinosaur", 2142)):
        assert len(gdm_speed.rows_7()[name].mesh.faces) == pytest.approx(count, rel=0.03)


@pytest.mark.slow
def test_no_ray_is_lost():
    rows = {row.id: row.value for row in gdm_speed.leaks(Context(quick=True))}
    assert rows == {"leaks.lost": 0, "leaks.endless": 0}
