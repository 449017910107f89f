import sys
from types import ModuleType, SimpleNamespace

import pytest
import torch

from torchmeso.errors import GeometryError
from torchmeso.geometry import quads
from torchmeso.geometry.quads import edges
from torchmeso.geometry.shapes import sphere


@pytest.fixture(scope="module")
def ball():
    body = sphere(triangles=2000)
    points, faces = torch.unique(body.vertices, dim=0, return_inverse=True)
    return points.double(), faces[body.faces]


def test_quads_of_a_ball_lie_on_it(ball):
    pytest.importorskip("pyQuadriFlow")
    from torchmeso.geometry import quadriflow

    coarse = quadriflow.quads_of(*ball, 60)
    around = edges(coarse.quads)
    assert bool((around.beside >= 0).all()) and not bool(around.along.any())
    found = quadriflow.onto(quads.patches(coarse, 6), *ball)
    radius = found.vertices.norm(dim=-1)
    assert float(radius.min()) > 0.97 and float(radius.max()) <= 1 + 1e-6
    assert bool((edges(found.faces).beside >= 0).all())


@pytest.mark.errors
def test_open_meshes_are_refused(ball):
    from torchmeso.geometry import quadriflow

    with pytest.raises(GeometryError, match="quadriflow: expected a closed mesh, got 3 edges at borders"):
        quadriflow.quads_of(ball[0], ball[1][1:], 60)


@pytest.mark.errors
def test_a_package_that_is_not_there_or_finds_nothing(ball, monkeypatch):
    from torchmeso.geometry import quadriflow

    monkeypatch.setitem(sys.modules, "pyQuadriFlow", ModuleType("pyQuadriFlow"))
    monkeypatch.setitem(sys.modules, "pyQuadriFlow.pyQuadriFlow", SimpleNamespace(pyquadriflow=lambda *_: {}["quads"]))
    with pytest.raises(GeometryError, match=r"expected about 60 quads, got none \('quads'\); ask for more"):
        quadriflow.quads_of(*ball, 60)
    monkeypatch.setitem(sys.modules, "pyQuadriFlow.pyQuadriFlow", None)
    with pytest.raises(GeometryError, match=r"expected the package pyquadriflow; install the extra: torchmeso\[mesh\]"):
        quadriflow.quads_of(*ball, 60)
