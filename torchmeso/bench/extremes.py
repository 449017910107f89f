"""Scenes at the edge of what can be rendered, and inputs beyond it: what the suite `stability` is made of.

Test: tests/bench/test_extremes.py
"""

import math
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache, partial

import torch
from torch import Tensor

from torchmeso.compress import eigen
from torchmeso.compress.eigen import EigenOptions
from torchmeso.data.btf import Btf
from torchmeso.data.mdf import Mdf
from torchmeso.geometry import hemisphere, mesh, shapes
from torchmeso.geometry.camera import Camera, look_at
from torchmeso.geometry.light import DirectionalLight, Light, PointLight
from torchmeso.geometry.mesh import Mesh, dress
from torchmeso.meso import bake_btf, bake_mdf, generators
from torchmeso.meso.bake_btf import BtfOptions
from torchmeso.meso.bake_mdf import MdfOptions
from torchmeso.render.scene import Material, Object, Scene

EYE = (1.5, 2.0, 3.5)
"""Where pictures are taken from unless a case says otherwise."""

VIEWS = "grid(8, 3, 80)"


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Case:
    """A picture that must come out whole, on both backends.

    Attributes:
        name: of the row.
        what: half a sentence.
        make: builds scene and camera.
        truth: builds what the picture is held against in float64; None = the same scene.
        bound: largest share of pixels, in percent, that may differ from it by more than 1/255.
        exposure: what pictures are multiplied by before they are compared.
    """

    name: str
    what: str
    make: "Callable[[], tuple[Scene, Camera]]"
    truth: "Callable[[], tuple[Scene, Camera]] | None" = None
    bound: float = 0.1
    exposure: float = 1.0


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Refusal:
    """An input that must be refused with a MesoError."""

    name: str
    what: str
    make: Callable[[], object]


def cases(size: int = 192) -> Iterator[Case]:
    """Yield every case; pictures of `size` x `size` pixels."""
    yield from _views(size)
    yield from _places(size)
    yield from _meshes(size)
    yield from _tables(size)


def grazing(deg: float, size: int) -> tuple[Scene, Camera]:
    """Return the still life seen at `deg` degrees from the floor's normal."""
    rise = math.radians(90 - deg)
    return scene_of(), camera_at((0.0, -0.6 + 5 * math.sin(rise), 5 * math.cos(rise)), (0.0, -0.6, 0.0), size)


def moved_to(distance: float, size: int) -> tuple[Scene, Camera]:
    """Return the still life, with its camera, far out along x and z."""
    scene = scene_of(tuple(placed(o, shift=(distance, 0.0, distance)) for o in _still_life()))
    eye, at = (EYE[0] + distance, EYE[1], EYE[2] + distance), (distance, 0.0, distance)
    return scene, camera_at(eye, at, size)


def table(spectrum: Tensor, seed: int = 0) -> Btf:
    """Return a BTF whose matrix (texels, lights and colours x views) has the singular values `spectrum`, float32."""
    directions = hemisphere.parse(VIEWS)
    n, rows = len(directions), len(directions) * 8 * 8 * 3
    rng = torch.Generator().manual_seed(seed)
    left = torch.linalg.qr(torch.randn(rows, n, generator=rng, dtype=torch.float64))[0]
    right = torch.linalg.qr(torch.randn(n, n, generator=rng, dtype=torch.float64))[0]
    matrix = (left * spectrum.double()) @ right.T
    images = matrix.reshape(n, 8, 8, 3, n).permute(0, 4, 1, 2, 3).contiguous().float()
    return Btf(images=images, lights=directions, views=directions)


def _views(size: int) -> Iterator[Case]:
    for deg in (89.0, 89.9, 89.99):
        yield Case(name=f"view_{deg:g}deg", what=f"the floor seen at {deg:g} degrees", make=partial(grazing, deg, size))
    for deg in (0.1, 0.0, -0.1):
        light = sun((math.cos(math.radians(deg)), math.sin(math.radians(deg)), 0.0))
        yield Case(
            name=f"light_{deg:g}deg", what=f"a light {deg:g} degrees above the horizon",
            make=lambda light=light: (scene_of(lights=(light,)), camera_at(EYE, size=size)),
        )  # fmt: skip
    eyes = {
        "inside_object": (0.0, 0.0, 1.0),
        "inside_slab": (0.0, 0.39, 1.0),
        "on_surface": (0.0, 0.4, 1.0),
        "on_vertex": tuple(small_torus().vertices[17].tolist()),
        "under_floor": (0.3, -0.62, 0.2),
    }
    for name, eye in eyes.items():
        yield Case(
            name=f"eye_{name}", what=f"an eye {name.replace('_', ' ')}",
            make=lambda eye=eye: (scene_of(), camera_at(eye, (0.1, 0.1, 0.0), size)), bound=0.5,
        )  # fmt: skip
    for width, height in ((1, 1), (1, 64), (64, 1)):
        yield Case(
            name=f"picture_{width}x{height}", what=f"a picture of {width} x {height} pixels",
            make=lambda w=width, h=height: (scene_of(), replace(camera_at(EYE, size=size), width=w, height=h)),
        )  # fmt: skip
    place = torch.tensor([0.0, 0.4, 1.0])
    for name, position in {"on_surface": place, "on_vertex": small_torus().vertices[17], "inside": place * 0.9}.items():
        lamp = PointLight(position=position, intensity=torch.ones(3))
        yield Case(
            name=f"lamp_{name}", what=f"a point light {name.replace('_', ' ')}",
            make=lambda lamp=lamp: (scene_of(lights=(lamp,)), camera_at(EYE, size=size)), bound=0.5,
        )  # fmt: skip


def _places(size: int) -> Iterator[Case]:
    def home() -> tuple[Scene, Camera]:
        return scene_of(), camera_at(EYE, size=size)

    for scale in (1e-3, 1e3):
        yield Case(
            name=f"scale_{scale:g}", what=f"everything {scale:g} times as large, against the scene as it is",
            make=lambda s=scale: (
                scene_of(tuple(placed(o, scale=s) for o in _still_life())), camera_at([s * x for x in EYE], size=size),
            ),
            truth=home,
        )  # fmt: skip
    for distance in (1e3, 1e5, 1e7):
        yield Case(
            name=f"far_{distance:g}", what=f"everything {distance:g} units away, against the scene at home",
            make=partial(moved_to, distance, size), truth=home,
        )  # fmt: skip


def raw_meshes() -> dict[str, tuple[str, Tensor, Tensor, Tensor]]:
    """Return meshes that something is wrong with: what, and their vertices, faces and texture coordinates."""
    torus, rng = small_torus(), torch.Generator().manual_seed(0)
    v, f, uv = torus.vertices, torus.faces, torus.uv
    needles = torch.tensor(
        [[0, 0.5, 0], [1, 0.5, 1e-7], [2, 0.5, 0], [0, 0.6, 0], [1e-8, 0.6, 0], [0, 0.6, 2], [0, 0.7, 0], [1, 0.7, 1]]
    )
    third = (torch.arange(len(uv)) % 3 == 0)[:, None]
    every_other = (torch.arange(len(f)) % 2 == 0)[:, None]
    fins = torch.stack([f[:50, 0], f[:50, 1], f[:50, 2].roll(1)], 1)
    kept = torch.rand(len(f), generator=rng) > 0.1
    more = torch.tensor([[0, 1, 2], [3, 4, 5], [6, 7, 6]])
    soup = torch.rand(600, 3, generator=rng) * 2 - 1, torch.randint(0, 600, (1500, 3), generator=rng)
    return {
        "zero_area": ("triangles without area", v, torch.cat([f, f[::3, [0, 0, 1]], f[::5, [0, 0, 0]]]), uv),
        "needles": (
            "triangles 1e-7 thin", torch.cat([v, needles]), torch.cat([f, len(v) + more]),
            torch.cat([uv, torch.rand(len(needles), 2, generator=rng)]),
        ),
        "duplicated": ("every face twice", v, torch.cat([f, f]), uv),
        "two_sided": ("every face twice, back to back", v, torch.cat([f, f.flip(1)]), uv),
        "non_manifold": ("fins on edges", v, torch.cat([f, fins]), uv),
        "open": ("a third of the body cut away", v, f[:400], uv),
        "holes": ("a tenth of the faces missing", v, f[kept], uv),
        "flipped": ("a body turned inside out", v, f.flip(1), uv),
        "half_flipped": ("every other face turned", v, torch.where(every_other, f, f.flip(1)), uv),
        "uv_at_1e4": ("texture coordinates around 1e4", v, f, uv + 1e4),
        "uv_at_1e6": ("texture coordinates around 1e6", v, f, uv + 1e6),
        "uv_negative": ("mirrored texture coordinates below 0", v, f, -uv - 100),
        "uv_collapsed": ("a third of the texture coordinates on one point", v, f, torch.where(third, 0.5, uv)),
        "uv_almost_a_line": ("a texture stretched 1e12 times", v, f, uv * torch.tensor([1.0, 1e-12])),
        "soup": ("random triangles", *soup, torch.rand(600, 2, generator=rng) * 4),
    }  # fmt: skip


def _meshes(size: int) -> Iterator[Case]:
    torus = small_torus()
    for name, (what, *arrays) in raw_meshes().items():
        yield Case(
            name=f"mesh_{name}", what=what,
            make=lambda a=arrays: (scene_of(_with_floor(dressed(*a))), camera_at(EYE, size=size)),
        )  # fmt: skip
    for name, tangents in {"zero": torus.tangents * 0, "along_normals": torus.normals}.items():
        yield Case(
            name=f"tangents_{name}", what=f"tangents {name.replace('_', ' ')}",
            make=lambda t=tangents: (scene_of(_with_floor(replace(torus, tangents=t))), camera_at(EYE, size=size)),
        )  # fmt: skip


def _tables(size: int) -> Iterator[Case]:
    rng = torch.Generator().manual_seed(0)
    n = len(hemisphere.parse(VIEWS))
    noise = torch.rand(n, n, 8, 8, 3, generator=rng)
    flat = torch.rand(n, 1, 8, 8, 3, generator=rng).expand(n, n, 8, 8, 3)
    reflectances: dict[str, tuple[str, Tensor, int, str]] = {
        "constant": ("constant texels at full rank", torch.full_like(noise, 0.5), n, VIEWS),
        "zero": ("texels of 0", torch.zeros_like(noise), 4, VIEWS),
        "negative": ("negative texels", -noise, 4, VIEWS),
        "large": ("texels of 1e12", noise * 1e12, 4, VIEWS),
        "small": ("texels of 1e-38", noise * 1e-38, 4, VIEWS),
        "rank_above": ("24 components of a matrix of rank 1", flat, n, VIEWS),
        "one_direction": ("one direction of light and view", noise[:1, :1], 1, "grid(1, 1, 45)"),
        "one_texel": ("one texel", noise[..., :1, :1, :], 4, VIEWS),
    }
    for name, (what, images, rank, directions) in reflectances.items():
        yield Case(
            name=f"btf_{name}", what=what, exposure=1e-12 if name == "large" else 1.0,
            make=lambda i=images, r=rank, d=directions: (
                scene_of(_with_floor(small_torus(), replace(brick(), btf=_fitted(i, r, d)))), camera_at(EYE, size=size),
            ),
        )  # fmt: skip
    one, many = hemisphere.parse("grid(1, 1, 45)"), hemisphere.parse("grid(8, 4, 87.5)")
    codes = torch.randint(0, 256, (len(many), 8, 8), generator=rng, dtype=torch.uint8)
    holes = torch.rand(codes.shape, generator=rng) < 0.5
    depths: dict[str, tuple[str, Mdf]] = {
        "no_hits": ("an MDF without a hit", Mdf(delta=codes * 0, no_hit=holes | True, directions=many, h=0.1)),
        "top": ("an MDF of drop 0", Mdf(delta=codes * 0, no_hit=None, directions=many, h=0.1)),
        "bottom": ("an MDF of full drop", Mdf(delta=codes * 0 + 255, no_hit=None, directions=many, h=0.1)),
        "noise": ("an MDF of noise with holes", Mdf(delta=codes, no_hit=holes, directions=many, h=0.1)),
        "thin": ("a slab of 1e-6 tiles", Mdf(delta=codes, no_hit=None, directions=many, h=1e-6)),
        "thick": ("a slab of 1000 tiles", Mdf(delta=codes, no_hit=None, directions=many, h=1e3)),
        "one_direction": ("an MDF of one view", Mdf(delta=codes[:1], no_hit=None, directions=one, h=0.1)),
        "one_texel": ("an MDF of one texel", Mdf(delta=codes[:, :1, :1], no_hit=None, directions=many, h=0.1)),
    }
    for name, (what, mdf) in depths.items():
        yield Case(
            name=f"mdf_{name}", what=what,
            make=lambda m=mdf: (
                scene_of(_with_floor(small_torus(), replace(brick(), mdf=m))), camera_at(EYE, size=size),
            ),
        )  # fmt: skip


def refusals() -> Iterator[Refusal]:
    """Yield every input that no picture can be made of."""
    n = len(hemisphere.parse(VIEWS))
    texels = torch.rand(n, n, 8, 8, 3, generator=torch.Generator().manual_seed(0))
    for name, value in {"nan": math.nan, "inf": math.inf, "minus_inf": -math.inf, "1e30": 1e30}.items():
        spoilt = texels.clone()
        spoilt[3, 4, 2, 1], spoilt[5, 6, 7] = value, value
        yield Refusal(name=f"btf_{name}", what=f"texels of {value}", make=partial(_fitted, spoilt, 4, VIEWS))
    for rank in (0, n + 1):
        yield Refusal(name=f"rank_{rank}", what=f"rank {rank} of {n} views", make=partial(_fitted, texels, rank, VIEWS))
    yield Refusal(name="btf_no_texel", what="no texel", make=partial(_fitted, texels[..., :0, :0, :], 4, VIEWS))
    views = hemisphere.parse("grid(8, 4, 87.5)")
    for name, drop in {"nan": math.nan, "above_1": 5.0}.items():
        delta = torch.full((len(views), 8, 8), drop)
        yield Refusal(
            name=f"mdf_{name}", what=f"an MDF of drops {drop}",
            make=partial(Mdf, delta=delta, no_hit=None, directions=views, h=0.1),
        )  # fmt: skip
    torus = small_torus()
    v, f, uv = torus.vertices, torus.faces, torus.uv
    meshes = {
        "nan": (v * math.nan, f, uv),
        "1e30": (v * 1e30, f, uv),
        "no_face": (v, f[:0], uv),
        "numbers": (v, f + 100, uv),
        "uv_on_a_line": (v, f, uv * torch.tensor([1.0, 0.0])),
        "uv_1e30": (v, f, uv * 1e30),
    }
    for name, arrays in meshes.items():
        yield Refusal(name=f"mesh_{name}", what=f"a mesh of {name.replace('_', ' ')}", make=partial(dress, *arrays))
    up, white = torch.tensor([0.0, 1.0, 0.0]), torch.ones(3)
    for name, direction, power in (
        ("no_direction", up * 0, white),
        ("nan", up, white * math.nan),
        ("dark", up, -white),
    ):
        make = partial(DirectionalLight, direction=direction, irradiance=power)
        yield Refusal(name=f"light_{name}", what=f"a light of {name.replace('_', ' ')}", make=make)
    for name, options in {"eye": {"eye": (math.nan, 0, 0)}, "near": {"near": math.nan}, "size": {"size": 0}}.items():
        yield Refusal(
            name=f"camera_{name}", what=f"a camera without {name}", make=partial(camera_at, **{"eye": EYE, **options})
        )


def camera_at(eye, at=(0.0, 0.0, 0.0), size: int = 64, **options) -> Camera:
    """Return a square picture from `eye` to `at`, y up."""
    place, axes = look_at(*(torch.tensor(x, dtype=torch.float64) for x in (eye, at, (0.0, 1.0, 0.0))))
    return Camera(eye=place, axes=axes, **{"width": size, "height": size, **options})


def sun(direction: tuple[float, float, float]) -> DirectionalLight:
    """Return a light that gives a white diffuser facing it radiance 1."""
    towards = torch.nn.functional.normalize(torch.tensor(direction), dim=0)
    return DirectionalLight(direction=towards, irradiance=torch.full((3,), torch.pi))


def scene_of(objects: tuple[Object, ...] | None = None, lights: tuple[Light, ...] | None = None) -> Scene:
    """Return objects in the sun, the still life unless told otherwise, before a background of its own."""
    lights = (sun((1.0, 2.0, 1.0)),) if lights is None else lights
    return Scene(objects=objects or _still_life(), lights=lights, background=(0.1, 0.2, 0.3))


@cache
def small_torus() -> Mesh:
    """Return the body that most cases wear out."""
    return shapes.torus(tiles=(6, 2), triangles=600)


@cache
def brick() -> Material:
    """Return bricks with relief."""
    options = BtfOptions(texels=16, lights=VIEWS, views=VIEWS, samples=1, bounces=0)
    model = eigen.fit(bake_btf.in_memory(generators.brick(), options), EigenOptions(rank=6))
    depth = bake_mdf.in_memory(generators.brick(), MdfOptions(texels=32, views="grid(8, 4, 87.5)"))
    return Material(btf=model, mdf=depth)


@cache
def _weave() -> Material:
    options = MdfOptions(texels=32, views="grid(8, 4, 87.5)")
    return Material(mdf=bake_mdf.in_memory(generators.weave(), options), albedo=(0.7, 0.5, 0.3))


@cache
def _floor() -> Object:
    plane = Object(mesh=shapes.plane(size=(6.0, 6.0), tiles=(4, 4)), material=brick())
    return placed(plane, shift=(0.0, -0.6, 0.0))


@cache
def _still_life() -> tuple[Object, ...]:
    """A torus of bricks, a woven cylinder with holes, and a floor of bricks."""
    can = Object(mesh=shapes.cylinder(radius=0.3, height=0.8, tiles=(4, 2), triangles=400), material=_weave())
    return Object(mesh=small_torus(), material=brick()), placed(can, shift=(1.3, 0.0, 0.0)), _floor()


def _with_floor(subject: Mesh, material: Material | None = None) -> tuple[Object, ...]:
    return Object(mesh=subject, material=material or brick()), _floor()


def placed(item: Object, scale: float = 1.0, shift: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Object:
    """Return an object elsewhere."""
    matrix = torch.eye(4, dtype=torch.float64) * scale
    matrix[:, 3] = torch.tensor([*shift, 1.0], dtype=torch.float64)
    return replace(item, mesh=mesh.transform(item.mesh, matrix))


def dressed(vertices: Tensor, faces: Tensor, uv: Tensor) -> Mesh:
    """Return a mesh of arrays that something is wrong with."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what is wrong with these meshes is known
        return dress(vertices, faces, uv)


def _fitted(images: Tensor, rank: int, directions: str) -> eigen.EigenBtf:
    of = hemisphere.parse(directions)
    return eigen.fit(Btf(images=images, lights=of, views=of), EigenOptions(rank=rank))
