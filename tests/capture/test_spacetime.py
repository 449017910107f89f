import math

import pytest
import torch
from reference import spacetime as slow

from torchmeso.capture import laser_line, spacetime
from torchmeso.errors import ShapeError


def sweep(passes, n=40, sigma=1.6, peak=200.0):
    """Frames in which the laser passes each pixel at its time."""
    t = torch.arange(n, dtype=torch.float64)[:, None, None]
    return peak * torch.exp(-0.5 * ((t - passes) / sigma).square())


def times(rng, size=(12, 10)):
    return 5 + 30 * torch.rand(size, generator=rng, dtype=torch.float64)


def test_peaks_of_clean_frames_are_exact(rng):
    truth = times(rng)
    found = spacetime.laser_passage(sweep(truth), 30)
    assert found.valid.all()
    torch.testing.assert_close(found.time.double(), truth, rtol=0, atol=1e-5)


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
def test_the_stream_is_the_plain_loop(dtype, rng):
    frames = (sweep(times(rng), peak=300) + 9 * torch.rand(40, 12, 10, generator=rng)).clamp(max=255).to(dtype)
    found = spacetime.laser_passage(frames, 60)
    for y in range(12):
        for x in range(10):
            wanted = slow.peak_time(frames[:, y, x].tolist(), 60)
            assert bool(found.valid[y, x]) == (wanted is not None)
            if wanted is not None:
                assert found.time[y, x] == pytest.approx(wanted, abs=1e-4)


def test_pixels_never_or_twice_lit_are_masked(rng):
    frames = sweep(torch.tensor([[10.0, 20.0, 30.0]]))
    frames[:, 0, 1] = 5
    frames[:, 0, 2] += sweep(torch.tensor([[12.0]]), peak=90)[:, 0, 0]  # an interreflection
    found = spacetime.laser_passage(frames, 30)
    assert found.valid.tolist() == [[True, False, False]]
    assert found.passes.tolist() == [[1, 0, 2]]


def test_peaks_at_the_ends_are_masked():
    assert not spacetime.laser_passage(sweep(torch.tensor([[0.0, 39.0]])), 30).valid.any()


def test_shadows_are_found_by_the_plain_loop(rng):
    truth = times(rng)
    t = torch.arange(40, dtype=torch.float64)[:, None, None]
    frames = 120 - 80 * torch.sigmoid(2 * (t - truth)) + 2 * torch.rand(40, 12, 10, generator=rng)
    frames[:, 3, 4] = 50
    found = spacetime.shadow_passage(lambda: frames.float(), 20)
    assert not found.valid[3, 4]
    for y, x in found.valid.nonzero().tolist():
        wanted = slow.fall_time(frames[:, y, x].float().tolist(), 20)
        assert found.time[y, x] == pytest.approx(wanted, abs=1e-4)
        assert abs(found.time[y, x] - truth[y, x]) < 0.2


def test_an_edge_of_shadow_in_a_frame():
    x = torch.arange(20) + 0.5
    frame = (100 * torch.sigmoid(x - 7.3)).expand(4, 20)
    xy, found = spacetime.shadow_edge(frame, torch.full((4, 20), 50.0), torch.ones(4, 20, dtype=torch.bool))
    assert found.all()
    torch.testing.assert_close(xy[:, 0], torch.full((4,), 7.3), rtol=0, atol=0.02)


def parallel_rig(depth, n=60):
    """A camera looking down at `depth` (H, W) from height 100, planes at 45 degrees that move along x."""
    size = depth.shape
    y, x = torch.meshgrid(*(torch.arange(s, dtype=torch.float64) for s in size), indexing="ij")
    direction = torch.stack([0.01 * (x - 5), 0.01 * (y - 5), -torch.ones_like(x)], -1)
    direction = direction / direction.norm(dim=-1, keepdim=True)
    origin = torch.tensor([0.0, 0.0, 100.0], dtype=torch.float64)
    t = torch.arange(n, dtype=torch.float64)
    normal = torch.tensor([1.0, 0.0, 1.0], dtype=torch.float64) / math.sqrt(2)
    d = (-30 + t) / math.sqrt(2)
    planes = torch.cat([normal.expand(n, 3), d[:, None]], 1)
    point = origin + direction * ((-depth - 100) / direction[..., 2])[..., None]
    return origin, direction, planes, (point @ normal) * math.sqrt(2) + 30


def test_displacement_is_along_the_ray(rng):
    depth = 4 * torch.rand(12, 10, generator=rng, dtype=torch.float64)
    origin, direction, planes, passes = parallel_rig(depth)
    found = spacetime.displacement(spacetime.laser_passage(sweep(passes, 60), 30), planes, origin, direction, 0.0)
    assert found.valid.all()
    torch.testing.assert_close(found.distance.double(), depth / -direction[..., 2], rtol=0, atol=1e-4)
    assert found.sigma.min() > 0.5


def test_frames_without_a_plane_give_no_point(rng):
    depth = torch.ones(12, 10, dtype=torch.float64)
    origin, direction, planes, passes = parallel_rig(depth)
    planes[20:40] = torch.nan
    passage = spacetime.laser_passage(sweep(passes, 60), 30)
    found = spacetime.displacement(passage, planes, origin, direction, 0.0)
    inside = (passage.time > 19) & (passage.time < 40)
    assert inside.any() and not found.valid[inside].any() and found.valid[~inside].all()


def test_planes_hold_their_lines_and_the_source():
    def rays(xy):  # a camera above the table, one unit per pixel
        down = torch.cat([xy, torch.full_like(xy[..., :1], -100.0)], -1)
        return torch.tensor([0.0, 0.0, 100.0], dtype=torch.float64), down / down.norm(dim=-1, keepdim=True)

    line = torch.tensor([[1.0, 0.0, 7.0], [math.nan] * 3], dtype=torch.float64)
    source = torch.tensor([-50.0, 0.0, 57.0], dtype=torch.float64)
    normal = torch.tensor([1.0, 0.0, 1.0], dtype=torch.float64) / math.sqrt(2)
    fan = spacetime.planes_of_lines(line, rays, span=20, normal=normal, source=source)
    flat = spacetime.planes_of_lines(line, rays, span=20, normal=normal)
    wanted = torch.tensor([*normal.tolist(), 7 / math.sqrt(2)], dtype=torch.float64)
    torch.testing.assert_close(fan[0], wanted)
    torch.testing.assert_close(flat[0], wanted)
    assert fan[1].isnan().any() and flat[1, 3].isnan()


def test_albedo_edges_move_a_frames_peak_but_not_a_pixels():
    x = torch.arange(40, dtype=torch.float64) + 0.5
    albedo = torch.where(x < 20, 0.2, 1.0)
    t = torch.arange(80, dtype=torch.float64)
    frames = 200 * albedo * torch.exp(-0.5 * ((x - (t[:, None] * 0.5 + 0.2)) / 2).square())
    frames = frames[:, :, None].expand(-1, -1, 3).contiguous()  # moves along y
    found = spacetime.laser_passage(frames, 5)
    in_time = (found.time.double() - (x[:, None] - 0.2) / 0.5).abs() * 0.5
    search = laser_line.LineSearch(sigma=0.5, threshold=5)
    xy, _ = laser_line.peaks(frames, torch.ones(40, 3, dtype=torch.bool), search)
    in_frame = (xy[:, 0, 1] - (t * 0.5 + 0.2)).abs()
    near = slice(34, 44)
    assert in_time[17:23].max() <= 0.25 * in_frame[near].max()


@pytest.mark.errors
def test_too_few_and_unequal_frames_are_refused():
    with pytest.raises(ShapeError, match="at least 3, got 0"):
        spacetime.laser_passage([], 10)
    with pytest.raises(ShapeError, match="frame 1: expected"):
        spacetime.laser_passage([torch.zeros(3, 4), torch.zeros(4, 4)], 10)
    with pytest.raises(ShapeError, match="at least 2, got 1"):
        spacetime.extremes([torch.zeros(3, 4)])
