"""The peer that wang2004gdm grew out of: view-dependent displacement maps (wang2003vdm), a table over a curvature.

    d(u, v, theta, phi, c): the way from a point of the surface, along the ray of a viewer, to material,

where the surface bends by the curvature c in the plane of the ray, and is straight across it. In units of a tile, with
tau the way along the ray, at an angle theta to the normal, arc s along the surface and height z over it are

    s = atan2(c tau sin(theta), 1 - c tau cos(theta)) / c,
    z = (c tau^2 - 2 tau cos(theta)) / (1 + sqrt(c^2 tau^2 - 2 c tau cos(theta) + 1)),

convex surfaces having c > 0. Rays end at material, at the bottom of the slab (the table knows height fields, which have
a bottom: a hit), or `left`: out of the top again, which only convex surfaces let them.

Everything a ray will pass is told by one number, the curvature at the pixel: that is what makes VDMs fast, and what
they get wrong where the surface bends in other ways. They are asked at the top alone, so open surfaces end at their
edges as if cut with scissors.

A baseline of the suite `gdm`, nothing else.          Test: tests/bench/test_vdm.py
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchmeso.data import address
from torchmeso.data.address import texel_centres
from torchmeso.geometry import frames, hemisphere
from torchmeso.geometry.directions import dot
from torchmeso.geometry.hemisphere import DirectionSet
from torchmeso.geometry.mesh import Mesh
from torchmeso.meso.bake_gdm import RAYS, RayCastGdm
from torchmeso.meso.mesostructure import Mesostructure

STRAIGHT = 1e-3
"""Tile units by which a bent way may be off the straight pieces that are cast."""

LONGEST = 1.0
"""Of a piece, tile units."""

FLAT = 1e-9
"""Curvatures below it, per tile, are none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VdmOptions:
    """How to bake a VDM.

    Attributes:
        texels: along a side of the tile.
        views: the direction set.
        curvatures: samples from -most to most.
        most: largest curvature, per tile; beyond it is held.
    """

    texels: int = 64
    views: str = "grid(32, 8, 87.5)"
    curvatures: int = 17
    most: float = 4.0


class Answer(NamedTuple):
    """What a ray meets.

    Attributes:
        way: (...) along the ray to material, tile units; inf where it leaves.
        place: (..., 3) u, v, z there; of no meaning where it leaves.
    """

    way: Float[Tensor, "*batch"]
    place: Float[Tensor, "*batch 3"]


@dataclass(frozen=True, eq=False, kw_only=True)
class Vdm:
    """Ways over curvatures, views and texels.

    Attributes:
        way: (curvature, view, H, W) float16 tile units; 0 where `left`.
        left: (curvature, view, H, W) whether a ray comes out of the top again.
        views: the view directions.
        most: curvatures run evenly from -most to most, per tile.
        h: slab depth, tile units.
    """

    way: Float[Tensor, "curvature view H W"]
    left: Bool[Tensor, "curvature view H W"]
    views: DirectionSet
    most: float
    h: float

    def evaluate(
        self, uv: Float[Tensor, "*batch 2"], wo: Float[Tensor, "*batch 3"], curvature: Float[Tensor, "*batch"]
    ) -> Answer:
        """Return what the ray to `uv` from where `wo` points meets on a surface of `curvature` along it.

        By weight among the samples around it is decided whether it leaves; the others' ways are averaged.
        """
        count, _, height, width = self.way.shape
        at = ((curvature / self.most).clamp(-1, 1) + 1) * ((count - 1) / 2)
        below = at.floor().clamp(max=count - 2)
        bend = torch.stack([below, below + 1], -1).long()
        of_bend = torch.stack([below + 1 - at, at - below], -1)
        taps, view = address.bilinear(uv, height, width), hemisphere.interpolate(self.views, wo)
        index = bend[..., :, None] * self.views.n_nodes + view.node[..., None, :]
        index = index[..., None] * (height * width) + taps.texel[..., None, None, :]
        weight = (of_bend[..., :, None] * view.weight[..., None, :])[..., None] * taps.weight[..., None, None, :]
        index, weight = index.flatten(-3), weight.flatten(-3)
        way, left = (x.flatten()[index].to(uv.dtype) for x in self.nodes)
        missing = (weight * left).sum(-1)
        mean = (weight * way).sum(-1) / (1 - missing).clamp(min=1e-6)
        s, z = bent(mean, wo[..., 2], curvature.clamp(-self.most, self.most))
        level = wo[..., :2] / wo[..., :2].norm(dim=-1, keepdim=True).clamp(min=1e-12)
        place = torch.cat([uv - s.unsqueeze(-1) * level, z.clamp(-self.h, 0).unsqueeze(-1)], -1)
        return Answer(torch.where(missing > 0.5, torch.inf, mean), place)

    @cached_property
    def nodes(self) -> tuple[Float[Tensor, "curvature node H W"], Float[Tensor, "curvature node H W"]]:
        """Ways and shares of `left` with the pole, whose way is the mean of those around it that meet something."""
        left = hemisphere.with_pole(self.left.float(), self.views, dim=1)
        way = hemisphere.with_pole(self.way.float(), self.views, dim=1)
        if self.views.needs_pole:
            left[:, -1] = (left[:, -1] > 0.5).float()
            met = (~self.left[:, : self.views.count[0]]).float()
            first = self.way[:, : self.views.count[0]].float()
            way[:, -1] = (first * met).sum(1) / met.sum(1).clamp(min=1)
        return way * (1 - left), left


def bent(
    tau: Float[Tensor, "*#batch"], cosine: Float[Tensor, "*#batch"], c: Float[Tensor, "*#batch"]
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """Return arc and height, tile units, of a ray after the way `tau`; `cosine` is that to the normal, > 0."""
    sine = (1 - cosine.square()).clamp(min=0).sqrt()
    c = torch.where(c.abs() < FLAT, FLAT, c)
    s = torch.atan2(c.abs() * tau * sine, 1 - c * tau * cosine) / c.abs()
    z = (c * tau.square() - 2 * tau * cosine) / (
        1 + ((c * tau).square() - 2 * c * tau * cosine + 1).clamp(min=0).sqrt()
    )
    return s, z


def through(
    h: float, cosine: Float[Tensor, "*#batch"], c: Float[Tensor, "*#batch"]
) -> tuple[Float[Tensor, "*batch"], Bool[Tensor, "*batch"]]:
    """Return the way of a ray through the slab, and whether it comes out of the top again instead of the bottom."""
    drop = c * (2 * h - c * h * h)
    under = cosine.square() - drop
    bottom = (2 * h - c * h * h) / (cosine + under.clamp(min=0).sqrt())
    return torch.where(under < 0, 2 * cosine / torch.where(under < 0, c, 1), bottom), under < 0


def bake(meso: Mesostructure, options: VdmOptions, progress: Callable[[float], None] = lambda share: None) -> Vdm:
    """Return the VDM of a mesostructure; curvatures must stay below 1 / h, where the slab has a bottom."""
    if options.most * meso.h >= 1:
        raise ValueError(f"vdm: expected curvatures below 1 / h = {1 / meso.h:g}, got {options.most:g}")
    views = hemisphere.parse(options.views)
    caster, wo = RayCastGdm(meso, LONGEST), views.directions(torch.float64)
    uv = texel_centres(options.texels, options.texels).reshape(-1, 2)
    shape = (options.curvatures, len(wo), options.texels, options.texels)
    way, left = torch.zeros(shape, dtype=torch.float16), torch.zeros(shape, dtype=torch.bool)
    at_once = max(RAYS // len(uv), 1)
    for k, c in enumerate(torch.linspace(-options.most, options.most, options.curvatures, dtype=torch.float64)):
        for first in range(0, len(wo), at_once):
            some = wo[first : first + at_once]
            found = cast(
                caster, uv.repeat(len(some), 1), some.repeat_interleave(len(uv), 0), c.expand(len(uv) * len(some))
            )
            left[k, first : first + at_once] = found.isinf().reshape(-1, *shape[2:])
            way[k, first : first + at_once] = torch.where(found.isinf(), 0, found).reshape(-1, *shape[2:]).half()
            progress((k * len(wo) + first + len(some)) / (options.curvatures * len(wo)))
    return Vdm(way=way, left=left, views=views, most=options.most, h=meso.h)


def cast(
    caster: RayCastGdm, uv: Float[Tensor, "n 2"], wo: Float[Tensor, "n 3"], c: Float[Tensor, "n"]
) -> Float[Tensor, "n"]:
    """Return the ways of rays over surfaces of curvature `c`, inf where they leave: straight piece after piece."""
    end, out = through(caster.h, wo[:, 2], c)
    level = wo[:, :2] / wo[:, :2].norm(dim=1, keepdim=True).clamp(min=1e-12)
    pieces = torch.maximum(end * (c.abs() / (8 * STRAIGHT)).sqrt(), end / LONGEST).ceil().clamp(min=1)
    way = torch.where(out, torch.inf, end)

    def place(ray: Tensor, k: int) -> Tensor:
        s, z = bent(end[ray] * (k / pieces[ray]), wo[ray, 2], c[ray])
        return torch.cat([uv[ray] - s[:, None] * level[ray], z[:, None].clamp(max=0)], 1)

    alive = torch.arange(len(uv))
    for k in range(int(pieces.max())):
        alive = alive[k < pieces[alive]]
        a, b = place(alive, k), place(alive, k + 1)
        length = (b - a).norm(dim=1).clamp(min=1e-9)
        t, _ = caster.cast(a.float(), ((b - a) / length[:, None]).float(), torch.zeros(len(alive), dtype=torch.bool))
        met = t <= length
        way[alive[met]] = end[alive[met]] * ((k + t[met] / length[met]) / pieces[alive[met]])
        alive = alive[~met]
    return way


def curvature(mesh: Mesh) -> Float[Tensor, "V 3"]:
    """Return how normals turn over the surface, per tile: the symmetric matrix (tt, tb, bb) in each vertex's frame.

    rusinkiewicz2004curvatures, section 3: along the edges of a triangle normals change by the matrix times the edge,
    solved for by least squares; a vertex gets the mean of its triangles by area. Convex is positive.
    """
    frame = frames.orthonormal(mesh.normals.double(), mesh.tangents.double(), mesh.sign.double())
    axes = torch.stack([frame.t, frame.b], 1)  # (V, 2, 3)
    corner = mesh.faces
    edges = mesh.vertices.double()[corner.roll(-1, 1)] - mesh.vertices.double()[corner]
    turns = frame.n[corner.roll(-1, 1)] - frame.n[corner]
    area = torch.linalg.cross(edges[:, 0], edges[:, 1]).norm(dim=1)
    total, share = torch.zeros(len(mesh.vertices), 3, dtype=torch.float64), torch.zeros(len(mesh.vertices), 1).double()
    for k in range(3):
        x, y = (axes[corner[:, k]] @ edges.mT).unbind(1)
        turn = axes[corner[:, k]] @ turns.mT
        none = torch.zeros_like(x)
        known = torch.cat([torch.stack([x, y, none], -1), torch.stack([none, x, y], -1)], 1)  # (F, 6, 3)
        normal = known.mT @ known
        normal = (
            normal
            + 1e-12 * normal.diagonal(dim1=1, dim2=2).sum(-1)[:, None, None] * torch.eye(3)
            + 1e-300 * torch.eye(3)
        )
        found = torch.linalg.solve(normal, known.mT @ turn.flatten(1).unsqueeze(-1))[..., 0]
        total.index_add_(0, corner[:, k], area[:, None] * found)
        share.index_add_(0, corner[:, k], area[:, None])
    return total / share.clamp(min=1e-300) * mesh.scale.double()[:, None]


def along(matrix: Float[Tensor, "*batch 3"], w: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
    """Return the curvature in the plane of the normal and `w`, local frame."""
    x, y = w[..., 0], w[..., 1]
    level = (x.square() + y.square()).clamp(min=1e-12)
    return dot(matrix, torch.stack([x * x, 2 * x * y, y * y], -1)) / level
