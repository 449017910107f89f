from dataclasses import replace

import pytest
import torch

from torchmeso.bench import peers, scenes
from torchmeso.bench.peers import PeerMissing
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


def test_embree_sees_the_same_pixels(knot):
    try:
        first = peers.embree_first_hit(scenes.knot_view(), knot.vertices, knot.faces)
    except PeerMissing as missing:
        pytest.skip(str(missing))
    layers = rasterize(scenes.knot_view(), knot.vertices, knot.faces)
    t = torch.from_numpy(first()["t_hit"].numpy())
    ours = layers.start.diff() > 0
    assert (t.isfinite() != ours).float().mean() < 1e-3


def test_missing_peer_is_said(monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(PeerMissing, match="open3d"):
        peers.embree_first_hit(scenes.knot_view(), torch.zeros(3, 3), torch.zeros(1, 3, dtype=torch.long))


def test_mitsuba_sees_the_same_pixels(knot):
    """In a process of its own; what is lit is what the light's direction says."""
    camera = replace(scenes.knot_view(), width=80, height=60)
    try:
        times = peers.mitsuba(knot.vertices, knot.faces, camera, torch.tensor([0.0, 0.0, 1.0]), n=2)
    except PeerMissing as missing:
        pytest.skip(str(missing))
    assert len(times) == 2
    assert min(times) > 0
