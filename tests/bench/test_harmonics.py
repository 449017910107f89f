import pytest
import torch

from torchmeso.algebra import spherical_harmonics
from torchmeso.bench import harmonics
from torchmeso.bench.suite import Context


def test_the_definition_is_the_basis():
    w = harmonics._directions(3, torch.float64)
    y = spherical_harmonics.basis(w, 4)
    for i in range(3):
        for m in range(-4, 5):
            assert harmonics.by_definition(w[i].tolist(), 4, m) == pytest.approx(float(y[i, 20 + m]), abs=1e-14)


def test_rotations_are_sound(device, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "e3nn", None)  # slow to import; its row says that it is missing
    rows = {row.id: row for row in harmonics.rotation(Context(quick=True))}
    assert rows["compress.rotation.orthogonal"].met
    assert rows["compress.rotation.composed"].met
    assert rows["compress.rotation.vs_e3nn"].why == "e3nn is not installed (tools/setup --peers)"


def test_a_missing_peer_is_said(device, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "sphericart.torch", None)
    monkeypatch.setattr(harmonics, "_error", lambda degree, dtype: 0.0)
    first = next(iter(harmonics.basis(Context(quick=True))))
    assert first.value is None
    assert "sphericart-torch is not installed" in first.why
