"""Triangle meshes dressed for a mesostructure: texture coordinates, tangent frames, texture scale, components.

`dress` makes a Mesh from raw arrays; `load` reads a file through trimesh and dresses it. Vertices are split
where texture coordinates jump, where a crease is sharper than `CREASE_DEG`, and where the handedness of the
texture changes; split vertices share their position bit for bit, so shared edges are still drawn once.

Test: tests/geometry/test_mesh.py
"""

import math
import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchmeso.errors import GeometryError, check_shape
from torchmeso.geometry import components, mesh_file
from torchmeso.geometry.directions import dot, normalize
from torchmeso.geometry.mesh_file import MeshFile

CREASE_DEG = 60.0
"""Faces that meet at a sharper angle (degrees between normals) do not share a vertex normal."""

FAR = 64.0
"""Meshes farther from the origin than this many times their size keep float64 positions."""

FARTHEST, MOST_TILES = 1e15, 1e5
"""Positions, and extents of texture coordinates, beyond which float32 arithmetic has no meaning."""

ANISOTROPY_WARNING = 2.0
"""Mean ratio of the singular values of the texture map above which `load` and `dress` warn."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Mesh:
    """A mesh ready to be dressed; every per-vertex array has the same length V.

    Attributes:
        vertices: (V, 3) world positions; float64 where the mesh lies far from the origin (`FAR`).
        faces: (F, 3) vertex numbers, counter-clockwise seen from outside.
        uv: (V, 2) texture coordinates in tiles, unbounded, v up.
        normals: (V, 3) unit, outwards.
        tangents: (V, 3) unit, perpendicular to the normal, along +u.
        sign: (V,) +1, or -1 where the texture is mirrored: b = sign (n x t).
        scale: (V,) texture scale s: world length of one tile, sqrt(world area / UV area).
        component: (F,) connected component of each face.
        closed: (C,) whether a component is closed: only these have silhouettes.
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

    def __post_init__(self) -> None:
        """Raise ShapeError unless the arrays match."""
        n = len(self.vertices)
        check_shape("mesh.vertices", self.vertices, (n, 3))
        check_shape("mesh.faces", self.faces, (-1, 3))
        check_shape("mesh.uv", self.uv, (n, 2))
        for name in ("normals", "tangents"):
            check_shape(f"mesh.{name}", getattr(self, name), (n, 3))
        for name in ("sign", "scale"):
            check_shape(f"mesh.{name}", getattr(self, name), (n,))
        check_shape("mesh.component", self.component, (len(self.faces),))


def load(path: str | Path, *, uv_set: int = 0) -> Mesh:
    """Return the mesh of a file (OBJ, glTF, PLY, OFF, STL; see `mesh_file.read`), dressed.

    Raises:
        FormatError: the file is missing or unreadable.
        GeometryError: it has no triangles, or no texture coordinates (`unwrap.unwrap` makes some).
    """
    return dress_file(mesh_file.read(path, uv_set=uv_set), name=Path(path).name)


def dress_file(found: MeshFile, *, tiles: tuple[float, float] = (1.0, 1.0), name: str = "mesh") -> Mesh:
    """Return the mesh of a file that was read, its texture repeated `tiles` times along u and v.

    Tangent frames that a file gives are kept: normal maps are made for them.

    Raises:
        GeometryError: there are no texture coordinates, or none that cover anything.
    """
    return dress_parts(found, tiles=tiles, name=name)[0]


def dress_parts(
    found: MeshFile, *, tiles: tuple[float, float] = (1.0, 1.0), name: str = "mesh"
) -> tuple[Mesh, Int[Tensor, "F"]]:
    """Return the same, and the part that each of its faces belongs to; arguments and errors as for `dress_file`."""
    if found.uv is None:
        raise GeometryError(
            f"{name}: expected texture coordinates, got none; "
            "make some with `unwrap: true` in the configuration (or torchmeso.geometry.unwrap), which cuts seams"
        )
    given = None
    if found.normals is not None and found.tangents is not None:
        given = Frames(found.normals, found.tangents[:, :3], found.tangents[:, 3])
    dressed, kept = _dress(
        _sharp(found.vertices, torch.float32), found.faces, found.uv * torch.tensor(tiles), given, name
    )
    return dressed, found.part[kept]


class Frames(NamedTuple):
    """Tangent frames of vertices as they were given; see `Mesh`."""

    normals: Float[Tensor, "V 3"]
    tangents: Float[Tensor, "V 3"]
    sign: Float[Tensor, "V"]


def dress(
    vertices: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    uv: Float[Tensor, "V 2"],
    *,
    given: Frames | None = None,
    name: str = "mesh",
) -> Mesh:
    """Return a Mesh: orientation mended, normals, tangents, texture scale and components found.

    Closed components that face inwards are turned around (with a warning), cavities stay.

    Args:
        vertices: (V, 3) world positions; equal positions are one point of the surface.
        faces: (F, 3) vertex numbers; faces without area stay but take no part in the frames.
        uv: (V, 2) in tiles.
        given: tangent frames to be kept; None = they are found, and vertices split where they jump.
        name: what warnings and errors call the mesh.

    Raises:
        GeometryError: no face has both world and texture area, a value is not finite or too large, or a face names a
            vertex that is not there.
    """
    return _dress(vertices, faces, uv, given, name)[0]


def _dress(
    vertices: Tensor, faces: Tensor, uv: Tensor, given: Frames | None, name: str
) -> tuple[Mesh, Bool[Tensor, "F"]]:
    """Return the mesh, and which faces were kept."""
    _check_arrays(name, vertices, faces, uv)
    uv = _near_zero(uv)
    found = components.find(vertices, faces)
    twin = components.twins(found, vertices, faces)
    if bool(twin.any()):
        warnings.warn(f"{name}: {int(twin.sum())} faces lay back to back on others and were left out", stacklevel=2)
        faces = faces[~twin]
        found = components.find(vertices, faces)
    flip = components.inside_out(found, vertices, faces)[found.of_face]
    if bool(flip.any()):
        warnings.warn(f"{name}: {int(flip.sum())} faces of closed parts looked inwards and were turned", stacklevel=2)
        faces = torch.where(flip[:, None], faces.flip(1), faces)
    jacobian = _uv_jacobian(vertices, faces, uv)
    usable = (jacobian.area > 0) & (jacobian.uv_area.abs() > 0)
    if not bool(usable.any()):
        raise GeometryError(f"{name}: expected at least one triangle with world and texture area, got none")
    _warn_about_anisotropy(name, jacobian, usable)

    position = components.weld(vertices)
    if given is not None:
        given = _turned(given, faces[flip])
        scale = _texture_scale(jacobian, usable, faces, _groups(position, given.normals))
        kept_frames = Mesh(
            vertices=vertices,
            faces=faces,
            uv=uv,
            normals=given.normals,
            tangents=given.tangents,
            sign=given.sign,
            scale=scale.to(uv.dtype),
            component=found.of_face,
            closed=found.closed,
        )
        return kept_frames, ~twin
    corner_normal = _corner_normals(vertices, faces, position).to(uv.dtype)
    handed = torch.where(jacobian.uv_area < 0, -1.0, 1.0)
    split = _split(faces, corner_normal, handed)
    source = split.source
    normals = corner_normal.reshape(-1, 3)[split.corner]
    group = _groups(position[source], normals)
    scale = _texture_scale(jacobian, usable, split.faces, group)
    sign = handed[split.corner // 3]
    tangents = _tangents(jacobian, usable, split.faces, normals, 2 * group + (sign < 0))
    dressed = Mesh(
        vertices=vertices[source],
        faces=split.faces,
        uv=uv[source],
        normals=normals,
        tangents=tangents,
        sign=sign.to(uv.dtype),
        scale=scale.to(uv.dtype),
        component=found.of_face,
        closed=found.closed,
    )
    return dressed, ~twin


def transform(mesh: Mesh, matrix: Float[Tensor, "4 4"]) -> Mesh:
    """Return `mesh` moved by a similarity (rotation, uniform scale, translation) given as a 4 x 4 matrix.

    Raises:
        GeometryError: the upper 3 x 3 block is not a rotation times a positive scale.
    """
    linear = matrix[:3, :3].double()
    size = linear.det().abs().pow(1 / 3)
    rotation = linear / size
    if linear.det() <= 0 or not torch.allclose(rotation @ rotation.T, torch.eye(3, dtype=torch.float64), atol=1e-5):
        raise GeometryError("transform: expected rotation, positive uniform scale and translation only")
    dtype = mesh.normals.dtype
    return replace(
        mesh,
        vertices=_sharp(mesh.vertices.double() @ linear.T + matrix[:3, 3].double(), dtype),
        normals=(mesh.normals.double() @ rotation.T).to(dtype),
        tangents=(mesh.tangents.double() @ rotation.T).to(dtype),
        scale=mesh.scale * size.to(dtype),
    )


def _turned(given: Frames, faces: Int[Tensor, "n 3"]) -> Frames:
    """Return frames that fit the vertices of `faces` that were turned around: n turns, t and b stay."""
    side = torch.ones_like(given.sign)
    side[faces.flatten()] = -1
    return Frames(given.normals * side[:, None], given.tangents, given.sign * side)


def _groups(position: Int[Tensor, "V"], normals: Float[Tensor, "V 3"]) -> Int[Tensor, "V"]:
    """Return a number for each vertex; those at one position with one normal share it."""
    normal = components.weld(normals)
    return torch.unique(position * (normal.max() + 1) + normal, return_inverse=True)[1]


def _check_arrays(name: str, vertices: Tensor, faces: Tensor, uv: Tensor) -> None:
    check_shape(f"{name}: vertices", vertices, (-1, 3))
    check_shape(f"{name}: faces", faces, (-1, 3))
    check_shape(f"{name}: texture coordinates", uv, (len(vertices), 2))
    if not (torch.isfinite(vertices).all() and torch.isfinite(uv).all()):
        raise GeometryError(f"{name}: expected finite positions and texture coordinates, got NaN or infinity")
    if len(faces) == 0:
        raise GeometryError(f"{name}: expected triangles, got none")
    if int(faces.min()) < 0 or int(faces.max()) >= len(vertices):
        found = f"{int(faces.min())} to {int(faces.max())}"
        raise GeometryError(f"{name}: expected vertex numbers from 0 to {len(vertices) - 1}, got {found}")
    if float(vertices.abs().max()) > FARTHEST:
        raise GeometryError(
            f"{name}: expected positions within {FARTHEST:g} of the origin, got {float(vertices.abs().max()):g}"
        )
    extent = float((uv.amax(0) - uv.amin(0)).max())
    if extent > MOST_TILES:
        raise GeometryError(
            f"{name}: expected texture coordinates over at most {MOST_TILES:g} tiles, got {extent:g}; "
            "single precision could not tell their texels apart"
        )


def _near_zero(uv: Tensor) -> Tensor:
    """Return texture coordinates moved by whole tiles where they lie far from 0, so that fractions stay sharp."""
    low, high = uv.double().aminmax(dim=0)
    middle = (low + high) / 2
    far = middle.abs() > 16 + (high - low)
    return (uv.double() - torch.where(far, middle.floor(), 0.0)).to(uv.dtype)


def _sharp(vertices: Float[Tensor, "V 3"], dtype: torch.dtype) -> Float[Tensor, "V 3"]:
    """Return float64 positions in `dtype`, or as they are where they lie so far out that it would blur them."""
    if len(vertices) == 0:
        return vertices.to(dtype)
    size = float((vertices.amax(0) - vertices.amin(0)).max())
    return vertices if float(vertices.abs().max()) > FAR * size else vertices.to(dtype)


class _Jacobian(NamedTuple):
    """Per face, float64: world area, signed UV area, and world derivatives by u and v (times the UV area)."""

    area: Tensor
    uv_area: Tensor
    du: Tensor
    dv: Tensor


def _uv_jacobian(vertices: Tensor, faces: Tensor, uv: Tensor) -> _Jacobian:
    p, q = vertices.double()[faces], uv.double()[faces]
    e1, e2 = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
    (u1, v1), (u2, v2) = (q[:, 1] - q[:, 0]).unbind(-1), (q[:, 2] - q[:, 0]).unbind(-1)
    uv_area = (u1 * v2 - u2 * v1) / 2
    side = torch.where(uv_area < 0, -1.0, 1.0).unsqueeze(-1)
    du = side * (v2.unsqueeze(-1) * e1 - v1.unsqueeze(-1) * e2)
    dv = side * (u1.unsqueeze(-1) * e2 - u2.unsqueeze(-1) * e1)
    return _Jacobian(torch.linalg.cross(e1, e2).norm(dim=-1) / 2, uv_area, du, dv)


def _warn_about_anisotropy(name: str, jacobian: _Jacobian, usable: Tensor) -> None:
    ratio = _anisotropy(jacobian, usable)
    if ratio > ANISOTROPY_WARNING:
        warnings.warn(
            f"{name}: the texture is stretched by a mean factor of {ratio:.1f} in one direction; "
            "depths follow the mean scale",
            stacklevel=3,
        )


def anisotropy(mesh: Mesh) -> float:
    """Return the area-weighted mean ratio of the singular values of the texture map (1 = no stretch)."""
    jacobian = _uv_jacobian(mesh.vertices, mesh.faces, mesh.uv)
    return _anisotropy(jacobian, (jacobian.area > 0) & (jacobian.uv_area != 0))


def _anisotropy(jacobian: _Jacobian, usable: Tensor) -> float:
    du, dv, area = jacobian.du[usable], jacobian.dv[usable], jacobian.area[usable]
    e, f, g = dot(du, du), dot(du, dv), dot(dv, dv)
    root = torch.sqrt((e - g).square() + 4 * f.square())
    ratio = torch.sqrt((e + g + root) / (e + g - root).clamp(min=1e-12 * (e + g)))
    return float((ratio * area).sum() / area.sum())


def _corner_normals(vertices: Tensor, faces: Tensor, position: Tensor) -> Tensor:
    """Return (F, 3, 3) normals per corner: angle-weighted means over the faces around it up to the crease angle.

    Corners at one position that collect the same faces get the same bits, so that they can share a vertex.
    """
    p = vertices.double()[faces]
    face_normal = normalize(torch.linalg.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]))
    to_next, to_last = normalize(p.roll(-1, 1) - p), normalize(p.roll(1, 1) - p)
    angle = torch.acos(dot(to_next, to_last).clamp(-1, 1)).flatten()
    around = position[faces].flatten()
    facing = face_normal.repeat_interleave(3, 0)
    size = int(position.max()) + 1

    # Where all faces lie within half the crease angle of their middle, no two of them meet at a crease.
    middle = normalize(torch.zeros(size, 3, dtype=torch.float64).index_add_(0, around, facing))
    least = torch.ones(size, dtype=torch.float64)
    least.scatter_reduce_(0, around, dot(facing, middle[around]), "amin")
    total = torch.zeros(size, 3, dtype=torch.float64).index_add_(0, around, facing * angle.unsqueeze(-1))
    normal = total[around]
    bent = (least < math.cos(math.radians(CREASE_DEG / 2)) + 1e-9)[around].nonzero()[:, 0]
    normal[bent] = _over_creases(facing[bent], angle[bent], around[bent])
    lost = normal.norm(dim=-1) < 1e-12  # around faces without area any unit vector will do
    normal[lost] = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    return normalize(normal).reshape(-1, 3, 3)


def _over_creases(facing: Tensor, angle: Tensor, around: Tensor) -> Tensor:
    """Return (n, 3) sums of normals at corners whose position is `around`, over those not beyond a crease."""
    order = torch.argsort(around, stable=True)
    count = torch.bincount(around, minlength=1)
    start = count.cumsum(0) - count
    # All pairs of corners at one position: corner i collects the face of corner j.
    pairs = count[around[order]]
    i = order.repeat_interleave(pairs)
    within = torch.arange(len(i)) - (pairs.cumsum(0) - pairs).repeat_interleave(pairs)
    j = order[start[around[i]] + within]
    near = dot(facing[i], facing[j]) >= math.cos(math.radians(CREASE_DEG))
    weighted = facing[j] * (angle[j] * near).unsqueeze(-1)
    return torch.zeros(len(facing), 3, dtype=torch.float64).index_add_(0, i, weighted)


class _Split(NamedTuple):
    faces: Tensor  # (F, 3) new vertex numbers
    source: Tensor  # (V') old vertex of each new one
    corner: Tensor  # (V') one corner (3 face + k) that uses it


def _split(faces: Tensor, corner_normal: Tensor, handed: Tensor) -> _Split:
    """Split vertices so that each has one normal and one handedness."""
    normal = components.weld(corner_normal.reshape(-1, 3))
    key = 2 * (faces.flatten() * (normal.max() + 1) + normal) + (handed < 0).repeat_interleave(3)
    unique, number = torch.unique(key, return_inverse=True)
    corner = torch.full((len(unique),), 3 * len(faces), dtype=torch.long)
    corner.scatter_reduce_(0, number, torch.arange(3 * len(faces)), "amin")
    return _Split(number.reshape(-1, 3), faces.flatten()[corner], corner)


def _texture_scale(jacobian: _Jacobian, usable: Tensor, faces: Tensor, group: Tensor) -> Tensor:
    """Return s per vertex; vertices at one position with one normal share it, so that shells do not tear."""
    n_group = int(group.max()) + 1
    corner_group = group[faces]
    area = torch.zeros(n_group, dtype=torch.float64)
    uv_area = torch.zeros_like(area)
    for k in range(3):
        area.index_add_(0, corner_group[:, k], jacobian.area * usable)
        uv_area.index_add_(0, corner_group[:, k], jacobian.uv_area.abs() * usable)
    mean = math.sqrt(float(jacobian.area[usable].sum() / jacobian.uv_area[usable].abs().sum()))
    scale = torch.where(uv_area > 0, (area / uv_area.clamp(min=1e-300)).sqrt(), mean)
    return scale[group]


def _tangents(jacobian: _Jacobian, usable: Tensor, faces: Tensor, normals: Tensor, group: Tensor) -> Tensor:
    """Return unit tangents: the area-weighted mean of dP/du around each vertex, made perpendicular to the normal.

    Across a seam where the texture goes on in the same direction (the two sides of a tiled torus) both sides take
    their common mean; where the chart turns, each keeps its own.
    """
    total = torch.zeros(len(normals), 3, dtype=torch.float64)
    direction = normalize(jacobian.du) * (jacobian.area * usable).unsqueeze(-1)
    for k in range(3):
        total.index_add_(0, faces[:, k], direction)
    size = int(group.max()) + 1
    mean = torch.zeros(size, 3, dtype=torch.float64).index_add_(0, group, total)
    agreement = torch.full((size,), 1.0, dtype=torch.float64)
    agreement.scatter_reduce_(0, group, dot(normalize(total), normalize(mean)[group]), "amin")
    total = torch.where((agreement > math.cos(math.radians(30)))[group, None], mean[group], total)

    n = normals.double()
    flat = total - dot(total, n).unsqueeze(-1) * n
    axis = torch.nn.functional.one_hot(n.abs().argmin(-1), 3).double()
    lost = dot(flat, flat) <= 1e-20 * dot(total, total).clamp(min=1e-300)
    return normalize(torch.where(lost.unsqueeze(-1), torch.linalg.cross(n, axis), flat)).to(normals.dtype)
