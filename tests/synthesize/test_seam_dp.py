import pytest
import torch

from tests.reference import seam_dp as reference
from torchmeso.errors import ConfigError, ShapeError
from torchmeso.synthesize.seam_dp import cut, shown

CASES = [(5, 4, 4, 0), (5, 4, 2, 0), (4, 6, 0, 3), (5, 5, 2, 2), (5, 6, 3, 2), (4, 4, 4, 4), (1, 5, 3, 1), (6, 1, 1, 2)]


def costs(batch, height, width, rng, most=20):
    return torch.randint(0, most, (batch, height, width), generator=rng)


def along(e, seam, left, top):
    """Cost of each seam, texel by texel; the knee belongs to both parts and counts once."""
    found = []
    for b in range(len(e)):
        column, row = seam.column[b].tolist(), seam.row[b].tolist()
        start = 0
        if left and top:
            start = next(k for k in range(len(e[b])) if column[k] == k and row[k] == k and column[0] == row[0] == k)
        of = {(y, x) for y, x in enumerate(column) if left and y >= start}
        of |= {(y, x) for x, y in enumerate(row) if top and x >= start}
        found.append(sum(int(e[b, y, x]) for y, x in of))
    return found


@pytest.mark.parametrize(("height", "width", "left", "top"), CASES)
def test_no_path_is_cheaper(height, width, left, top, rng):
    e = costs(12, height, width, rng)
    seam = cut(e, left=left, top=top)
    for b in range(len(e)):
        if left and top:
            expected = reference.corner(e[b], left, top)
        else:
            expected = reference.straight(e[b, :, :left] if left else e[b, :top].T)
        assert int(seam.cost[b]) == expected
    for b, cost in enumerate(along(e, seam, left, top)):
        assert cost <= int(seam.cost[b])  # where both parts of an L share a texel it counts once


def test_steps_go_straight_or_to_either_side(rng):
    e = costs(50, 16, 14, rng, most=3)
    seam = cut(e, left=5, top=6)
    assert seam.column.diff(dim=1).abs().max() <= 1 and seam.row.diff(dim=1).abs().max() <= 1
    assert seam.column.max() < 5 and seam.row.max() < 6


def test_the_least_index_wins_a_tie():
    seam = cut(torch.zeros(1, 6, 6, dtype=torch.int64), left=3, top=3)
    assert not seam.column.any() and not seam.row.any()


@pytest.mark.parametrize(("left", "top"), [(5, 0), (0, 4), (5, 4), (13, 9)])
@pytest.mark.parametrize("most", [2, 1 << 40])
def test_opencl_finds_the_same_seams(left, top, most, rng, device):
    e = costs(33, 9, 13, rng, most)
    for a, b in zip(cut(e, left=left, top=top), cut(e, left=left, top=top, backend="opencl"), strict=True):
        assert a.equal(b)
    assert len(cut(e[:0], left=left, top=top, backend="opencl").cost) == 0


def test_a_patch_shows_between_its_seams():
    e = torch.full((8, 8), 9)
    e[:, 2] = e[2, :] = e[:, 6] = 0
    e[:2, 6] = 3
    e[2, 5] = e[2, 7] = 1  # no ties
    found = shown(e, left=3, top=3, right=3)
    inside = torch.zeros(8, 8, dtype=torch.bool)
    inside[2:, 2:7] = True
    assert found.equal(inside)
    assert shown(e.flip(0, 1), right=3, bottom=3, left=3).equal(inside.flip(0, 1))
    assert shown(e).all()


@pytest.mark.errors
def test_bad_input_is_named():
    e = torch.zeros(1, 4, 4, dtype=torch.int64)
    with pytest.raises(ShapeError, match=r"e: expected shape \(any, any, any\)"):
        cut(e[0], left=2)
    with pytest.raises(ShapeError, match="expected whole numbers"):
        cut(e.float(), left=2)
    with pytest.raises(ConfigError, match="expected an overlap within 4 x 4 texels, got 5 and 0"):
        cut(e, left=5)
    with pytest.raises(ConfigError, match="got 0 and 0"):
        cut(e)
