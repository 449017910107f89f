"""Wang tiles on meshes of quads: which tile lies on each quad, and how it is turned.

leung2007tileable, section 4.1. A BTF has an orientation, so tiles are laid with north to north: neighbours agree where
one's east is the other's west. On most closed surfaces no choice of north agrees everywhere; sides across which frames
turn by 90, 180 or 270 degrees are listed (`jumps`). `turns` grows the frames from quad to quad and then turns single
quads while that leaves fewer jumps; it does not promise the fewest.

Colours of sides are hashes of the edge's number, the same on both quads. In sets of coloured sides an edge across which
frames turn joins sides of different kinds: there each quad has a colour of its own. In the set for any topology all
sides share four colours, two of either class, and each quad needs two sides of either (`classes`): every other edge of
an Euler circuit of the dual, in which each quad has four neighbours, gives just that.

An arrangement depends on the kind of set alone: another set of its kind dresses the surface by a look-up.

Test: tests/synthesize/test_quad_tiling.py
"""

from typing import NamedTuple

import torch
from jaxtyping import Int
from torch import Tensor

from torchmeso.data.tile_set import TileSet
from torchmeso.data.tiled_surface import TiledSurface
from torchmeso.errors import ShapeError
from torchmeso.geometry import quads
from torchmeso.geometry.quads import Patches
from torchmeso.synthesize.tiling import alphabet, hashed

SIDES = 4
"""South, east, north and west of a quad that is not turned: from its first vertex on, anticlockwise."""

ORDER = (2, 1, 0, 3)
"""Where north, east, south and west, the order of a tile's colours, stand among these."""

STARTS = 8
"""Quads that frames are grown from, one after the other."""

ROUNDS = 32
"""Most times that all quads are looked at for a better turn."""


class Tiling(NamedTuple):
    """Tiles on a mesh.

    Attributes:
        tile: (F,) number in the set.
        turn: (F,) the side, counted from the first vertex's, that is the tile's south.
        jumps: (n, 3) face, side, and quarter turns anticlockwise of the neighbour's frame, where they are not none.
    """

    tile: Int[Tensor, "F"]
    turn: Int[Tensor, "F"]
    jumps: Int[Tensor, "n 3"]


def lay(faces: Int[Tensor, "F 4"], tiles: TileSet, *, seed: int = 0) -> Tiling:
    """Return a tiling of a mesh of quads.

    Args:
        faces: vertices of each quad, anticlockwise as seen from outside.
        tiles: a set with every combination of colours that the mesh asks for.
        seed: of the hash.

    Raises:
        ShapeError: a face is no quad, or turned over.
        GeometryError: an edge has more than two faces.
        ConfigError: the set lacks a combination.
    """
    edges, beside = _edges(faces)
    turn = turns(beside)
    # Side of each face that lies in the south, east, north, west.
    at = (torch.arange(SIDES) + turn[:, None]) % SIDES
    letters = alphabet(tiles)
    if tiles.marks == "corners":
        # North-west begins the west side, north-east the north side, and so on.
        corner = faces.gather(1, at[:, [3, 2, 1, 0]])
        colours = _drawn(corner, torch.zeros_like(corner), 0, letters.across, seed)
    elif (
        set(letters.across) == set(letters.down)
        or len(tiles.colours) == len(letters.across) ** 2 * len(letters.down) ** 2
    ):
        own = edges.gather(1, at)
        jumped = _quarter(beside, turn).gather(1, at) != 0
        owner = torch.where(jumped, torch.arange(len(faces))[:, None] + 1, 0)
        sides = [
            _drawn(own[:, k], owner[:, k], k % 2, letters.down if k % 2 else letters.across, seed) for k in range(4)
        ]
        colours = torch.stack(sides, 1)[:, list(ORDER)]
    else:
        second = classes(edges, beside)
        one, other = (_drawn(edges, torch.zeros_like(edges), k, x, seed) for k, x in enumerate(letters))
        colours = torch.where(second, other, one).gather(1, at)[:, list(ORDER)]
    return Tiling(tiles.find(colours), turn, _jumps(beside, turn))


def arrange(patches: Patches, tiles: TileSet, *, seed: int = 0) -> TiledSurface:
    """Return a surface laid out for all sets of the kind of `tiles`; arguments and errors as for `lay`."""
    found = lay(patches.quads, tiles, seed=seed)
    a, b = patches.place.unbind(-1)
    by = found.turn[patches.cell, None]
    # South-west is the quad's corner 0, 1, 2 or 3.
    east = torch.where(by == 0, a, torch.where(by == 1, b, torch.where(by == 2, 1 - a, 1 - b)))
    north = torch.where(by == 0, b, torch.where(by == 1, 1 - a, torch.where(by == 2, 1 - b, a)))
    jumps = found.jumps.clone()
    jumps[:, 1] = (jumps[:, 1] - found.turn[jumps[:, 0]]) % SIDES
    return TiledSurface(
        vertices=patches.vertices,
        faces=patches.faces,
        cell=patches.cell,
        place=torch.stack([east, north], -1),
        quads=patches.quads.gather(1, (torch.arange(SIDES) + found.turn[:, None]) % SIDES),
        colours=tiles.colours[found.tile],
        jumps=jumps,
        marks=tiles.marks,
    )


def _drawn(number: Tensor, owner: Tensor, which: int, letters: list[int], seed: int) -> Tensor:
    return torch.tensor(letters)[hashed(number, owner, which, seed) * len(letters) >> 32]


def _edges(faces: Int[Tensor, "F 4"]) -> tuple[Int[Tensor, "F 4"], Int[Tensor, "F 4"]]:
    """Return the number of the edge at each side, and the side beyond it, face * 4 + side; -1 at a border."""
    if faces.ndim != 2 or faces.shape[1] != SIDES or faces.dtype.is_floating_point:
        raise ShapeError(f"faces: expected quads, whole numbers (F, 4), got {tuple(faces.shape)} of {faces.dtype}")
    if bool((faces == faces.roll(-1, 1)).any()):
        face = int((faces == faces.roll(-1, 1)).any(1).nonzero()[0])
        raise ShapeError(f"faces: expected four different vertices, got {faces[face].tolist()} at face {face}")
    found = quads.edges(faces)
    if bool(found.along.any()):
        # Of the two the later one.
        face = int(
            (found.along & (found.beside < torch.arange(faces.numel()).reshape(faces.shape))).any(1).nonzero()[0]
        )
        raise ShapeError(f"faces: expected all anticlockwise from outside, got face {face} turned over; flip it")
    return found.number, found.beside


def _quarter(beside: Int[Tensor, "F 4"], turn: Int[Tensor, "F"]) -> Int[Tensor, "F 4"]:
    """Return by how many quarters the frame turns across each side; 0 at borders."""
    face, side = beside.clamp(min=0) // SIDES, beside.clamp(min=0) % SIDES
    found = (side - turn[face] - (torch.arange(SIDES) - turn[:, None]) - 2) % SIDES
    return torch.where(beside >= 0, -found % SIDES, 0)


def _jumps(beside: Int[Tensor, "F 4"], turn: Int[Tensor, "F"]) -> Int[Tensor, "n 3"]:
    """Return each edge across which frames turn, once."""
    quarter = _quarter(beside, turn)
    own = torch.arange(beside.numel()).reshape(beside.shape)
    face, side = ((quarter != 0) & (own < beside)).nonzero().unbind(1)
    return torch.stack([face, side, quarter[face, side]], 1)


def turns(beside: Int[Tensor, "F 4"]) -> Int[Tensor, "F"]:
    """Return how each quad is turned, so that few frames turn across edges: the best of several beginnings."""
    near = beside.tolist()
    begun = [len(near) * k // STARTS for k in range(STARTS)] if len(near) > STARTS else list(range(len(near)))[:1]
    tried = [torch.tensor(_grown(near, k), dtype=torch.long) for k in begun] or [torch.zeros(0, dtype=torch.long)]
    jumps = [int((_quarter(beside, turn) != 0).sum()) for turn in tried]
    return tried[jumps.index(min(jumps))]


def _grown(near: list[list[int]], first: int) -> list[int]:
    """Return frames that were grown from quad to quad, and then turned one by one while that helps."""
    turn = [-1] * len(near)
    for start in (first, *range(len(near))):
        if turn[start] >= 0:
            continue
        turn[start] = 0
        waiting = [start]
        for face in waiting:
            for side, there in enumerate(near[face]):
                other = there // SIDES
                if there >= 0 and turn[other] < 0:
                    turn[other] = _agreeing(there % SIDES, side, turn[face])
                    waiting.append(other)
    for _ in range(ROUNDS):
        changed = False
        for face, around in enumerate(near):
            votes = [0] * SIDES
            for side, there in enumerate(around):
                if there >= 0 and there // SIDES != face:
                    votes[_agreeing(side, there % SIDES, turn[there // SIDES])] += 1
            best = max(votes)
            if votes[turn[face]] < best:
                turn[face], changed = votes.index(best), True
        if not changed:
            break
    return turn


def _agreeing(side: int, other: int, turn: int) -> int:
    """Return the turn of a quad whose `side` meets side `other` of one that is turned by `turn`."""
    return (side - other + turn - 2) % SIDES


def classes(edges: Int[Tensor, "F 4"], beside: Int[Tensor, "F 4"]) -> Tensor:
    """Return which sides are of the second class, two of each quad's, the same on both sides of an edge.

    Sides at borders are joined in pairs, so that each quad has four neighbours.
    """
    beyond = beside.flatten().clone()
    border = (beyond < 0).nonzero()[:, 0]
    beyond[border[0::2]], beyond[border[1::2]] = border[1::2], border[0::2]
    near, used = beyond.tolist(), [False] * len(beyond)
    second = torch.zeros(len(near), dtype=torch.bool)
    left = [0] * len(edges)
    for start in range(len(edges)):
        path, circuit = [(start, -1)], []
        while path:  # Hierholzer's circuit, by the side that each quad is entered through
            face, entered = path[-1]
            while left[face] < SIDES and used[face * SIDES + left[face]]:
                left[face] += 1
            if left[face] == SIDES:
                circuit.append(entered)
                path.pop()
                continue
            out = face * SIDES + left[face]
            used[out] = used[near[out]] = True
            path.append((near[out] // SIDES, near[out]))
        for k, entered in enumerate(circuit[:-1]):
            if k % 2:
                second[entered] = second[near[entered]] = True
    return second.reshape(edges.shape)
