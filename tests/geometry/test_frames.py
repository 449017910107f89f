import torch

from tests.tolerances import FLOAT64
from torchmeso.geometry import frames
from torchmeso.geometry.directions import dot, normalize


def some_frames(rng, n=200):
    sign = torch.where(torch.rand(n, generator=rng, dtype=torch.float64) < 0.5, -1.0, 1.0).double()
    return frames.orthonormal(*torch.randn(2, n, 3, dtype=torch.float64, generator=rng), sign), sign


def test_frames_are_orthonormal_with_the_asked_handedness(rng):
    frame, sign = some_frames(rng)
    basis = torch.stack(frame, -2)
    torch.testing.assert_close(basis @ basis.mT, torch.eye(3, dtype=torch.float64).expand(200, 3, 3), **FLOAT64)
    torch.testing.assert_close(torch.linalg.det(basis), sign, **FLOAT64)


def test_local_and_world_invert_each_other(rng):
    frame, _ = some_frames(rng)
    w = torch.randn(200, 3, dtype=torch.float64, generator=rng)
    torch.testing.assert_close(frames.to_world(frame, frames.to_local(frame, w)), w, **FLOAT64)


def test_normal_is_local_z(rng):
    frame, _ = some_frames(rng)
    z = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(200, 3)
    torch.testing.assert_close(frames.to_local(frame, frame.n), z, **FLOAT64)


def test_degenerate_tangents_get_some_perpendicular():
    n = normalize(torch.tensor([[1.0, 2.0, 3.0], [0.0, 0.0, 1.0]], dtype=torch.float64))
    t = torch.stack([torch.zeros(3, dtype=torch.float64), 5 * n[1]])
    frame = frames.orthonormal(n, t, torch.ones(2, dtype=torch.float64))
    assert dot(frame.t, frame.n).abs().max() < 1e-12
    assert (dot(frame.t, frame.t) - 1).abs().max() < 1e-12


def test_around_is_right_handed():
    n = normalize(torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [-1.0, 2.0, 0.5]], dtype=torch.float64))
    frame = frames.around(n)
    torch.testing.assert_close(torch.linalg.cross(frame.t, frame.b), frame.n, **FLOAT64)
