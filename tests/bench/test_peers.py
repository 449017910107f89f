import shutil
import subprocess
import sys
from dataclasses import replace

import pytest
import torch

from torchmeso.bench import peers, scenes
from torchmeso.bench.peers import PeerMissing
from torchmeso.bench.timing import Timing
from torchmeso.geometry import shapes
from torchmeso.render.rasterize import rasterize


@pytest.fixture
def knot():
    return shapes.torus_knot(triangles=2000)


def test_llvmpipe_draws_the_same_pixels(knot):
    """A peer that draws something else is no peer: coverage agrees with our rasteriser."""
    try:
        peer = peers.Llvmpipe(scenes.knot_view(), knot.vertices, knot.faces)
    except PeerMissing as missing:
        pytest.skip(str(missing))
    layers = rasterize(scenes.knot_view(), knot.vertices, knot.faces)
    ours = float((layers.start.diff() > 0).double().mean())
    assert peer.coverage() == pytest.approx(ours, rel=2e-3)
    peer.peel(4)


@pytest.mark.parametrize("name", ["open3d", "embreex"])
def test_embree_sees_the_same_pixels(name, knot):
    peer = peers.Embree(knot.vertices, knot.faces, scenes.knot_view(), torch.tensor([0.0, 0.0, 1.0]))
    if f"{name} primary" not in peer.calls:
        pytest.skip(peer.missing)
    layers = rasterize(scenes.knot_view(), knot.vertices, knot.faces)
    ours = (layers.start.diff() > 0).numpy()
    assert ((peer.calls[f"{name} primary"]() < peers.MISSED) != ours).mean() < 1e-3
    _, shadow = peer.calls[f"{name} primary + shadow"]()
    assert len(shadow) == pytest.approx(ours.sum(), rel=1e-2)


def test_both_embrees_see_the_same_shadows(knot):
    peer = peers.Embree(knot.vertices, knot.faces, scenes.knot_view(), torch.tensor([0.0, 1.0, 0.0]))
    if peer.missing:
        pytest.skip(peer.missing)
    a, b = (peer.calls[f"{name} primary + shadow"]()[1] for name in ("open3d", "embreex"))
    assert 0.1 < a.mean() < 0.9
    assert (a != (b >= 0)).mean() < 1e-3


def test_the_faster_embree_counts(knot):
    """embreex runs on one core: its CPU time is shared out over all."""
    peer = peers.Embree(knot.vertices, knot.faces, scenes.knot_view(), torch.tensor([0.0, 0.0, 1.0]))
    timing = {
        "open3d primary": Timing(wall=30.0, low=28.0, high=40.0, cpu=29.0, n=9),
        "embreex primary": Timing(wall=48.0, low=44.0, high=60.0, cpu=24.0, n=9),
    }
    assert peer.faster(timing, "primary") == (24.0, 22.0, 30.0, 24.0, 9)
    assert peer.faster({"open3d primary": timing["open3d primary"]}, "primary") == timing["open3d primary"]


def test_missing_peer_is_said(knot, monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(PeerMissing, match="open3d"):
        peers.embree_first_hit(scenes.knot_view(), knot.vertices, knot.faces)
    one = peers.Embree(knot.vertices, knot.faces, scenes.knot_view(), torch.tensor([0.0, 0.0, 1.0]))
    assert "open3d" in one.missing
    assert set(one.calls) == {"embreex primary", "embreex primary + shadow"}
    monkeypatch.setitem(sys.modules, "embreex.rtcore_scene", None)
    with pytest.raises(PeerMissing, match=r"open3d .*; embreex"):
        peers.Embree(knot.vertices, knot.faces, scenes.knot_view(), torch.tensor([0.0, 0.0, 1.0]))


def test_a_compiler_that_is_missing_or_fails_is_said(monkeypatch):
    monkeypatch.setattr(shutil, "which", lambda name: None)
    with pytest.raises(PeerMissing, match=r"no C\+\+ compiler; install g\+\+"):
        peers.compiled_torch(n=1)
    monkeypatch.setattr(shutil, "which", lambda name: name)
    failed = subprocess.CompletedProcess([], -6, "", "first line\nwhat(): /a/b/c.cpp:7, index out of bounds\n")
    monkeypatch.setattr(subprocess, "run", lambda *a, **k: failed)
    with pytest.raises(PeerMissing, match=r"ended with status -6 \(what\(\): c.cpp:7, index out of bounds\)"):
        peers.compiled_torch(n=1)
    fine = subprocess.CompletedProcess([], 0, 'noise\n{"ms": [3.0, 2.0], "compiling": 40.5}\n', "")
    monkeypatch.setattr(subprocess, "run", lambda *a, **k: fine)
    assert peers.compiled_torch(n=2) == ([3.0, 2.0], 40.5)


def test_mitsuba_sees_the_same_pixels(knot):
    """In a process of its own; what is lit is what the light's direction says."""
    camera = replace(scenes.knot_view(), width=80, height=60)
    try:
        times = peers.mitsuba(knot.vertices, knot.faces, camera, torch.tensor([0.0, 0.0, 1.0]), n=2)
    except PeerMissing as missing:
        pytest.skip(str(missing))
    assert len(times) == 2
    assert min(times) > 0
