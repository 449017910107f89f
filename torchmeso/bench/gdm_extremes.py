"""Shells at the edge of what can be rendered, and inputs beyond it, for the suite `stability`.

Test: tests/bench/test_gdm_extremes.py
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial
from typing import Literal

import torch

from torchmeso.bench import extremes
from torchmeso.bench.extremes import EYE, Case, Refusal, camera_at, dressed, placed, scene_of, small_torus, sun
from torchmeso.data.gdm import Gdm
from torchmeso.geometry import shapes, shell
from torchmeso.geometry.camera import Camera
from torchmeso.geometry.light import Light, PointLight
from torchmeso.geometry.mesh import Mesh
from torchmeso.meso import bake_gdm, generators
from torchmeso.meso.bake_gdm import GdmOptions
from torchmeso.render.scene import Material, Object, Scene, ShellOptions

OPTIONS = GdmOptions(texels=16, layers=8, n_theta=8, n_phi=16)

Base = Literal["solid", "open"]

BOUND = 0.3
"""Percent of pixels that may differ from float64: where a table is about to change its mind, rounding decides."""

MILLION = 1_000_000


def cases(size: int = 192) -> Iterator[Case]:
    """Yield every case; pictures of `size` x `size` pixels."""
    yield from _heights(size)
    yield from _eyes(size)
    yield from _lights(size)
    yield from _meshes(size)
    yield from _tables(size)
    yield from _places(size)
    yield from _company(size)


def million(size: int = 192) -> Case:
    """Return a shell of a million prisms."""
    body = shapes.torus(tiles=(80, 30), triangles=MILLION)
    # Prisms are smaller than pixels: a ray that rounding turns aside by 1e-6 passes others.
    return _case("million", "a shell of a million prisms", lambda: _on(body), size, bound=1.0)


def refusals() -> Iterator[Refusal]:
    """Yield every input that no shell can be made of."""
    weave = table("weave")
    for name, h in {"0": 0.0, "negative": -0.1, "nan": math.nan, "1e30": 1e30}.items():
        yield Refusal(name=f"gdm_height_{name}", what=f"a slab of depth {h:g}", make=partial(replace, weave, h=h))
        if h != 0:  # a shell without depth is one
            yield Refusal(
                name=f"shell_height_{name}", what=f"a shell of depth {h:g}",
            make=partial(shell.build, small_torus(), h),
        )  # fmt: skip
    shapes_of = {
        "no_voxel": {"distance": weave.distance[:, :0], "left": weave.left[:, :0]},
        "one_layer": {
            "distance": weave.distance[:1], "left": weave.left[:1], "occupancy": weave.occupancy[:1],
            "matter": weave.matter[:1],
        },
        "one_direction": {"distance": weave.distance[..., :1, :1], "left": weave.left[..., :1, :1]},
        "occupancy_nan": {"occupancy": weave.occupancy * math.nan},
        "occupancy_2": {"occupancy": weave.occupancy + 2},
        "matter_nan": {"matter": weave.matter * math.nan},
        "matter_inf": {"matter": weave.matter + math.inf},
        "distance_nan": {"distance": weave.distance.float() * math.nan},
        "distance_negative": {"distance": weave.distance.float() - 1},
        "distance_beyond_cap": {"distance": weave.distance.float() + 2 * weave.cap},
    }  # fmt: skip
    for name, parts in shapes_of.items():
        yield Refusal(
            name=f"gdm_{name}", what=f"a GDM of {name.replace('_', ' ')}", make=partial(replace, weave, **parts)
        )
    flat = replace(small_torus(), vertices=small_torus().vertices[:1].expand(len(small_torus().vertices), 3))
    yield Refusal(name="shell_no_area", what="a shell on a point", make=partial(shell.build, flat, 0.1))
    for name, options in {"side": {"side": "up"}, "base": {"base": "none"}, "queries": {"queries": 0}}.items():
        yield Refusal(name=f"shell_{name}", what=f"a shell of unknown {name}", make=partial(ShellOptions, **options))
    for name, number in {"0": 0, "one": 1}.items():
        yield Refusal(
            name=f"bake_directions_{name}", what=f"a bake of {number} directions",
            make=partial(replace, OPTIONS, n_theta=number, n_phi=number),
        )  # fmt: skip


@cache
def table(name: str, **arguments: object) -> Gdm:
    """Return a small GDM of a mesostructure."""
    return bake_gdm.in_memory(generators.GENERATORS[name](**arguments), OPTIONS)


def _case(
    name: str, what: str, objects: Callable[[], tuple[Object, ...]], size: int, *, eye=EYE, at=(0.0, 0.0, 0.0),
    lights: tuple[Light, ...] | None = None, bound: float = BOUND,
) -> Case:  # fmt: skip
    def make() -> tuple[Scene, Camera]:
        return scene_of(objects(), lights), camera_at(eye, at, size)

    return Case(name=name, what=what, make=make, bound=bound)


def _on(
    mesh: Mesh, gdm: Gdm | None = None, *, side: shell.Side = "inward", base: Base = "solid", floor: bool = True
) -> tuple[Object, ...]:
    """Return a mesh in a shell, above a plain floor."""
    material = Material(gdm=gdm or table("weave"), shell=ShellOptions(side=side, base=base), albedo=(0.2, 0.4, 0.3))
    ground = Object(mesh=shapes.plane(size=(6.0, 6.0)), material=Material())
    return Object(mesh=mesh, material=material), *((placed(ground, shift=(0.0, -0.6, 0.0)),) if floor else ())


def _heights(size: int) -> Iterator[Case]:
    for h, bound in ((1e-5, BOUND), (1e-3, BOUND), (10.0, 2 * BOUND)):  # in 10 tiles a float32 tells 1e-6 apart
        yield _case(
            f"height_{h:g}", f"a slab of {h:g} tiles", lambda h=h: _on(small_torus(), table("weave", h=h)), size,
            bound=bound,
        )  # fmt: skip
    for side in ("inward", "outward"):
        # One tile around the tube: the slab of 0.5 tiles is deeper than the tube's radius of 1 / (2 pi) tiles.
        yield _case(
            f"beyond_curvature_{side}", f"a slab deeper than the radius of curvature, {side}",
            lambda s=side: _on(shapes.torus(tiles=(3, 1), triangles=600), table("grass", h=0.5), side=s), size,
        )  # fmt: skip
        yield _case(
            f"thin_tube_{side}", f"a closed tube a tenth as thick as its shell is deep, {side}",
            lambda s=side: _on(shapes.torus(tube=0.03, tiles=(6, 0.2), triangles=600), side=s), size,
        )  # fmt: skip
        yield _case(
            f"overlap_{side}", f"a knot whose shell lies over itself, {side}",
            lambda s=side: _on(shapes.torus_knot(tiles=(4, 1), triangles=1200), table("chain"), side=s, base="open"),
            size, eye=(0.3, -1.6, 4.2),
        )  # fmt: skip


def _eyes(size: int) -> Iterator[Case]:
    torus = small_torus()
    eyes: dict[str, tuple[tuple[float, float, float], str]] = {
        "above_material": ((0.0, 0.395, 1.0), "weave"),
        "in_material": ((0.0, 0.37, 1.0), "weave"),
        "in_the_grass": ((0.0, 0.38, 1.0), "grass"),
        "below_the_shell": ((0.0, 0.1, 1.0), "weave"),
        "on_vertex": (tuple(torus.vertices[17].tolist()), "weave"),
        "on_edge": (tuple(torus.vertices[torus.faces[40, :2]].mean(0).tolist()), "weave"),
        "on_face": (tuple(torus.vertices[torus.faces[40]].mean(0).tolist()), "weave"),
    }
    for name, (eye, meso) in eyes.items():
        for base in ("solid", "open"):
            yield _case(
                f"eye_{name}_{base}", f"an eye {name.replace('_', ' ')}, base {base}",
                lambda m=meso, b=base: _on(small_torus(), table(m), base=b), size, eye=eye, at=(0.4, 0.41, 0.95),
            )  # fmt: skip


def _lights(size: int) -> Iterator[Case]:
    for deg in (0.1, 0.0, -0.1, -90.0):
        light = sun((math.cos(math.radians(deg)), math.sin(math.radians(deg)), 0.0))
        yield _case(
            f"light_{deg:g}deg", f"a light {deg:g} degrees above the horizon", lambda: _on(small_torus(), base="open"),
            size, lights=(light,),
        )  # fmt: skip
    for name, y in {"in_shell": 0.38, "on_top": 0.4, "inside": 0.1}.items():
        lamp = PointLight(position=torch.tensor([0.0, y, 1.0]), intensity=torch.full((3,), 0.1))
        yield _case(
            f"lamp_{name}", f"a point light {name.replace('_', ' ')}", lambda: _on(small_torus()), size, lights=(lamp,)
        )


def _meshes(size: int) -> Iterator[Case]:
    corners = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]), torch.tensor([[0, 1, 2]])
    one = dressed(*corners, torch.tensor([[0.0, 0.0], [2.0, 0.0], [0.0, 2.0]]))
    for base in ("solid", "open"):
        yield _case(f"one_triangle_{base}", f"one triangle, base {base}", lambda b=base: _on(one, base=b), size)
    bare = replace(small_torus(), normals=small_torus().normals * 0)
    yield _case("zero_normals", "normals of 0", lambda: _on(bare), size)
    against = replace(small_torus(), normals=-small_torus().normals)
    yield _case("turned_normals", "normals into the body", lambda: _on(against), size)
    level = replace(small_torus(), normals=small_torus().tangents)
    yield _case("level_normals", "normals along the surface", lambda: _on(level), size)
    kinds: tuple[tuple[shell.Side, Base], ...] = (("inward", "solid"), ("outward", "open"))
    for name, (what, *arrays) in extremes.raw_meshes().items():
        for side, base in kinds:
            # A texture drawn out into a line makes a tile a million units wide: the eye is deep in the shell.
            bound = 10 * BOUND if (name, side) == ("uv_almost_a_line", "inward") else BOUND
            yield _case(
                f"mesh_{name}_{side}", f"{what}, {side}",
                lambda a=arrays, s=side, b=base: _on(dressed(*a), side=s, base=b), size, bound=bound,
            )  # fmt: skip


def _tables(size: int) -> Iterator[Case]:
    weave = table("weave")
    shape, rng = weave.distance.shape, torch.Generator().manual_seed(0)
    nothing, all_of_it = torch.zeros(shape[:3]), torch.ones(shape[:3])
    noise = torch.randint(0, 256, shape, generator=rng, dtype=torch.uint8)
    one = {"distance": weave.distance[:2, :1, :1], "left": weave.left[:2, :1, :1]}
    tables: dict[str, tuple[str, Gdm]] = {
        "empty": ("an empty volume", replace(weave, left=weave.left | True, occupancy=nothing)),
        "solid": ("a solid volume", replace(weave, left=weave.left & False, occupancy=all_of_it)),
        "no_matter": ("material without properties", replace(weave, matter=weave.matter * 0)),
        "noise": ("noise", replace(weave, distance=noise, left=torch.rand(shape, generator=rng) < 0.5)),
        "zero": ("distances of 0 in open space", replace(weave, distance=noise * 0, occupancy=nothing)),
        "one_voxel": (
            "two layers of one voxel",
            replace(weave, **one, occupancy=nothing[:2, :1, :1], matter=weave.matter[:2, :1, :1]),
        ),
        "few_directions": (
            "two rings of three directions",
            replace(weave, distance=weave.distance[..., :2, :3], left=weave.left[..., :2, :3]),
        ),
    }  # fmt: skip
    for name, (what, gdm) in tables.items():
        for base in ("solid", "open"):
            yield _case(
                f"table_{name}_{base}", f"{what}, base {base}", lambda g=gdm, b=base: _on(small_torus(), g, base=b),
                size,
            )  # fmt: skip


def _places(size: int) -> Iterator[Case]:
    def home() -> tuple[Scene, Camera]:
        return scene_of(_on(small_torus())), camera_at(EYE, size=size)

    for scale in (1e-3, 1e3):
        yield Case(
            name=f"scale_{scale:g}", what=f"everything {scale:g} times as large, against the scene as it is",
            make=lambda s=scale: (
                scene_of(tuple(placed(o, scale=s) for o in _on(small_torus()))),
                camera_at([s * x for x in EYE], size=size),
            ),
            truth=home, bound=BOUND,
        )  # fmt: skip
    for far in (1e3, 1e5, 1e7):
        yield Case(
            name=f"far_{far:g}", what=f"everything {far:g} units away, against the scene at home",
            make=lambda d=far: (
                scene_of(tuple(placed(o, shift=(d, 0.0, d)) for o in _on(small_torus()))),
                camera_at((EYE[0] + d, EYE[1], EYE[2] + d), (d, 0.0, d), size),
            ),
            truth=home, bound=BOUND,
        )  # fmt: skip


def _company(size: int) -> Iterator[Case]:
    """Shells that share a place with others, and bodies only a part of which stands in one."""
    shelled, floor = _on(small_torus())
    carved = Object(mesh=small_torus(), material=extremes.brick())
    parts: dict[str, tuple[str, tuple[Object, ...]]] = {
        "twice": ("the same shell twice in one place", (shelled, shelled, floor)),
        "with_bricks": ("a shell and a carved body in one place", (shelled, carved, floor)),
        "through": ("two shells through one another", (shelled, placed(shelled, shift=(0.5, 0.1, 0.2)), floor)),
        "part": ("a body half in a shell, half carved", (_parted(shelled, extremes.brick()), floor)),
        "part_plain": ("a body half in a shell, half plain", (_parted(shelled, Material()), floor)),
        "alone": ("a shell alone", (shelled,)),
    }  # fmt: skip
    for name, (what, objects) in parts.items():
        yield _case(name, what, lambda o=objects: o, size)


def _parted(item: Object, other: Material) -> Object:
    """Return a body every other quad of which looks otherwise."""
    return replace(item, others=(other,), part=(torch.arange(len(item.mesh.faces)) % 4 < 2).long())
