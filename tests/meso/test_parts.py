import math

import torch

from torchmeso.meso import parts


def area(piece):
    a, b, c = piece[0][piece[1]].double().unbind(1)
    return float(torch.linalg.cross(b - a, c - a).norm(dim=-1).sum()) / 2


def volume(piece):
    a, b, c = piece[0][piece[1]].double().unbind(1)
    return abs(float((a * torch.linalg.cross(b, c)).sum())) / 6


def test_areas_and_volumes():
    assert math.isclose(area(parts.rectangle(0.1, 0.4, 0.2, 0.9, -0.1)), 0.21, rel_tol=1e-5)
    box = parts.frustum((0.0, 0.5, 0.0, 0.25), 0.0, -0.2, 0.0)
    assert math.isclose(area(box), 0.125 + 2 * 0.75 * 0.2, rel_tol=1e-5)
    ball = parts.ellipsoid(0.3, 128)
    assert math.isclose(volume(ball), 4 / 3 * math.pi * 0.3**3, rel_tol=3e-3)
    around = parts.turn(96)
    bar = parts.straight(0.1 * torch.stack([around.cos(), around.sin()], -1), 1)
    assert math.isclose(area(bar), 2 * math.pi * 0.1, rel_tol=1e-3)
    assert (bar[0][:, 1].min(), bar[0][:, 1].max()) == (0, 1)


def test_shades_stay_within_their_spread(rng):
    tints = torch.tensor(parts.shades((0.4, 0.2, 0.9), 0.25, 500, rng))
    factor = tints[:, 0] / 0.4
    assert 0.75 <= float(factor.min()) < 0.8
    assert 1.2 < float(factor.max()) <= 1.25
    assert float(tints.max()) <= 1
