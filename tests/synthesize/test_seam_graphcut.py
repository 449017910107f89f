import numpy as np
import pytest
import torch

from tests.reference import seam_graphcut as reference
from torchmeso.bench import graphcut
from torchmeso.errors import ShapeError
from torchmeso.synthesize.seam_graphcut import ABSENT, FREE, MOST, NEW, OLD, cut, differences, gaps


def strip(height, width):
    side = torch.full((height, width), FREE)
    side[:, 0], side[:, -1] = OLD, NEW
    return side


def corner(height, width, arm=3):
    """An L: old above and on the left, new where nothing lies yet."""
    side = torch.full((height, width), FREE)
    side[arm:, arm:] = NEW
    side[0], side[:, 0] = OLD, OLD
    return side


def ring(height, width):
    side = torch.full((height, width), FREE)
    side[0] = side[-1] = OLD
    side[:, 0] = side[:, -1] = OLD
    side[height // 2, width // 2] = NEW
    return side


def holed(height, width):
    side = strip(height, width)
    side[1 : height - 1, width // 2] = ABSENT
    return side


def island(height, width):
    side = strip(height, width)
    side[height // 2, width // 2] = OLD  # locked by hand
    return side


SHAPES = (strip, corner, ring, holed, island)


def costs(batch, side, rng, most=20):
    return torch.randint(0, most, (batch, *side.shape), generator=rng)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("kept", [False, True])
def test_no_cut_is_cheaper_and_none_as_cheap_keeps_less(shape, kept, rng):
    side = corner(5, 5, arm=2) if shape is corner else shape(4, 5) if shape is holed else shape(4, 4)
    e = costs(2, side, rng, most=4)
    errors = torch.randint(0, 6, side.shape, generator=rng) * kept
    found = cut(e, side, errors=errors)
    for k in range(len(e)):
        best, least = reference.exhaustive(e[k], side, errors)
        assert int(found.cost[k]) == best
        assert found.old[k].equal(least)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("kept", [False, True])
@pytest.mark.parametrize("most", [2, 30, MOST])
def test_flow_and_cut_are_the_same_on_both_backends(shape, kept, most, rng, device):
    side = shape(11, 9)
    e = costs(5, side, rng, most)
    errors = torch.randint(0, 2 * most, side.shape, generator=rng) * (torch.rand(side.shape, generator=rng) < 0.3)
    errors = errors * kept
    slow, fast = (cut(e, side, errors=errors, backend=backend) for backend in ("torch", "opencl"))
    for k in range(len(e)):
        value, reached = reference.flow(e[k], side, errors)
        assert value == int(slow.cost[k]) == int(fast.cost[k])
        assert value == reference.cost(e[k], side, errors, slow.old[k])
        assert reached == {tuple(p) for p in slow.old[k].nonzero().tolist()}
        assert fast.old[k].equal(slow.old[k])


def test_any_shape_at_all(rng, device):
    """Sides drawn at random: some cuts are one path, most are not."""
    paths = 0
    for _ in range(150):
        height, width = (int(n) for n in torch.randint(1, 7, (2,), generator=rng))
        share = torch.tensor([4.0, 1.0, 1.0, 1.0])
        side = torch.multinomial(share, height * width, replacement=True, generator=rng).reshape(height, width)
        e = costs(2, side, rng, most=9)
        errors = torch.zeros_like(side)
        fast = cut(e, side, errors=errors, backend="opencl")
        paths += gaps(side) is not None
        for k in range(len(e)):
            value, reached = reference.flow(e[k], side, errors)
            assert int(fast.cost[k]) == value
            assert {tuple(p) for p in fast.old[k].nonzero().tolist()} == reached
    assert paths > 20


def test_a_cut_is_one_path_where_both_sides_meet_the_border():
    assert gaps(strip(4, 5)) == (1, 4 * 6 + 4)  # beside the old column above, beside the new one below
    assert gaps(corner(6, 6)) is not None
    assert gaps(holed(6, 7)) is not None
    assert gaps(ring(5, 5)) is None
    assert gaps(island(5, 5)) is None
    assert gaps(torch.full((3, 3), FREE)) is None


def test_an_old_seam_is_covered_where_that_pays(device):
    side = strip(6, 8)
    e = torch.full((1, 6, 8), 10)
    e[..., 2] = e[..., 3] = 0  # the cheapest place to cut
    assert int(cut(e, side).old.sum()) == 6 * 3
    errors = torch.zeros(6, 8, dtype=torch.int64)
    errors[:, 1] = 25  # more than what cutting before it costs
    for backend in ("torch", "opencl"):
        found = cut(e, side, errors=errors, backend=backend)
        assert int(found.old.sum()) == 6 and int(found.cost) == 6 * 20


def test_equal_sides_are_cut_for_nothing(device):
    for shape in SHAPES:
        side = shape(6, 7)
        e = torch.zeros(1, *side.shape, dtype=torch.int64)
        for backend in ("torch", "opencl"):
            found = cut(e, side, backend=backend)
            assert int(found.cost) == 0 and found.old[0].equal(side == OLD)


def test_what_is_held_to_nothing_stays(device):
    side = torch.full((3, 4), FREE)
    side[1, 1] = OLD
    e = torch.ones(1, 3, 4, dtype=torch.int64)
    for backend in ("torch", "opencl"):
        found = cut(e, side, backend=backend)
        assert int(found.cost) == 0 and found.old.all()
        assert not cut(e, torch.full((3, 4), FREE), backend=backend).old.any()
        assert len(cut(e[:0], side, backend=backend).cost) == 0


def test_costs_are_lengths_of_differences(rng):
    a, b = (torch.randint(0, 4096, (3, 4, 5), generator=rng) for _ in range(2))
    exact = 256 * np.linalg.norm((a - b).numpy().astype(float), axis=-1)
    assert np.abs(differences(a, b).numpy() - exact).max() <= 0.5


def test_ortools_finds_the_same_value(rng, device):
    pytest.importorskip("ortools")
    for shape, kept in ((strip, False), (corner, False), (ring, True), (strip, True)):
        side = shape(48, 40)
        e = costs(1, side, rng, MOST)
        errors = torch.randint(0, MOST, side.shape, generator=rng) * kept
        assert int(cut(e, side, errors=errors, backend="opencl").cost) == graphcut.by_ortools(e[0], side, errors)


@pytest.mark.errors
def test_bad_input_is_named():
    e, side = torch.zeros(1, 4, 4, dtype=torch.int64), strip(4, 4)
    with pytest.raises(ShapeError, match=r"e: expected shape"):
        cut(e[0], side)
    with pytest.raises(ShapeError, match=r"side: expected shape"):
        cut(e, side[1:])
    with pytest.raises(ShapeError, match="e: expected whole numbers"):
        cut(e.float(), side)
    with pytest.raises(ShapeError, match="side: expected numbers from 0 to 3, got 2 to 4"):
        cut(e, side + 2)
    with pytest.raises(ShapeError, match="errors: expected numbers from 0"):
        cut(e, side, errors=torch.full((4, 4), -1))
    with pytest.raises(ShapeError, match="e: expected 1 to about"):
        cut(e[:, :, :0], side[:, :0])
