"""Tiled surfaces of the suite `synthesize`: what borders of quads show, how fast they are dressed anew, and frames.

Meshes are those of the folder of real inputs. Across the border of two quads the outermost texels of their tiles meet;
where frames turn there, light and view turn with them. These are counted apart.

Test: tests/bench/test_surfaces.py
"""

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchmeso.bench import frames, gdm_speed, scenes, speed
from torchmeso.bench.suite import Context, Row
from torchmeso.bench.timing import time_together
from torchmeso.bench.wang import grown, pictures
from torchmeso.config import data_dir
from torchmeso.config_sections import MaterialConfig
from torchmeso.data import address, tiled_surface
from torchmeso.data.eigen_btf import EigenBtf
from torchmeso.data.tile_set import TileSet
from torchmeso.data.tiled_surface import TiledSurface
from torchmeso.geometry import quads
from torchmeso.geometry.directions import from_angles
from torchmeso.pipeline import bake, dress
from torchmeso.render.scene import Object, Scene, quilted
from torchmeso.render.silhouette import Silhouette
from torchmeso.synthesize.parameterize import SurfaceOptions

SURFACES = (
    ("3holes", "3holes.off", SurfaceOptions(by="quadriflow")),
    ("bunny", "bunny.off", SurfaceOptions(by="quadriflow", quads=800)),
    ("polycube", "bunny_01k_polycube.obj", SurfaceOptions(by="polycube")),
)
"""Name, file and quads of each mesh."""

PAIRS = 20
"""Pairs of light and view that borders are looked at under."""

ABSENT = "the folder of real inputs is absent: set TORCHMESO_DATA"


class Borders(NamedTuple):
    """Squared differences across borders of quads.

    Attributes:
        plain: where frames go on.
        turned: where they turn.
    """

    plain: Float[Tensor, "n"]
    turned: Float[Tensor, "m"]


def borders(surface: TiledSurface, tiles: TileSet, shown: Sequence[Float[Tensor, "H W C"]]) -> Borders:
    """Return what texels that meet across borders of quads differ by.

    Args:
        surface: laid out.
        tiles: on it.
        shown: the exemplar under one light and view, and under the same turned by 90, 180 and 270 deg clockwise: what
            it shows in frames that are turned anticlockwise by as much.
    """
    sides = _sides(tiles.shown().long())[tiles.find(surface.colours)]
    around = quads.edges(surface.quads)
    turn = torch.zeros(sides.shape[:2], dtype=torch.long)
    turn[surface.jumps[:, 0], surface.jumps[:, 1]] = surface.jumps[:, 2]
    own = torch.arange(sides.shape[0] * 4).reshape(-1, 4)
    face, side = ((around.beside >= 0) & (own < around.beside)).nonzero().unbind(1)
    beyond = around.beside[face, side]
    # Of a jump that is listed at the other side the frame turns back.
    back = turn.flatten()[beyond]
    turn = torch.where(turn[face, side] > 0, turn[face, side], -back % 4)
    one, other = sides[face, side], sides.flatten(0, 1)[beyond].flip(1)  # the other runs the other way
    looks = torch.stack([x.flatten(0, 1) for x in shown])
    energy = (looks[0][one] - looks[turn[:, None], other]).square().sum(-1)
    return Borders(energy[turn == 0].flatten(), energy[turn != 0].flatten())


def _sides(texels: Int[Tensor, "T w w"]) -> Int[Tensor, "T 4 w"]:
    """Return the outermost texels of tiles: south, east, north, west, anticlockwise."""
    return torch.stack([texels[:, -1], texels[:, :, -1].flip(1), texels[:, 0].flip(1), texels[:, :, 0]], 1)


def energy(
    pairs: Sequence[Sequence[Float[Tensor, "H W C"]]], surface: TiledSurface, tiles: TileSet, wraps: bool
) -> Tensor:
    """Return (n, 2) 99th percentiles across borders, and across those where frames turn, over the exemplar's own."""
    found = []
    for shown in pairs:
        picture = shown[0]
        inside = torch.cat([
            d.square().sum(-1).narrow(axis, 0, picture.shape[axis] - (not wraps)).flatten()
            for axis, d in ((axis, picture.roll(-1, axis) - picture) for axis in (1, 0))
        ])  # fmt: skip
        own = max(_percentile(inside), 1e-30)
        found.append([_percentile(x) / own if len(x) else math.nan for x in borders(surface, tiles, shown)])
    return torch.tensor(found)


def _percentile(x: Tensor) -> float:
    return float(np.percentile(x.double().numpy(), 99))


def relit(look: EigenBtf) -> Iterator[list[Float[Tensor, "H W 3"]]]:
    """Yield a BTF under random pairs of light and view, to 70 degrees, and under each turned three times."""
    rng = torch.Generator().manual_seed(0)
    uv = address.texel_centres(*look.texels)
    for angles in torch.rand(PAIRS, 4, generator=rng):
        shown = []
        for quarter in range(4):
            wi, wo = (
                from_angles(1.22 * angles[k], 6.2832 * angles[k + 1] - quarter * math.pi / 2).expand(*uv.shape[:2], 3)
                for k in (0, 2)
            )
            shown.append(look.evaluate(uv, wi, wo))
        yield shown


def surfaces(tiles: TileSet) -> Iterator[tuple[str, TiledSurface]]:
    """Yield the meshes of the folder of real inputs, laid out."""
    for name, file, options in SURFACES:
        path = data_dir() / "mesh" / file
        if path.is_file():
            yield name, dress.surface(path, tiles, options)


def seams(context: Context) -> Iterator[Row]:
    """What borders of quads show, of pictures and of a relit BTF."""
    wanted = MaterialConfig.model_validate({"meso": {"type": "bark"}, **frames.SMALL})
    look = bake.prepare_material("bark", wanted, context.report, depth=False).material.btf
    assert isinstance(look, EigenBtf)
    sets = [
        (
            "bark",
            "bark BTF under 20 pairs of light and view",
            grown(look, "any", toroidal=True),
            list(relit(look)),
            True,
        )
    ]
    few = [(name, picture) for name, picture in pictures() if name in ("t4", "t5")]
    sets += [(name, f"picture {name}, sRGB", grown(p, "any"), [[p] * 4], False) for name, p in few]
    for name, what, tiles, shown, wraps in sets:
        rows = list(surfaces(tiles))
        for mesh, surface in rows:
            found = energy(shown, surface, tiles, wraps).median(0).values.tolist()
            yield Row(
                id=f"surface.seams.{mesh}.{name}", unit="x", better="lower", goal=1.1, value=round(found[0], 3),
                what=f"{what}, 96 tiles on {mesh}, {len(surface.quads)} quads: 99th percentile of squared differences "
                "across borders of quads over the exemplar's own, in the middle; where frames turn apart",
                peer=f"{len(surface.jumps)} of {int((quads.edges(surface.quads).beside >= 0).sum()) // 2} edges turn, "
                f"there {found[1]:.2f} x", n=len(shown),
            )  # fmt: skip
        if not rows:
            yield Row(id=f"surface.seams.{name}", what=what, value=None, unit="x", better="lower", goal=1.1, why=ABSENT)


def re_dressing(context: Context) -> Iterator[Row]:
    """From a surface and another set of tiles to texture coordinates and a map."""
    row = {"id": "surface.redress.bunny", "unit": "ms", "better": "lower", "goal": 50.0}
    what = "the bunny in another set of 96 tiles of 64 x 64 texels: texture coordinates and the map, without an upload"
    few = [(name, picture) for name, picture in pictures() if name == "t5"]
    if not few:
        yield Row(**row, what=what, value=None, why=ABSENT)
        return
    tiles = grown(few[0][1], "any")
    surface = next(found for name, found in surfaces(tiles) if name == "bunny")
    ready = tiled_surface.base(surface)
    took = time_together({"dress": lambda: tiled_surface.dress(ready, surface, tiles)}, n=9, warm=2)["dress"]
    yield Row(
        **row, what=what, value=round(min(took.wall, took.cpu), 2), n=took.n,
        spread=(round(took.low, 2), round(took.high, 2)),
        peer=f"wall {took.wall:.1f} ms, CPU/cores {took.cpu:.1f} ms; {len(surface.faces)} triangles",
    )  # fmt: skip


def frame_cost(context: Context) -> Iterator[Row]:
    """The bunny tiled and with the same BTF repeated, 800 x 600."""
    row = {"id": "surface.frame", "unit": "x", "better": "lower", "goal": 1.15}
    what = "frame of the bunny, 800 x 600, bark BTF, filtered: tiled over the same BTF repeated over the same triangles"
    path = data_dir() / "mesh" / "bunny.off"
    if not path.is_file():
        yield Row(**row, what=what, value=None, why=ABSENT)
        return
    wanted = MaterialConfig.model_validate({"meso": {"type": "bark"}, **frames.SMALL})
    material = bake.prepare_material("bark", wanted, context.report).material
    assert isinstance(material.btf, EigenBtf)
    tiles = grown(material.btf, "any", toroidal=True)
    surface = dress.surface(path, tiles, SURFACES[1][2])
    dressed = tiled_surface.dress(tiled_surface.base(surface), surface, tiles)
    dressings = {
        kind: Scene(objects=(Object(mesh=dressed.mesh, material=x),), lights=(gdm_speed.LIGHT,))
        for kind, x in (("plain", material), ("tiled", quilted(material, dressed.map)))
    }
    kinds: tuple[tuple[str, Silhouette], ...] = (("btf", "none"), ("silhouette", "curved"))
    for name, silhouette in kinds:
        shown = {kind: speed.renderer(s, silhouette, shadows=False, filtering=True) for kind, s in dressings.items()}
        camera = scenes.view((-0.07, 0.16, 0.33), (-0.017, 0.11, 0.0), fov_deg=32)
        calls: dict[str, Callable[[], object]] = {kind: partial(r.show, camera) for kind, r in shown.items()}
        timing = time_together(calls, n=9 if context.quick else 25, warm=3, settle=2)
        plain, own = timing["plain"], timing["tiled"]
        yield Row(
            **{**row, "id": f"surface.frame.{name}"}, what=f"{what}, silhouettes {silhouette}",
            value=round(own.cpu / plain.cpu, 3), n=own.n,
            peer=f"plain {plain.wall:.2f} ms (CPU/cores {plain.cpu:.2f}), tiled {own.wall:.2f} ms ({own.cpu:.2f})",
        )  # fmt: skip
