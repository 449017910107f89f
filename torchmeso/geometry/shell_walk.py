"""Rays that pass from tetrahedron to tetrahedron of a shell, without planes or tolerances.

A ray is followed by the faces it passes, as these are seen along it: of a tetrahedron it comes into, all but the tip is
known already. Columns of numbers, one for all rays, stand together, so that torch works on them at its full speed.

Test: tests/geometry/test_shell_walk.py
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchmeso.geometry.frames import around
from torchmeso.geometry.shell import OUTWARD, Shell, left_of

INTO = OUTWARD.flip(1)
"""Corners of the face opposite each corner of a tetrahedron, counter-clockwise seen by a ray that comes in there."""

NUDGES = (1e-9, 1e-7, 1e-5, 1e-3, 0.0)
"""A ray beside the face it comes in by is moved by these shares of the way to its middle, one after the other."""


class Rays(NamedTuple):
    """Rays and what they are seen along.

    Attributes:
        origin: (3, n) float64.
        across, up, ahead: (3, n) unit: two axes across the ray, and the ray.
    """

    origin: Float[Tensor, "3 n"]
    across: Float[Tensor, "3 n"]
    up: Float[Tensor, "3 n"]
    ahead: Float[Tensor, "3 n"]

    def select(self, which: Tensor) -> "Rays":
        """Return the rays `which`."""
        return Rays(*(x[:, which] for x in self))

    def seen(self, point: Float[Tensor, "3 *m n"]) -> tuple[Tensor, Tensor, Tensor]:
        """Return points as seen along their rays: across, up, and how far along, (*m, n) each."""
        x, y, z = (p - o for p, o in zip(point, self.origin, strict=True))
        return tuple(a[0] * x + a[1] * y + a[2] * z for a in (self.across, self.up, self.ahead))  # type: ignore[return-value]


class Face(NamedTuple):
    """Faces that rays pass, their corners counter-clockwise seen along the ray.

    Attributes:
        corner: (3, n) of a tetrahedron.
        vertex: (3, n) of the shell.
        x, y: (3, n) where they are seen, the ray at the origin.
        t: (3, n) distance along the ray.
    """

    corner: Int[Tensor, "3 n"]
    vertex: Int[Tensor, "3 n"]
    x: Float[Tensor, "3 n"]
    y: Float[Tensor, "3 n"]
    t: Float[Tensor, "3 n"]

    def select(self, which: Tensor) -> "Face":
        """Return the faces `which`."""
        return Face(*(x[:, which] for x in self))

    def shares(self) -> Float[Tensor, "3 n"]:
        """Return the share of each corner in where the ray passes."""
        following, last = [1, 2, 0], [2, 0, 1]
        area = self.x[following] * self.y[last] - self.y[following] * self.x[last]
        total = area.sum(0)
        # A face seen on edge has no inside: its middle is as good as any place.
        flat = total.abs() < 1e-30
        share = torch.where(flat, 1 / 3, area / torch.where(flat, 1, total)).clamp(0, 1)
        return share / share.sum(0)


class Tetrahedra(NamedTuple):
    """A shell as walks ask for it.

    Attributes:
        vertices: (3, N) positions.
        tip: (4 T,) vertex of each corner.
        uvz: (4 T, 3) texture coordinates of each corner.
        neighbour: (4 T,) see `Shell`.
        onward: (4 T, 4) number of each corner in the neighbour behind the face opposite a corner.
    """

    vertices: Float[Tensor, "3 N"]
    tip: Int[Tensor, "C"]
    uvz: Float[Tensor, "C 3"]
    neighbour: Int[Tensor, "C"]
    onward: Int[Tensor, "C 4"]

    def place(self, tet: Int[Tensor, "n"], face: Face, share: Float[Tensor, "3 n"]) -> Float[Tensor, "n 3"]:
        """Return the texture coordinates of shares of a face, as the tetrahedron `tet` has them."""
        return (share[..., None] * self.uvz[4 * tet + face.corner]).sum(0)


def prepare(shell: Shell) -> Tetrahedra:
    """Return what walks through `shell` ask for."""
    behind = shell.tets[shell.neighbour.clamp(min=0)]
    same = shell.tets[:, None, :, None] == behind[:, :, None, :]
    return Tetrahedra(
        shell.vertices.T.contiguous(),
        shell.tets.flatten(),
        shell.uvz.reshape(-1, 3),
        shell.neighbour.flatten(),
        same.to(torch.uint8).argmax(-1).reshape(-1, 4),
    )


def enter(
    through: Tetrahedra,
    origin: Float[Tensor, "n 3"],
    direction: Float[Tensor, "n 3"],
    tet: Int[Tensor, "n"],
    corner: Int[Tensor, "n"],
) -> tuple[Rays, Face, Bool[Tensor, "n"]]:
    """Return rays, the faces they come in by, and which come in: a face seen on edge lets none in.

    What says by which face a ray comes in rounds otherwise than what is seen along it; a walk that begins beside its
    face would not find out. Such rays are moved into it: by the order of rounding, and more only if that does not do.

    Args:
        through: the shell.
        origin: where rays begin.
        direction: unit.
        tet: tetrahedra they come into.
        corner: the one opposite the face they come in by; -1: they begin inside of the tetrahedron.
    """
    axes = around(direction.double())
    rays = Rays(*(x.T.contiguous() for x in (origin.double(), axes.t, axes.b, axes.n)))
    inside = corner < 0
    face = _face_of(through, rays, tet, torch.where(inside, 0, corner))
    for other in (1, 2, 3):  # where a ray that begins inside would have come in
        beside = (inside & ~_within(face)).nonzero()[:, 0]
        found = _face_of(through, rays.select(beside), tet[beside], torch.full_like(beside, other))
        for mine, theirs in zip(face, found, strict=True):
            mine[:, beside] = theirs
    for step in NUDGES:
        beside = (~_within(face)).nonzero()[:, 0]
        if not len(beside):
            break
        own, seen = rays.select(beside), face.select(beside)
        way = step * seen.x.mean(0) * own.across + step * seen.y.mean(0) * own.up
        rays.origin[:, beside] += way
        moved = _seen(through, rays.select(beside), seen.corner, seen.vertex)
        for mine, theirs in zip(face, moved, strict=True):
            mine[:, beside] = theirs
    return rays, face, _within(face)


def leave(through: Tetrahedra, rays: Rays, tet: Int[Tensor, "n"], face: Face) -> tuple[Int[Tensor, "n"], Face]:
    """Return the corner opposite the face that rays leave by, and that face; `face` is the one they came by."""
    tip = 6 - face.corner.sum(0)
    vertex = through.tip[4 * tet + tip]
    x, y, t = rays.seen(through.vertices[:, vertex])
    at_tip, at_rim = torch.stack([x, y], -1), torch.stack([face.x, face.y], -1)
    left = left_of(at_tip.expand_as(at_rim), at_rim, vertex.expand_as(face.vertex), face.vertex)
    # The ray passes between a corner of the rim and the next, seen from the tip. All on one side: it meets the tip
    # itself, and any way out is as good as another.
    first = left[0] & ~left[1]
    second, third = ~first & left[1] & ~left[2], ~first & left[2] & ~left[0]

    def at(rim: Tensor, k: int) -> Tensor:
        return torch.where(second, rim[(k + 1) % 3], torch.where(third, rim[(k + 2) % 3], rim[k]))

    passed = Face(
        *(torch.stack([at(rim, 0), at(rim, 1), own]) for rim, own in zip(face, (tip, vertex, x, y, t), strict=True))
    )
    return at(face.corner, 2), passed


def go_on(through: Tetrahedra, tet: Int[Tensor, "n"], out: Int[Tensor, "n"], face: Face) -> Face:
    """Return a face as the tetrahedra behind it have it, given that it lies opposite the corners `out`."""
    return face._replace(corner=through.onward[4 * tet + out].T.gather(0, face.corner))


def _within(face: Face) -> Bool[Tensor, "n"]:
    """Return whether rays pass inside of faces."""
    p = torch.stack([face.x, face.y], -1)
    return left_of(p, p.roll(-1, 0), face.vertex, face.vertex.roll(-1, 0)).all(0)


def _face_of(through: Tetrahedra, rays: Rays, tet: Tensor, corner: Tensor) -> Face:
    """Return the faces opposite corners as rays see them that come in there."""
    local = INTO[corner].T.contiguous()
    return _seen(through, rays, local, through.tip[4 * tet + local])


def _seen(through: Tetrahedra, rays: Rays, corner: Tensor, vertex: Tensor) -> Face:
    return Face(corner, vertex, *rays.seen(through.vertices[:, vertex]))
