"""Bake the generalised displacement map of a tile: rays from every voxel in all directions.

wang2004gdm, section 3.1: the tile is surrounded by copies of itself, so that rays leave through the top or the bottom.
Here the copies reach as far as a distance can, and Embree casts the rays.

What is solid is found out by `meso.solid`.

Test: tests/meso/test_bake_gdm.py
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchmeso.data import gdm as gdm_data
from torchmeso.data.address import texel_centres
from torchmeso.data.gdm import Gdm
from torchmeso.data.store import open_blocks, writing
from torchmeso.errors import check_memory, check_range
from torchmeso.geometry.directions import dot, normalize
from torchmeso.geometry.rays import RayScene
from torchmeso.geometry.sphere import SphereGrid
from torchmeso.meso import solid
from torchmeso.meso.mesostructure import Mesostructure
from torchmeso.transport import tracer
from torchmeso.transport.tracer import Geometry

BEHIND = 1e-4
"""Rays start this far (tile units) behind their point, so that a surface the point lies on is met."""

BEYOND = 1e-5
"""And go on this far behind a surface that they pass."""

RAYS = 1 << 19
"""Rays cast at once."""

MEMORY_LIMIT = 8 << 30


@dataclass(frozen=True, slots=True, kw_only=True)
class GdmOptions:
    """How to bake a GDM.

    Attributes:
        texels: voxels along a side of the tile.
        layers: voxels from the bottom to the top of the slab, both included.
        n_theta: rings of directions over the whole sphere.
        n_phi: directions of a ring.
        cap: longest distance, tile units; longer than the way of a ray through a prism of the mesh to be dressed, or
            the way is asked for in several steps.
        supersample: a voxel is solid where most of n x n x n points in it are; more than 1 smooths fine detail.
        storage: uint8, float16 or float32.
    """

    texels: int = 64
    layers: int = 32
    n_theta: int = 16
    n_phi: int = 32
    cap: float = 1.0
    supersample: int = 1
    storage: Literal["uint8", "float16", "float32"] = "uint8"

    def __post_init__(self) -> None:
        """Raise ConfigError or SizeError for sizes that cannot be meant."""
        check_range("bake.gdm.texels", self.texels, 1, 4096)
        check_range("bake.gdm.layers", self.layers, 2, 4096)
        check_range("bake.gdm.cap", self.cap, 1e-3, 16)
        check_range("bake.gdm.supersample", self.supersample, 1, 16)
        SphereGrid(n_theta=self.n_theta, n_phi=self.n_phi)
        bytes_of = {"uint8": 1, "float16": 2, "float32": 4}[self.storage] + 1
        needed = float(self.texels) ** 2 * self.layers * self.n_theta * self.n_phi * bytes_of
        check_memory("bake.gdm", needed, MEMORY_LIMIT, "lower bake.gdm.texels or layers, or take fewer directions")


class Layer(NamedTuple):
    """What is found out about the voxels of a layer; see `Gdm`."""

    distance: Float[Tensor, "H W theta phi"]
    left: Bool[Tensor, "H W theta phi"]
    occupancy: Float[Tensor, "H W"]
    matter: Float[Tensor, "H W 10"]


class RayCastGdm:
    """d by casting a ray for every question: the limit that tables approach."""

    def __init__(self, meso: Mesostructure, cap: float):
        """Build the acceleration structure over the tile and its copies as far as `cap` reaches."""
        self.h, self.cap, self._geometry = meso.h, cap, meso.geometry
        self._vertices, self._faces, self._source = tracer.unit_cell(
            meso.geometry.vertices, meso.geometry.faces, cap + 2 * BEHIND
        )
        a, b, c = self._vertices[self._faces].double().unbind(1)
        self._normal = normalize(torch.linalg.cross(b - a, c - a)).float()
        self._scene = RayScene(self._vertices, self._faces)
        self._solids = solid.Solids(meso.geometry, meso.h)
        self._divides = self._point_outwards(meso.geometry)[self._source]

    def cast(
        self, place: Float[Tensor, "n 3"], w: Float[Tensor, "n 3"], inside: Bool[Tensor, "n"]
    ) -> tuple[Float[Tensor, "n"], Int[Tensor, "n"]]:
        """Return the way from `place` along `w` to the first surface, and its triangle; inf and -1 beyond `cap`.

        From points outside of solid, a surface passed from its back within `BEHIND` of the start is one that the point
        lies just in front of, and is not met.
        """
        start, outside = self._home(place) - BEHIND * w, ~inside
        t, face = self._first(start, w, self.cap + BEHIND)
        behind = (t < 2 * BEHIND) & outside
        while True:  # few rays begin at a surface
            ray = behind.nonzero()[:, 0]
            ray = ray[dot(self._normal[face[ray]], w[ray]) > 0]
            if not len(ray):
                return (t - BEHIND).clamp(min=0), face
            passed = t[ray] + BEYOND
            more, face[ray] = self._first(start[ray] + passed[:, None] * w[ray], w[ray], self.cap)
            t[ray] = passed + more
            behind = torch.zeros_like(behind)
            behind[ray] = t[ray] < 2 * BEHIND

    def _first(self, start: Tensor, w: Tensor, limit: float) -> tuple[Tensor, Tensor]:
        found = self._scene.first_hit(start, w, torch.full((len(w),), limit))
        return found.t, found.face

    def _point_outwards(self, tile: Geometry) -> Bool[Tensor, "F"]:
        """Turn normals away from solid, whatever the winding of triangles; return which have solid on one side."""
        a, b, c = tile.vertices[tile.faces].double().unbind(1)
        middle, normal = (a + b + c) / 3, normalize(torch.linalg.cross(b - a, c - a))
        before, behind = (self.inside((middle + s * 2 * BEHIND * normal).float()) for s in (1, -1))
        turned = (before & ~behind)[self._source]
        self._normal = torch.where(turned[:, None], -self._normal, self._normal)
        return before != behind

    def inside(self, place: Float[Tensor, "n 3"]) -> Bool[Tensor, "n"]:
        """Return which points lie inside of at least one body."""
        return self._solids.inside(self._home(place), start=BEHIND)

    def matter(
        self, place: Float[Tensor, "n 3"], w: Float[Tensor, "n 3"], t: Float[Tensor, "n"], face: Int[Tensor, "n"]
    ) -> Float[Tensor, "n 10"]:
        """Return normal, albedo, alpha and f0 where rays meet triangles; 0 where they meet none."""
        known = face >= 0
        face = face.clamp(min=0)
        point = self._home(place) + torch.where(known, t, 0)[:, None] * w
        found = tracer.reflectance(self._geometry, self._source[face], point[:, :2])
        normal = self._normal[face]
        against = torch.where((dot(normal, w) > 0)[:, None], -normal, normal)
        normal = torch.where(self._divides[face][:, None], normal, against)
        parts = [normal, found.albedo, found.alpha[:, None], found.f0]
        return torch.cat(parts, -1) * known[:, None]

    def _home(self, place: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        return torch.cat([place[:, :2] - place[:, :2].floor(), place[:, 2:]], -1)


def bake(
    meso: Mesostructure,
    options: GdmOptions,
    path: str | Path,
    *,
    about: dict[str, object],
    progress: Callable[[float], None] = lambda share: None,
) -> None:
    """Bake the GDM of `meso` into the raw table `path` (.gdm.zarr), layer by layer; a cut-off bake goes on.

    Args:
        meso: the tile.
        options: voxels, directions, storage.
        path: the table.
        about: what the table says of its origin; an unfinished table with other words is started anew.
        progress: called with the share done, 0..1.
    """
    shape = (options.layers, options.texels, options.texels, options.n_theta, options.n_phi)
    attributes = {**gdm_data.table_attributes(meso.h, options.cap), **about}
    writer = open_blocks(path, gdm_data.specs(shape, options.storage), attributes)
    caster = RayCastGdm(meso, options.cap)
    with writing(path):
        for k in range(options.layers):
            if not writer.is_done(k):
                layer = bake_layer(caster, options, k)
                writer["distance"][k] = stored(layer.distance, options).numpy()
                writer["left"][k] = layer.left.numpy()
                writer["occupancy"][k] = layer.occupancy.numpy()
                writer["matter"][k] = layer.matter.numpy()
                writer.mark_done(k)
            progress((k + 1) / options.layers)
        writer.finish()


def in_memory(meso: Mesostructure, options: GdmOptions) -> Gdm:
    """Return the baked GDM without writing a file."""
    caster = RayCastGdm(meso, options.cap)
    layers = [bake_layer(caster, options, k) for k in range(options.layers)]
    return Gdm(
        distance=torch.stack([stored(x.distance, options) for x in layers]),
        left=torch.stack([x.left for x in layers]),
        occupancy=torch.stack([x.occupancy for x in layers]),
        matter=torch.stack([x.matter for x in layers]),
        h=meso.h,
        cap=options.cap,
    )


def bake_layer(caster: RayCastGdm, options: GdmOptions, k: int) -> Layer:
    """Return layer `k` of the table, counted from the bottom of the slab."""
    n = options.texels
    z = -caster.h + caster.h * k / (options.layers - 1)
    uv = texel_centres(n, n).reshape(-1, 2)
    place = torch.cat([uv, torch.full((len(uv), 1), z)], -1)
    occupancy = _occupancy(caster, place, options)
    inside = occupancy > 0.5
    grid = SphereGrid(n_theta=options.n_theta, n_phi=options.n_phi)
    directions = grid.directions().reshape(-1, 3)
    distance = torch.full((len(uv), len(directions)), torch.inf)
    nearest = torch.full((len(uv),), torch.inf)
    towards, face = torch.zeros(len(uv), 3), torch.full((len(uv),), -1)
    at_once = max(RAYS // len(uv), 1)
    for first in range(0, len(directions), at_once):
        w = directions[first : first + at_once]
        m = len(w)
        t, of = caster.cast(place.repeat_interleave(m, 0), w.repeat(len(uv), 1), inside.repeat_interleave(m))
        t, of = t.reshape(-1, m), of.reshape(-1, m)
        distance[:, first : first + m] = t
        least, which = t.min(-1)
        closer = least < nearest
        nearest = torch.where(closer, least, nearest)
        face = torch.where(closer, of.gather(1, which[:, None])[:, 0], face)
        towards = torch.where(closer[:, None], w[which], towards)
    end = _to_boundary(z, caster.h, directions[:, 2])
    left = (distance > end + BEHIND) & ~inside[:, None]
    distance = torch.where(left | inside[:, None], 0, torch.minimum(distance, end))
    shape = (n, n, options.n_theta, options.n_phi)
    matter = caster.matter(place, towards, nearest, face)
    return Layer(distance.reshape(shape), left.reshape(shape), occupancy.reshape(n, n), matter.reshape(n, n, 10))


def stored(distance: Float[Tensor, "*batch"], options: GdmOptions) -> Tensor:
    """Return distances as a table keeps them."""
    if options.storage == "uint8":
        return (distance * (255 / options.cap)).round().clamp(0, 255).to(torch.uint8)
    return distance.to(getattr(torch, options.storage))


def _occupancy(caster: RayCastGdm, place: Float[Tensor, "n 3"], options: GdmOptions) -> Float[Tensor, "n"]:
    """Return the share of points in each voxel that lie inside; points outside of the slab do not count."""
    n = options.supersample
    offsets = (torch.arange(n) + 0.5) / n - 0.5
    size = torch.tensor([1 / options.texels, 1 / options.texels, caster.h / (options.layers - 1)])
    inside, count = torch.zeros(len(place)), torch.zeros(len(place))
    for some in torch.cartesian_prod(offsets, offsets, offsets).reshape(-1, 3).split(max((1 << 15) // len(place), 1)):
        point = place + some[:, None] * size
        within = (point[..., 2] <= 0) & (point[..., 2] >= -caster.h)
        found = caster.inside(point.reshape(-1, 3)).reshape(within.shape)
        inside += (found & within).sum(0)
        count += within.sum(0)
    return inside / count.clamp(min=1)


def _to_boundary(z: float, h: float, climb: Float[Tensor, "d"]) -> Float[Tensor, "d"]:
    """Return the way to the top or bottom of the slab in each direction; inf for a level one."""
    end = torch.where(climb > 0, -z, -(z + h)) / climb
    return torch.where(climb == 0, torch.inf, end).clamp(min=0)
