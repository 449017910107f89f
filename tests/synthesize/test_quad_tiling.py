import pytest
import torch

from tests.synthesize.test_tiling import tiles
from torchmeso.errors import GeometryError, ShapeError
from torchmeso.synthesize.quad_tiling import _edges, classes, lay, turns

CUBE = torch.tensor([[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]])


def grid(rows, columns, closed):
    """Quads of a torus, or of a sheet."""
    down, right = (rows, columns) if closed else (rows + 1, columns + 1)
    y, x = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")

    def vertex(y, x):
        return (y % down) * right + x % right

    return torch.stack([vertex(y, x), vertex(y, x + 1), vertex(y + 1, x + 1), vertex(y + 1, x)], -1).flatten(0, 1)


def shuffled(faces, rng):
    """The same quads, each begun at any of its vertices."""
    by = torch.randint(0, 4, (len(faces),), generator=rng)
    return faces.gather(1, (torch.arange(4) + by[:, None]) % 4)


def cube(n):
    """A cube of n x n quads a side."""
    corner = torch.tensor([[x, y, z] for z in (0, n) for x, y in ((0, 0), (n, 0), (n, n), (0, n))])
    found, number = [], {}
    for face in CUBE:
        a, b, _, d = corner[face]
        for i in range(n):
            for j in range(n):
                at = [a + (b - a) // n * (i + p) + (d - a) // n * (j + q) for p, q in ((0, 0), (1, 0), (1, 1), (0, 1))]
                found.append([number.setdefault(tuple(x.tolist()), len(number)) for x in at])
    return torch.tensor(found)


@pytest.mark.parametrize("closed", [False, True])
def test_sheets_and_tori_need_no_jump(closed, rng):
    faces = shuffled(grid(4, 5, closed), rng)
    found = lay(faces, tiles("edges"))
    assert len(found.jumps) == 0


def test_frames_on_a_cube_turn_somewhere_and_edges_are_listed_once(rng):
    for n in (1, 4):
        faces = shuffled(cube(n), rng)
        found = lay(faces, tiles("edges"))
        assert 0 < len(found.jumps) <= 8 * n  # of 12 n along the cube's edges
        assert set(found.jumps[:, 2].tolist()) <= {1, 2, 3}
        assert len({tuple(x) for x in found.jumps[:, :2].tolist()}) == len(found.jumps)


@pytest.mark.parametrize("kind", ["edges", "any", "corners"])
@pytest.mark.parametrize(
    "faces", [CUBE, cube(3), grid(4, 5, True), grid(3, 2, False)], ids=["cube", "27", "torus", "sheet"]
)
def test_colours_match_across_edges(kind, faces, rng):
    faces = shuffled(faces, rng)
    set_ = tiles(kind)
    found = lay(faces, set_, seed=3)
    _, beside = _edges(faces)
    colours = set_.colours.long()[found.tile]
    jumps = {(f, s) for f, s, _ in found.jumps.tolist()}
    for face, around in enumerate(beside.tolist()):
        for side, there in enumerate(around):
            if there < 0:
                continue
            other, its = divmod(there, 4)
            jump = (face, side) in jumps or (other, its) in jumps
            # Role of a side: south, east, north, west.
            role, its_role = (side - int(found.turn[face])) % 4, (its - int(found.turn[other])) % 4
            assert jump == ((role - its_role) % 4 != 2)
            if kind == "corners":
                nw, ne, se, sw = range(4)
                begin = (sw, se, ne, nw)  # each side's first corner, anticlockwise
                mine = colours[face, begin[role]], colours[face, begin[(role + 1) % 4]]
                theirs = colours[other, begin[its_role]], colours[other, begin[(its_role + 1) % 4]]
                assert mine == theirs[::-1]
            elif kind == "any" or not jump:
                own = (2, 1, 0, 3)  # among north, east, south, west
                assert colours[face, own[role]] == colours[other, own[its_role]]


@pytest.mark.parametrize(
    "faces", [CUBE, cube(3), grid(4, 5, True), grid(3, 3, False)], ids=["cube", "27", "torus", "sheet"]
)
def test_each_quad_has_two_sides_of_either_class(faces):
    edges, beside = _edges(faces)
    second = classes(edges, beside)
    assert (second.sum(1) == 2).all()
    inner = beside >= 0
    assert second[inner].equal(second.flatten()[beside[inner]])


def test_arrangements_are_the_same_for_sets_of_a_kind(rng):
    one, other = tiles("any"), tiles("any")
    assert lay(cube(2), one).tile.equal(lay(cube(2), other).tile)
    assert turns(_edges(cube(2))[1]).shape == (24,)


@pytest.mark.errors
def test_bad_meshes_are_named():
    with pytest.raises(ShapeError, match=r"faces: expected quads, whole numbers \(F, 4\), got \(2, 3\)"):
        lay(torch.zeros(2, 3, dtype=torch.long), tiles("edges"))
    with pytest.raises(ShapeError, match=r"expected four different vertices, got \[0, 1, 1, 2\] at face 0"):
        lay(torch.tensor([[0, 1, 1, 2]]), tiles("edges"))
    with pytest.raises(GeometryError, match="expected at most two at an edge, got more beside face 0"):
        lay(torch.tensor([[0, 1, 2, 3], [1, 0, 4, 5], [0, 1, 6, 7]]), tiles("edges"))
    with pytest.raises(ShapeError, match="got face 1 turned over; flip it"):
        lay(torch.tensor([[0, 1, 2, 3], [0, 1, 4, 5]]), tiles("edges"))
