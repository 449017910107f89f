"""What is rendered: meshes with materials, lights, and the flat arrays a frame works on.

Test: tests/render/test_scene.py
"""

from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchmeso.data.btf import Evaluable
from torchmeso.errors import ConfigError, check_range, check_shape
from torchmeso.geometry import frames
from torchmeso.geometry.camera import Camera
from torchmeso.geometry.frames import Frame
from torchmeso.geometry.light import DirectionalLight, Light
from torchmeso.geometry.mesh import FAR, Mesh
from torchmeso.render.rasterize import Layers, barycentric


@runtime_checkable
class DistanceFunction(Protocol):
    """Anything that says how deep the mesostructure lies: `data.Mdf`, or a ray caster standing in for it.

    `h` is the slab depth in tile units, `no_hit` None where every ray hits, `delta_max` the largest drop
    D cos(theta) / h.
    """

    @property
    def h(self) -> float: ...  # noqa: D102
    @property
    def no_hit(self) -> Tensor | None: ...  # noqa: D102
    @property
    def delta_max(self) -> float: ...  # noqa: D102

    def evaluate(self, uv: Float[Tensor, "n 2"], wo: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Return D(uv, wo) in tile units; inf = no hit."""
        ...

    def distance(self, uv: Float[Tensor, "n 2"], wo: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Return D(uv, wo) as well as is known, for the few rays whose answer decides a silhouette."""
        ...

    def depth(self, uv: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch"]:
        """Return how deep the material lies straight below `uv`, in tile units; inf = a hole."""
        ...


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Material:
    """How a surface looks.

    Attributes:
        btf: reflectance with meso-scale detail, or None for a plain diffuse surface.
        mdf: depth of the mesostructure, or None: no silhouette detail, and shadows fall on the mesh itself.
        albedo: (3,) linear RGB of a plain surface; unused with a BTF.
    """

    btf: Evaluable | None = None
    mdf: DistanceFunction | None = None
    albedo: tuple[float, float, float] = (0.6, 0.6, 0.6)


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Object:
    """A mesh with a material, or with one for each part of it.

    A body of several materials stays one mesh: whether it is closed, and where a ray is inside of it, is asked of the
    whole.

    Attributes:
        mesh: where it stands.
        material: of all faces, or of those whose `part` is 0.
        others: of faces whose `part` is 1, 2, ...
        part: (F,) which of `materials` each face has; None = all have the first.
    """

    mesh: Mesh
    material: Material
    others: tuple[Material, ...] = ()
    part: Int[Tensor, "F"] | None = None

    def __post_init__(self) -> None:
        """Raise ShapeError or ConfigError unless every face has a material that is there."""
        if self.part is None:
            return
        check_shape("object.part", self.part, (len(self.mesh.faces),))
        if len(self.part):
            check_range("object.part", float(self.part.min()), 0, len(self.others))
            check_range("object.part", float(self.part.max()), 0, len(self.others))

    @property
    def materials(self) -> tuple[Material, ...]:
        """All materials, as `part` counts them."""
        return (self.material, *self.others)


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Scene:
    """Objects and lights.

    Attributes:
        objects: at least one.
        lights: any number.
        ambient: radiance factor of the ambient term L_a.
        ambient_rule: "add" adds ambient L_a to every pixel; "paper" shows it only where no light arrives
            (wang2005mdf, section 4.2).
        background: linear RGB where nothing is seen.
    """

    objects: tuple[Object, ...]
    lights: tuple[Light, ...]
    ambient: float = 0.05
    ambient_rule: str = "add"
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        """Raise ConfigError for a scene no picture can be made of."""
        if not self.objects:
            raise ConfigError("scene: expected at least one object, got none")
        if self.ambient_rule not in ("add", "paper"):
            raise ConfigError(f"scene.ambient_rule: expected 'add' or 'paper', got '{self.ambient_rule}'")
        check_range("scene.ambient", self.ambient, 0, 1e20)
        for value in self.background:
            check_range("scene.background", value, -1e20, 1e20)

    @property
    def surfaces(self) -> tuple[Material, ...]:
        """The materials of all objects, one behind the other: what `World.owner` counts."""
        return tuple(m for o in self.objects for m in o.materials)


def in_double(scene: Scene) -> Scene:
    """Return `scene` in float64: torch renders as precisely as meshes are given, and others are held against this.

    Codes of tables stay as they are. Kernels read float32 and show the same picture.
    """
    return _in_double(scene)


def _in_double(x: Any) -> Any:
    if isinstance(x, Tensor):
        return x.double() if x.is_floating_point() else x
    if isinstance(x, tuple):
        return type(x)(*map(_in_double, x)) if hasattr(x, "_fields") else tuple(map(_in_double, x))
    if is_dataclass(x) and not isinstance(x, type):
        return replace(x, **{f.name: _in_double(getattr(x, f.name)) for f in fields(x) if f.init})
    return x


class World(NamedTuple):
    """All meshes of a scene as one.

    Attributes:
        vertices: (V, 3).
        faces: (F, 3).
        uv: (V, 2).
        normals: (V, 3).
        tangents: (V, 3).
        sign: (V,).
        scale: (V,) texture scale.
        component: (F,) component, numbered through all objects.
        closed: (C,) whether a component is closed.
        owner: (F,) surface each face belongs to: its object's material, see `Scene.surfaces`.
        object: (surface,) object each surface belongs to.
        origin: (3,) float64 where the vertices' origin lies in the world.
    """

    vertices: Float[Tensor, "V 3"]
    faces: Int[Tensor, "F 3"]
    uv: Float[Tensor, "V 2"]
    normals: Float[Tensor, "V 3"]
    tangents: Float[Tensor, "V 3"]
    sign: Float[Tensor, "V"]
    scale: Float[Tensor, "V"]
    component: Int[Tensor, "F"]
    closed: Bool[Tensor, "C"]
    owner: Int[Tensor, "F"]
    object: Int[Tensor, "surface"]
    origin: Float[Tensor, "3"]

    def seen_by(self, camera: Camera) -> Camera:
        """Return `camera` as it stands to the vertices."""
        return replace(camera, eye=camera.eye.double() - self.origin) if bool(self.origin.any()) else camera

    def lit_by(self, lights: tuple[Light, ...]) -> tuple[Light, ...]:
        """Return `lights` as they stand to the vertices."""
        if not bool(self.origin.any()):
            return lights
        return tuple(
            light if isinstance(light, DirectionalLight)
            else replace(light, position=light.position.double() - self.origin)
            for light in lights
        )  # fmt: skip


class Points(NamedTuple):
    """Surface points at fragments.

    Attributes:
        position: (n, 3) world, on the base surface.
        uv: (n, 2).
        frame: world tangent frame; each vector (n, 3).
        scale: (n,) texture scale.
        owner: (n,) surface, see `Scene.surfaces`.
        pixel: (n,) world width of a pixel there.
    """

    position: Float[Tensor, "n 3"]
    uv: Float[Tensor, "n 2"]
    frame: Frame
    scale: Float[Tensor, "n"]
    owner: Int[Tensor, "n"]
    pixel: Float[Tensor, "n"]

    def select(self, which: Tensor) -> "Points":
        """Return the points `which` (numbers or a mask)."""
        frame = Frame(*(x[which] for x in self.frame))
        rest = (x[which] for x in (self.scale, self.owner, self.pixel))
        return Points(self.position[which], self.uv[which], frame, *rest)


def assemble(scene: Scene) -> World:
    """Return the meshes of `scene` as one set of arrays.

    A scene far from the world's origin gets an origin of its own, a whole number of units away: positions along rays
    are as sharp there as at home.
    """
    meshes = [o.mesh for o in scene.objects]
    first_vertex, first_component, faces, component = 0, 0, [], []
    for m in meshes:
        faces.append(m.faces + first_vertex)
        component.append(m.component + first_component)
        first_vertex += len(m.vertices)
        first_component += len(m.closed)
    owner, objects = [], []
    for i, o in enumerate(scene.objects):
        part = torch.zeros(len(o.mesh.faces), dtype=torch.long) if o.part is None else o.part.long()
        owner.append(part + len(objects))
        objects += [i] * len(o.materials)

    def join(name: str) -> Tensor:
        return torch.cat([getattr(m, name) for m in meshes])

    vertices, origin = _at_home(join("vertices"), meshes[0].normals.dtype)
    return World(
        vertices, torch.cat(faces), join("uv"), join("normals"), join("tangents"), join("sign"), join("scale"),
        torch.cat(component), join("closed"), torch.cat(owner), torch.tensor(objects), origin,
    )  # fmt: skip


def _at_home(vertices: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Return vertices and their origin: moved there, in `dtype`, where the world's is far."""
    low, high = vertices.double().aminmax(dim=0)
    middle = (low + high) / 2
    if float(middle.abs().max()) <= FAR * float((high - low).max()):
        return vertices, torch.zeros(3, dtype=torch.float64)
    return (vertices.double() - middle.round()).to(dtype), middle.round()


def interpolate(world: World, layers: Layers, camera: Camera, which: Int[Tensor, "n"]) -> Points:
    """Return the surface points at the fragments `which`, perspective-correct."""
    check_shape("which", which, (-1,))
    face = layers.triangles.face[layers.triangle[which]]
    weight = barycentric(layers, camera, which).unsqueeze(-1)
    corner = world.faces[face]

    def mean(values: Tensor) -> Tensor:
        return (values[corner] * weight).sum(1)

    origin, direction, _ = rays(camera, layers.pixel[which], layers.t.dtype)
    position = origin + layers.t[which, None] * direction
    frame = frames.orthonormal(mean(world.normals), mean(world.tangents), world.sign[corner[:, 0]])
    scale = mean(world.scale[:, None])[:, 0]
    return Points(position, mean(world.uv), frame, scale, world.owner[face], camera.pixel_width(position))


def rays(
    camera: Camera, pixel: Int[Tensor, "n"], dtype: torch.dtype
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"], Float[Tensor, "n"]]:
    """Return origin, unit direction and stretch of the rays through the centres of `pixel`."""
    xy = torch.stack([pixel % camera.width, pixel // camera.width], -1).to(dtype) + 0.5
    return camera.rays(xy)
