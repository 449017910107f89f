"""Rows of the suite `gdm` on what hits and misses are wrong for: samples that no table was baked of.

A table of 128 x 128 x 64 voxels and 32 x 64 directions has 2.1e9 samples; a picture's outline asks a few thousandths
of them. `Unbaked` casts the ray of a sample when it is asked for, so that any resolution can be judged by itself; `Ray`
casts that of the question, the limit of all tables, and leaves only what is wrong with the walk.

Test: tests/bench/test_gdm_finest.py
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, cast

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchmeso.bench.gdm_error import NEAR, near_outline
from torchmeso.bench.gdm_speed import SIZE, camera_entries, view
from torchmeso.bench.suite import Context, Row
from torchmeso.data import gdm_query
from torchmeso.data.gdm_query import Query
from torchmeso.geometry import shapes
from torchmeso.geometry.rays import RayScene
from torchmeso.geometry.sphere import SphereGrid
from torchmeso.meso import generators
from torchmeso.meso.bake_gdm import BEHIND, RayCastGdm
from torchmeso.meso.displace import displace
from torchmeso.render import gdm_trace
from torchmeso.render.gdm_trace import Entries

if TYPE_CHECKING:
    from torchmeso.data.gdm import Gdm

SIZES = ((32, 16), (64, 16), (64, 32), (128, 16), (128, 32), (128, 64), (256, 64))
"""Voxels along a side of the tile, and rings of directions."""

FINEST = "256.64.8"

CAP = 1.0
"""Longest distance of the tables, tile units."""


@dataclass(frozen=True, eq=False)
class Unbaked:
    """A `gdm_query.Sampled` of any size, whose samples are cast as `meso.bake_gdm` does when they are asked for.

    Attributes:
        caster: the mesostructure.
        voxels: layers, height and width.
        directions: of travel.
        codes: of the longest distance; 0: exact.
    """

    caster: RayCastGdm
    voxels: tuple[int, int, int]
    directions: SphereGrid
    codes: int = 0

    @property
    def h(self) -> float:
        """Slab depth, tile units."""
        return self.caster.h

    @property
    def cap(self) -> float:
        """Longest distance, tile units."""
        return self.caster.cap

    @property
    def voxel(self) -> float:
        """The longest side of a voxel, tile units."""
        return gdm_query.voxel_side(self)

    @property
    def solid(self) -> "Solid":
        """1 where a voxel is inside of material."""
        return Solid(self)

    def samples(
        self, voxel: Int[Tensor, "*batch 8"], node: Int[Tensor, "*batch 4"], dtype: torch.dtype
    ) -> tuple[Float[Tensor, "*batch 8 4"], Float[Tensor, "*batch 8 4"]]:
        """Return distances in tile units, and 1 where they are of a hit."""
        shape = (*voxel.shape, 4)
        at = voxel.unsqueeze(-1).expand(shape).flatten()
        which, back = torch.unique(
            at * self._ways.shape[0] + node.unsqueeze(-2).expand(shape).flatten(), return_inverse=True
        )
        at, w = which // self._ways.shape[0], self._ways[which % self._ways.shape[0]]
        place, inside = self.places(at), self.solid[at] > 0.5
        t = torch.zeros(len(at))
        t[~inside], _ = self.caster.cast(place[~inside], w[~inside], inside[~inside])
        end = gdm_query.boundary(self, place, w)
        left = (t > end + BEHIND) & ~inside
        t = torch.where(left | inside, 0, torch.minimum(t, end))
        if self.codes:
            t = (t * (self.codes / self.cap)).round() * (self.cap / self.codes)
        return t.to(dtype)[back].reshape(shape), (~left).to(dtype)[back].reshape(shape)

    def evaluate(self, place: Float[Tensor, "*batch 3"], w: Float[Tensor, "*batch 3"]) -> Query:
        """Return how far it is from `place` along `w` to material; see `data.gdm.Gdm.evaluate`."""
        return gdm_query.query(self, place, w)

    def places(self, voxel: Int[Tensor, "*batch"]) -> Float[Tensor, "*batch 3"]:
        """Return where voxels are, by their numbers (layer * H + row) * W + column."""
        layers, height, width = self.voxels
        u = (voxel % width + 0.5) / width
        v = 1 - (voxel // width % height + 0.5) / height
        return torch.stack([u, v, -self.h + self.h * (voxel // (width * height)) / (layers - 1)], -1)

    @cached_property
    def _ways(self) -> Float[Tensor, "node 3"]:
        """Directions of nodes, those of a row at each pole alike."""
        pole = torch.tensor([0.0, 0.0, 1.0]).expand(1, self.directions.n_phi, 3)
        return torch.cat([pole, self.directions.directions(), -pole]).reshape(-1, 3)


@dataclass(frozen=True, eq=False)
class Solid:
    """Which voxels of a map are inside of material, found out when it is asked for."""

    of: Unbaked

    def __getitem__(self, voxel: Int[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """Return 1 where voxels are inside of material."""
        which, back = torch.unique(voxel.flatten(), return_inverse=True)
        return self.of.caster.inside(self.of.places(which)).float()[back].reshape(voxel.shape)


@dataclass(frozen=True, eq=False)
class Ray:
    """Answers by casting the ray of every question."""

    caster: RayCastGdm
    voxel: float = 0.0

    @property
    def cap(self) -> float:
        """Longest distance, tile units."""
        return self.caster.cap

    @property
    def h(self) -> float:
        """Slab depth, tile units."""
        return self.caster.h

    def evaluate(self, place: Float[Tensor, "n 3"], w: Float[Tensor, "n 3"]) -> Query:
        """Return how far it is from `place` along `w` to material; nothing is taken for inside."""
        t, _ = self.caster.cast(place.float(), w.float(), torch.zeros(len(place), dtype=torch.bool))
        end = gdm_query.boundary(self, place, w)
        left = t > end + BEHIND
        return Query(torch.where(left, end, torch.minimum(t.double(), end)), left, torch.full_like(end, torch.inf))


def finest(context: Context) -> Iterator[Row]:
    """The outline of a weave on a torus, over voxels, directions and look-ups, up to the ray itself."""
    meso = generators.weave(backing=True)
    mesh, camera = shapes.torus(triangles=12000, tiles=(5, 2)), view()
    twin = displace(mesh, meso, max_edge=0.05)
    built, entries, pixel = camera_entries(mesh, meso.h, camera)
    truth = RayScene(twin.vertices, twin.faces).first_hit(entries.origin.float(), entries.direction.float())
    mask = torch.zeros(SIZE * SIZE, dtype=torch.bool)
    mask[pixel[truth.face >= 0]] = True
    close = near_outline(mask.reshape(SIZE, SIZE)).flatten()
    own = close[pixel].nonzero()[:, 0]
    rays = Entries(entries.origin[own], entries.direction[own], entries.tet[own], entries.corner[own])
    right, n = truth.face[own] >= 0, int(close.sum())
    for k, (name, what, map_, queries) in enumerate(maps(RayCastGdm(meso, CAP), context)):
        context.report(f"bench finest: {name}", k / 20)
        # Whatever answers questions as a `Gdm` does can be walked through.
        found = gdm_trace.trace(built, cast("Gdm", map_), rays, queries=queries).hit
        extra, missed = (100 * float(x.sum()) / n for x in (found & ~right, ~found & right))
        texels, _, _ = name.partition(".")
        yield Row(
            id=f"finest.{name}", unit="%", better="higher", n=n,
            what=f"weave on 12,000 triangles, {what}: hit or miss as in truth, {NEAR} px around the outline",
            value=round(100 - extra - missed, 2), goal=99.5 if name == FINEST else None,
            peer=f"{extra:.2f} % wrongly hit, {missed:.2f} % wrongly pass",
            curve=None if name == "ray" else {"series": name.partition(".")[2], "x": int(texels), "y": "near"},
        )  # fmt: skip


def maps(caster: RayCastGdm, context: Context) -> Iterator[tuple[str, str, "Unbaked | Ray", int]]:
    """Yield maps of one mesostructure, ever finer, with their names and look-ups per prism; the ray itself first."""
    yield "ray", "a ray cast for every question", Ray(caster), 1
    sizes = ((64, 16), (128, 32)) if context.quick else SIZES
    for texels, n_theta in sizes:
        grid = SphereGrid(n_theta=n_theta, n_phi=2 * n_theta)
        map_ = Unbaked(caster, (texels // 2, texels, texels), grid)
        size = f"{texels}x{texels}x{texels // 2}x{n_theta}x{2 * n_theta}"
        for queries in (1, 8):
            yield f"{texels}.{n_theta}.{queries}", f"{size}, {queries} look-ups per prism", map_, queries
