import pytest
import torch

from tests.synthesize import looks
from torchmeso.synthesize import patch_error
from torchmeso.synthesize.filling import (
    Filler,
    Parts,
    _cramped,
    _emptiest,
    _sides,
    box_sums,
    place,
    seam_costs,
    seam_errors,
)
from torchmeso.synthesize.patch_error import Search
from torchmeso.synthesize.seam_graphcut import FREE, NEW, OLD, STEPS


@pytest.fixture
def source(rng):
    return patch_error.exemplar(looks.noise(24, 20, rng))


def filler(source, rng, backend="torch", **more):
    dials = {"patch": 8, "candidates": 4, "refine": 6, "calm": 0} | more
    search = Search(source)
    return Filler(search=search, parts=Parts(search, dials["patch"]), rng=rng, backend=backend, **dials)


def with_frame(source, side=16, band=3):
    """A frame of two places of the exemplar that do not match, empty inside."""
    index = place(source, torch.tensor([0]), torch.tensor([0]), side, side)[0].clone()
    index[:, side // 2 :] = place(source, torch.tensor([5]), torch.tensor([2]), side, side)[0][:, side // 2 :]
    index[band:-band, band:-band] = -1
    return index, torch.zeros_like(index, dtype=torch.bool)


def test_everything_is_filled_and_what_is_held_stays(source, rng):
    index, held = with_frame(source)
    held[0] = held[-1] = held[:, 0] = held[:, -1] = True
    held[7, 8] = True
    index[7, 8] = 123
    before = index.clone()
    found = filler(source, rng).fill(index, held)
    assert index.equal(before)
    assert int(found.min()) >= 0 and int(found.max()) < 24 * 20
    assert found[held].equal(index[held])


def test_an_area_that_one_patch_continues_is_filled_without_a_seam(source, rng):
    index = place(source, torch.tensor([2]), torch.tensor([3]), 12, 12)[0]
    hole = index.clone()
    hole[4:8, 4:8] = -1
    found = filler(source, rng, candidates=64).fill(hole, torch.zeros_like(hole, dtype=torch.bool))
    assert found.equal(index)


def test_more_patches_only_ever_lower_what_seams_cost(source):
    index, held = with_frame(source)
    costs = []
    for refine in (0, 4, 30):
        rng = torch.Generator().manual_seed(1)
        found = filler(source, rng, refine=refine).fill(index, held)
        costs.append(int(seam_errors(source, found, toroidal=False).sum()))
    assert costs[0] >= costs[1] >= costs[2] and costs[2] < costs[0]


def test_both_backends_fill_the_same_way(source, device):
    index, held = with_frame(source)
    one, other = (
        filler(source, torch.Generator().manual_seed(3), backend).fill(index, held) for backend in ("torch", "opencl")
    )
    assert one.equal(other)


def test_a_seam_costs_what_both_patches_differ_beside_it(source):
    codes = source.codes.flatten(0, 1).double()
    a, b = torch.tensor([5 * 20 + 4]), torch.tensor([9 * 20 + 11])
    expected = STEPS * ((codes[a] - codes[b - 1]).norm() + (codes[a + 1] - codes[b]).norm())
    assert abs(int(seam_costs(source, a, b, 1, toroidal=False)) - float(expected)) <= 1
    assert int(seam_costs(source, a, a + 1, 1, toroidal=False)) == 0
    assert int(seam_costs(source, a, a + 20, 0, toroidal=False)) == 0
    assert int(seam_costs(source, a, torch.tensor([-1]), 0, toroidal=False)) == 0
    last, first = torch.tensor([19]), torch.tensor([0])
    assert (
        int(seam_costs(source, last, first, 1, toroidal=True))
        == 0
        < int(seam_costs(source, last, first, 1, toroidal=False))
    )


def test_errors_are_shared_by_both_sides_of_a_seam(source):
    index = place(source, torch.tensor([1]), torch.tensor([1]), 6, 6)[0].clone()
    assert not seam_errors(source, index, toroidal=False).any()
    index[:, 3:] = place(source, torch.tensor([9]), torch.tensor([7]), 6, 3)[0]
    found = seam_errors(source, index, toroidal=False)
    assert (found[:, 2:4] > 0).all() and not found[:, :2].any() and not found[:, 4:].any()
    assert found[:, 2].equal(found[:, 3])


def test_what_borders_on_filled_texels_outside_stays():
    index = torch.zeros(6, 6, dtype=torch.long)
    index[3:, 3:] = -1
    held = torch.zeros_like(index, dtype=torch.bool)
    held[2, 2] = True
    found = _sides(index, held, 1, 1, 4)
    expected = torch.tensor([
        [OLD, OLD, OLD, OLD],
        [OLD, OLD, FREE, OLD],
        [OLD, FREE, NEW, NEW],
        [OLD, OLD, NEW, NEW],
    ])  # fmt: skip
    assert found.equal(expected)


def test_windows_leave_room_for_cuts():
    empty = torch.zeros(16, 16, dtype=torch.bool)
    empty[4:12, 4:12] = True
    assert not _cramped(empty, 8)[0, 0].any()
    cramped = _cramped(empty, 8)
    for y in range(9):
        for x in range(9):
            window = empty[y : y + 8, x : x + 8]
            count = 0
            for row in range(8):  # to the right and to the left
                if x + 8 < 16:
                    count += sum(bool(window[row, k] and not empty[y + row, x + k + 1]) for k in (6, 7))
                if x > 0:
                    count += sum(bool(window[row, k] and not empty[y + row, x + k - 1]) for k in (0, 1))
                if y + 8 < 16:
                    count += sum(bool(window[k, row] and not empty[y + k + 1, x + row]) for k in (6, 7))
                if y > 0:
                    count += sum(bool(window[k, row] and not empty[y + k - 1, x + row]) for k in (0, 1))
            assert int(cramped[y, x]) == count
    empty = torch.zeros(16, 16, dtype=torch.bool)
    empty[6:10, 6:10] = True
    assert _emptiest(empty, 12) == (1, 1)  # all of it, and three texels around


def test_box_sums_are_sums_over_windows(rng):
    x = torch.randint(0, 9, (5, 7), generator=rng)
    assert box_sums(x, 3).equal(x.unfold(0, 3, 1).unfold(1, 3, 1).sum((-1, -2)))


@pytest.mark.parametrize("size", [(60, 47), (60, 9)])
def test_a_large_exemplar_is_searched_in_parts_that_hold_every_placement(size, rng):
    source, patch = patch_error.exemplar(looks.noise(*size, rng)), 8
    whole = Search(source)
    parts = Parts(whole, patch)
    target, mask = source.codes[:patch, :patch], torch.ones(patch, patch, dtype=torch.bool)
    errors, seen = whole.errors(target, mask), torch.zeros(whole.placements(patch, patch), dtype=torch.bool)
    for _ in range(200):
        row, column, search = parts.draw(rng)
        found = search.errors(target, mask)
        at = slice(row, row + found.shape[0]), slice(column, column + found.shape[1])
        assert found.equal(errors[at]) and found.numel() < errors.numel()
        seen[at] = True
    assert seen.all()


def test_a_small_exemplar_is_one_part(rng):
    whole = Search(patch_error.exemplar(looks.noise(40, 39, rng)), toroidal=True)
    assert Parts(whole, 8).draw(rng) == (0, 0, whole)
