"""Radiance of points met in a shell: material of the volume, lights, and shadows that near material casts.

wang2004gdm, section 3.2: one look-up of the GDM along the light says whether near material is in the way, as if the
surface were flat there; what is far is said by a shadow map. The material is that of `transport.materials`, around the
normal that the voxels keep; the floor of a shell is a diffuser.

    L = (1/pi) sum over visible lights of E T  +  ambient albedo (1 + n_z) / 2,      T = pi f_r (n . wi)

Kernel: kernels_cl/render/gdm_shade.clh          Test: tests/render/test_gdm_shade.py
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchmeso.data.gdm import Gdm, Matter
from torchmeso.geometry import frames, prisms
from torchmeso.geometry.directions import dot
from torchmeso.geometry.frames import Frame
from torchmeso.geometry.light import illuminate
from torchmeso.render.scene import Scene, World
from torchmeso.transport import materials
from torchmeso.transport.materials import Reflectance

LEAST_COS, DEEPER = 0.02, 3.0
"""Of the view: a normal averaged over voxels may lean away from a surface that is seen. And voxels that a point may lie
below its surface."""


class Met(NamedTuple):
    """Points in shells.

    Attributes:
        position: (n, 3) world.
        place: (n, 3) texture coordinates.
        floor: (n,) whether they lie on the bottom.
        frame: world tangent frame of the mesh there; each vector (n, 3).
        scale: (n,) texture scale.
        owner: (n,) surface, see `Scene.surfaces`.
    """

    position: Float[Tensor, "n 3"]
    place: Float[Tensor, "n 3"]
    floor: Bool[Tensor, "n"]
    frame: Frame
    scale: Float[Tensor, "n"]
    owner: Int[Tensor, "n"]

    def select(self, which: Tensor) -> "Met":
        """Return the points `which` (numbers or a mask)."""
        frame = Frame(*(x[which] for x in self.frame))
        rest = (x[which] for x in (self.scale, self.owner))
        return Met(self.position[which], self.place[which], self.floor[which], frame, *rest)


def points(
    world: World,
    prism: Int[Tensor, "n"],
    place: Float[Tensor, "n 3"],
    floor: Bool[Tensor, "n"],
    position: Float[Tensor, "n 3"],
) -> Met:
    """Return the points at `place` in prisms of all shells, which lie at `position`."""
    n, dtype = len(prism), place.dtype
    columns = {name: torch.zeros(n, 3, dtype=dtype) for name in ("normals", "tangents")}
    sign, scale = torch.ones(n, dtype=dtype), torch.ones(n, dtype=dtype)
    owner = torch.zeros(n, dtype=torch.long)
    for placed in world.shells:
        first = placed.first_tet // 3
        mine = ((prism >= first) & (prism < first + len(placed.shell.face))).nonzero()[:, 0]
        if len(mine) == 0:
            continue
        corner = placed.mesh.faces[placed.shell.face[prism[mine] - first]]
        triangle = placed.mesh.uv.double()[corner]
        share = prisms.barycentric(place[mine, :2].double(), triangle)
        share = torch.where(prisms.is_thin(triangle)[:, None], 1 / 3, share).clamp(0, 1).to(dtype)
        for name, column in columns.items():
            column[mine] = (share[..., None] * getattr(placed.mesh, name).to(dtype)[corner]).sum(1)
        scale[mine] = (share * placed.mesh.scale.to(dtype)[corner]).sum(1)
        sign[mine] = placed.mesh.sign.to(dtype)[corner[:, 0]]
        owner[mine] = placed.surface
    frame = frames.orthonormal(columns["normals"], columns["tangents"], sign)
    return Met(position, place, floor, frame, scale, owner)


def shade(
    scene: Scene,
    met: Met,
    wo_world: Float[Tensor, "n 3"],
    shadowed: Bool[Tensor, "light n"],
    *,
    shadows: bool = True,
) -> Float[Tensor, "n 3"]:
    """Return the linear RGB radiance of `met` towards `wo_world`.

    Args:
        scene: materials, lights and ambient.
        met: where.
        wo_world: (n, 3) unit, to the viewer.
        shadowed: (light, n) whether a light is blocked by what is far.
        shadows: whether near material casts shadows.
    """
    total = torch.zeros_like(met.position)
    for i, dressing in enumerate(scene.surfaces):
        mine = (met.owner == i).nonzero()[:, 0]
        if dressing.gdm is None or len(mine) == 0:
            continue
        own = met.select(mine)
        above = frames.to_local(own.frame, wo_world[mine])
        matter = _matter(dressing.gdm, own, above, dressing.albedo)
        around = frames.around(matter.normal)
        wo = frames.to_local(around, above)
        wo = torch.cat([wo[:, :2], wo[:, 2:].clamp(min=LEAST_COS)], -1)
        lit = torch.zeros(len(mine), dtype=torch.bool)
        found = torch.zeros_like(own.position)
        for light, blocked in zip(scene.lights, shadowed, strict=True):
            wi_world, _, E = illuminate(light, own.position)
            wi = frames.to_local(own.frame, wi_world)
            faces = dot(matter.normal, wi) > 0
            arrives = (~blocked[mine] & faces & (E.amax(-1) > 0)).nonzero()[:, 0]
            if shadows:
                near = in_shade(
                    dressing.gdm, own.place[arrives], matter.normal[arrives], wi[arrives],
                    floor=dressing.shell.base == "solid",
                )  # fmt: skip
                arrives = arrives[~near]
            lit[arrives] = True
            to_light = frames.to_local(Frame(*(x[arrives] for x in around)), wi[arrives])
            parts = Reflectance(matter.albedo[arrives], matter.alpha[arrives], matter.f0[arrives])
            f_r = materials.evaluate(parts, to_light, wo[arrives])
            found[arrives] += E[arrives] * f_r * to_light[:, 2:]
        dark = ~lit if scene.ambient_rule == "paper" else torch.ones_like(lit)
        open_sky = scene.ambient * 0.5 * (1 + matter.normal[:, 2:])
        total[mine] = found + torch.where(dark[:, None], open_sky * matter.albedo, 0)
    return total


def in_shade(
    gdm: Gdm, place: Float[Tensor, "n 3"], normal: Float[Tensor, "n 3"], wi: Float[Tensor, "n 3"], *, floor: bool
) -> Bool[Tensor, "n"]:
    """Return whether near material lies between points of a surface and a light; wang2004gdm, section 3.2.

    Asked a voxel in front of the surface, where the table tells it from what is in front of it; of points that lie
    deeper, because a distance is interpolated, once more from farther out. Where there is a `floor` light from below
    does not get through.
    """
    blocked, within = _asked(gdm, place + gdm.voxel * normal, wi)
    if bool(within.any()):
        blocked[within] = _asked(gdm, (place + DEEPER * gdm.voxel * normal)[within], wi[within])[0]
    return blocked | (wi[:, 2] <= 0) if floor else blocked


def _asked(gdm: Gdm, start: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
    """Return whether there is material ahead, and whether the start lies inside of it; above the slab is none."""
    found = gdm.evaluate(start, wi)
    below = start[:, 2] < 0
    return ~found.left & below, (found.distance <= 0) & ~found.left & below


def _matter(gdm: Gdm, met: Met, wo: Float[Tensor, "n 3"], albedo: tuple[float, float, float]) -> Matter:
    """Return the material at points seen from `wo` (local); of the floor, a diffuser."""
    matter = gdm.matter_at(met.place, wo.to(met.place.dtype))
    dtype = met.place.dtype
    floor = met.floor[:, None]
    up, plain = (torch.tensor(x, dtype=dtype) for x in ((0.0, 0.0, 1.0), albedo))
    return Matter(
        torch.where(floor, up, matter.normal.to(dtype)),
        torch.where(floor, plain, matter.albedo.to(dtype)),
        torch.where(met.floor, 1, matter.alpha.to(dtype)),
        torch.where(floor, 0, matter.f0.to(dtype)),
    )
