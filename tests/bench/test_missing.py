"""What benchmarks say where a peer or a plotter is not there."""

import shutil
import subprocess
import sys

import pytest
import torch

from torchmeso.bench import peers, plot, scenes
from torchmeso.bench.peers import PeerMissing
from torchmeso.bench.suite import Row
from torchmeso.errors import BackendError
from torchmeso.geometry import shapes


@pytest.mark.errors
def test_no_matplotlib(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    row = Row(id="a.b", what="x", value=1.0, unit="x", better="lower", curve={"series": "s", "x": 1})
    with pytest.raises(BackendError, match=r"expected matplotlib; install the extra: torchmeso\[report\]"):
        plot.draw([row], tmp_path / "a.png")
    assert not list(tmp_path.iterdir())


@pytest.mark.errors
def test_no_embree(monkeypatch):
    ball = shapes.sphere(triangles=100)
    for name in ("open3d", "embreex.rtcore_scene"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(PeerMissing, match=r"open3d .*; embreex "):
        peers.Embree(ball.vertices, ball.faces, scenes.knot_view(), torch.tensor([0.0, 0.0, 1.0]))
    with pytest.raises(PeerMissing, match="open3d"):
        peers.embree_first_hit(scenes.knot_view(), ball.vertices, ball.faces)


@pytest.mark.errors
def test_no_llvmpipe(monkeypatch):
    class Context:
        info = {"GL_RENDERER": "another"}  # noqa: RUF012

    class Moderngl:
        @staticmethod
        def create_context(**_):
            return Context

    make = peers._context.__wrapped__
    monkeypatch.setattr(peers, "import_module", lambda name: Moderngl)
    with pytest.raises(PeerMissing, match=r"llvmpipe \(OpenGL runs on another\)"):
        make()
    monkeypatch.undo()
    monkeypatch.setitem(sys.modules, "moderngl", None)
    with pytest.raises(PeerMissing, match=r"llvmpipe \(.*\); run tools/setup --peers"):
        make()


@pytest.mark.errors
def test_no_compiler(monkeypatch):
    monkeypatch.setattr(shutil, "which", lambda name: None)
    with pytest.raises(PeerMissing, match=r"no C\+\+ compiler; install g\+\+"):
        peers.compiled_torch(n=1)


@pytest.mark.errors
def test_no_mitsuba(monkeypatch):
    ball = shapes.sphere(triangles=100)
    failed = subprocess.CompletedProcess([], 1, "", "first\nNo module named 'mitsuba'\n")
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: failed)
    with pytest.raises(PeerMissing, match=r"Mitsuba \(No module named 'mitsuba'\); pip install"):
        peers.mitsuba(ball.vertices, ball.faces, scenes.knot_view(), torch.tensor([0.0, 0.0, 1.0]), n=1)
