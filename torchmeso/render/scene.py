"""What is rendered: meshes with materials, lights, and the flat arrays a frame works on.

Test: tests/render/test_scene.py
"""

from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, Literal, NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchmeso.data.btf import Evaluable
from torchmeso.data.distant_light import DistantLight
from torchmeso.data.gdm import Gdm
from torchmeso.data.quilting_map import QuiltingMap
from torchmeso.errors import ConfigError, check_range, check_shape
from torchmeso.geometry import components, frames, shell
from torchmeso.geometry.camera import Camera
from torchmeso.geometry.frames import Frame
from torchmeso.geometry.light import DirectionalLight, Light
from torchmeso.geometry.mesh import FAR, Mesh
from torchmeso.geometry.shell import BOTTOM, Shell, Side
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


@dataclass(frozen=True, slots=True, kw_only=True)
class ShellOptions:
    """How a shell of prisms carries a GDM.

    Attributes:
        side: "inward": the mesh is the top of the shell; "outward": the bottom, as in wang2004gdm.
        base: "solid": a floor below the material; "open": rays go through, and come in again on the far side.
        queries: look-ups per prism; 1 is the paper's.
    """

    side: Side = "inward"
    base: Literal["solid", "open"] = "solid"
    queries: int = 1

    def __post_init__(self) -> None:
        """Raise ConfigError for words and numbers that mean nothing."""
        if self.side not in ("inward", "outward"):
            raise ConfigError(f"shell.side: expected 'inward' or 'outward', got '{self.side}'")
        if self.base not in ("solid", "open"):
            raise ConfigError(f"shell.base: expected 'solid' or 'open', got '{self.base}'")
        check_range("shell.queries", self.queries, 1, 64)


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Material:
    """How a surface looks.

    Attributes:
        btf: reflectance with meso-scale detail, or None for a plain diffuse surface.
        mdf: depth of the mesostructure, or None: no silhouette detail, and shadows fall on the mesh itself.
        albedo: (3,) linear RGB of a plain surface, and of the floor below a GDM; unused with a BTF.
        gdm: mesostructure of any form, in a shell in place of the surface, or None. A material that has one has
            neither BTF nor MDF.
        shell: how the GDM is carried.
    """

    btf: Evaluable | None = None
    mdf: DistanceFunction | None = None
    albedo: tuple[float, float, float] = (0.6, 0.6, 0.6)
    gdm: Gdm | None = None
    shell: ShellOptions = ShellOptions()

    def __post_init__(self) -> None:
        """Raise ConfigError for a material of two kinds."""
        if self.gdm is not None and (self.btf is not None or self.mdf is not None):
            raise ConfigError("material: expected a GDM alone, or a BTF and an MDF, got both; name two materials")


def quilted(material: Material, quilting: QuiltingMap) -> Material:
    """Return `material` laid out by a quilting map: BTF, MDF and pictures move together.

    Raises:
        ConfigError: it has nothing that a map could lay out.
    """
    parts = {name: part for name in ("btf", "mdf") if (part := getattr(material, name)) is not None}
    for name, part in parts.items():
        if not hasattr(part, "quilting"):
            raise ConfigError(
                f"quilting: a {type(part).__name__} ({name}) cannot be laid out by a map; compress it first"
            )
    if not parts:
        raise ConfigError("quilting: expected a material with a BTF, an MDF or pictures, got a plain colour or a GDM")
    return replace(material, **{name: replace(part, quilting=quilting) for name, part in parts.items()})


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
        distant: light from all around in spherical harmonics, or None; it falls through bodies, unless it was followed
            to their vertices.
    """

    objects: tuple[Object, ...]
    lights: tuple[Light, ...]
    ambient: float = 0.05
    ambient_rule: str = "add"
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    distant: DistantLight | None = None

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


class PlacedShell(NamedTuple):
    """The shell of a surface with a GDM.

    Attributes:
        shell: its prisms.
        mesh: the mesh it stands on.
        surface: see `Scene.surfaces`.
        first_vertex: of the mesh's in the world.
        first_tet: of the shell's among those of all shells.
    """

    shell: Shell
    mesh: Mesh
    surface: int
    first_vertex: int
    first_tet: int


class World(NamedTuple):
    """All meshes of a scene as one; in place of faces with a GDM, those that rays come into its shell by.

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
        entry: (F,) 4 tetrahedron + corner opposite, of faces that let rays into a shell; -1 of others.
        sunk: (F,) whether a ray from outside of the body meets others before: bottoms of shells all around a body.
        shells: of all surfaces that have a GDM.
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
    entry: Int[Tensor, "F"]
    sunk: Bool[Tensor, "F"]
    shells: tuple[PlacedShell, ...]

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
    vertices, origin = _at_home(torch.cat([m.vertices for m in meshes]), meshes[0].normals.dtype)
    corners = [(vertices, *(torch.cat([getattr(m, x) for m in meshes]) for x in ATTRIBUTES))]
    first_vertex, first_component, first_tet, next_vertex = 0, 0, 0, len(vertices)
    faces, component, closed, owner, objects, entry, sunk, shells = [], [], [], [], [], [], [], []
    for i, o in enumerate(scene.objects):
        m = o.mesh
        part = torch.zeros(len(m.faces), dtype=torch.long) if o.part is None else o.part.long()
        dressed = torch.tensor([x.gdm is not None for x in o.materials])[part]
        still_closed = m.closed.clone()
        still_closed[m.component[dressed]] = False
        faces.append(m.faces[~dressed] + first_vertex)
        component.append(m.component[~dressed] + first_component)
        owner.append(part[~dressed] + len(objects))
        entry.append(torch.full((int((~dressed).sum()),), -1))
        sunk.append(torch.zeros(len(entry[-1]), dtype=torch.bool))
        closed.append(still_closed)
        first_component += len(m.closed)
        moved = replace(m, vertices=vertices[first_vertex : first_vertex + len(m.vertices)])
        for k, material in enumerate(o.materials):
            if material.gdm is None or not bool((part == k).any()):
                continue
            which = part == k
            base = replace(moved, faces=m.faces[which], component=m.component[which])
            own = shell.build(base, material.gdm.h, side=material.shell.side)
            rim = shell.boundary(own, base="open")
            solid = (rim.kind == BOTTOM) & (material.shell.base == "solid")
            corners.append((own.vertices.to(vertices.dtype), *_of_columns(base, len(own.vertices))))
            faces.append(rim.faces + next_vertex)
            component.append(torch.full_like(rim.tet, first_component))
            owner.append(torch.full_like(rim.tet, len(objects) + k))
            entry.append(torch.where(solid, -1, 4 * (rim.tet + first_tet) + rim.corner))
            sunk.append(solid & _wrapped(m, which)[base.component[own.face[rim.tet // 3]]])
            closed.append(torch.tensor([False]))
            shells.append(PlacedShell(own, base, len(objects) + k, first_vertex, first_tet))
            first_component += 1
            first_tet += len(own.tets)
            next_vertex += len(own.vertices)
        first_vertex += len(m.vertices)
        objects += [i] * len(o.materials)
    return World(
        vertices=torch.cat([c[0] for c in corners]), faces=torch.cat(faces),
        **{name: torch.cat([c[k + 1] for c in corners]) for k, name in enumerate(ATTRIBUTES)},
        component=torch.cat(component), closed=torch.cat(closed), owner=torch.cat(owner),
        object=torch.tensor(objects), origin=origin, entry=torch.cat(entry), sunk=torch.cat(sunk),
        shells=tuple(shells),
    )  # fmt: skip


def _wrapped(mesh: Mesh, which: Bool[Tensor, "F"]) -> Bool[Tensor, "C"]:
    """Return the components that are closed, right way out, and have all of their faces among `which`."""
    p = mesh.vertices.double()[mesh.faces]
    p = p - p.mean((0, 1))
    volume = torch.zeros(len(mesh.closed), dtype=torch.float64)
    volume.index_add_(0, mesh.component, (p[:, 0] * torch.linalg.cross(p[:, 1], p[:, 2])).sum(1))
    whole = torch.ones(len(mesh.closed), dtype=torch.bool)
    whole[mesh.component[~which]] = False
    return mesh.closed & whole & (volume > 0)


ATTRIBUTES = ("uv", "normals", "tangents", "sign", "scale")
"""What is interpolated over a face."""


def _of_columns(mesh: Mesh, count: int) -> tuple[Tensor, ...]:
    """Return the attributes of a shell's vertices, two per column: those of one of the mesh's vertices there."""
    column = components.weld(mesh.vertices)
    vertex = torch.zeros(count // 2, dtype=torch.long)
    vertex[column] = torch.arange(len(column))
    return tuple(getattr(mesh, name)[vertex].repeat_interleave(2, 0) for name in ATTRIBUTES)


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


def arriving_at(
    light: DistantLight, world: World, layers: Layers, camera: Camera, which: Int[Tensor, "n"]
) -> Float[Tensor, "n n_e 3"]:
    """Return the coefficients of distant light at the fragments `which`, world."""
    if light.at_vertices is None:
        return light.coefficients.expand(len(which), -1, -1)
    weight = barycentric(layers, camera, which)
    corner = world.faces[layers.triangles.face[layers.triangle[which]]]
    at = light.at(len(world.vertices)).to(weight.dtype)
    return (at[corner] * weight[..., None, None]).sum(1)


def rays(
    camera: Camera, pixel: Int[Tensor, "n"], dtype: torch.dtype
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"], Float[Tensor, "n"]]:
    """Return origin, unit direction and stretch of the rays through the centres of `pixel`."""
    xy = torch.stack([pixel % camera.width, pixel // camera.width], -1).to(dtype) + 0.5
    return camera.rays(xy)
