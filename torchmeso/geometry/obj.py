"""OBJ files: polygons with texture coordinates, parts named by `usemtl`, and the looks of their MTL file.

Normals (`vn`) are left out, they are found anew; polygons become fans of triangles. Of an MTL file Kd, map_Kd and
the normal map (norm, or map_Bump, map_Kn, bump, which exporters use for normal maps too) are read.

Test: tests/geometry/test_obj.py
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchmeso.errors import FormatError, GeometryError
from torchmeso.geometry.mesh_file import Finish, Group, MeshFile

NORMAL_MAPS = ("norm", "map_kn", "map_bump", "bump")
"""Keys of an MTL file that name a normal map; the first one present counts."""


def read(path: Path) -> MeshFile:
    """Return what an OBJ file holds.

    Raises:
        FormatError: a line cannot be read.
        GeometryError: there are no triangles, or coordinates that are not finite.
    """
    text = path.read_text(encoding="utf-8", errors="replace").replace("\\\n", " ")
    try:
        lines = _scan(text)
        vertices = _columns(lines.positions, 3)
        corners, part = _triangles(lines.polygons, np.array(lines.groups, dtype=np.int64))
        uv = _columns(lines.textures, 2) if len(lines.textures) and bool((corners[..., 1] >= 0).all()) else None
        source, faces = _join(corners, uv is not None)
        used_vertices = vertices[source[:, 0]]
        used_uv = None if uv is None else torch.from_numpy(uv[source[:, 1]]).float()
    except GeometryError:
        raise
    except (ValueError, IndexError, OverflowError) as error:
        raise FormatError(f"{path}: expected an OBJ file ({error})") from error
    looks = {k: v for library in lines.libraries for k, v in _read_mtl(path.parent / library).items()}
    return MeshFile(
        vertices=torch.from_numpy(used_vertices),
        faces=torch.from_numpy(faces),
        uv=used_uv,
        part=torch.from_numpy(part),
        groups=tuple(Group(name, looks.get(name)) for name in lines.names),
        uv_sets=int(uv is not None),
    )


class Polygons(NamedTuple):
    """The polygons of a file, as they stand there.

    Attributes:
        vertices: (V, 3) float64.
        places: (W, 3) texture coordinates, the third 0 where there is none; float64.
        size: (F,) corners of each polygon.
        vertex: (sum of sizes) vertex of each corner.
        place: (sum of sizes) texture coordinate of each corner; -1 where it has none.
    """

    vertices: Float[Tensor, "V 3"]
    places: Float[Tensor, "W 3"]
    size: Int[Tensor, "F"]
    vertex: Int[Tensor, "n"]
    place: Int[Tensor, "n"]


def read_polygons(path: Path) -> Polygons:
    """Return the polygons of an OBJ file.

    Raises:
        FormatError: a line cannot be read.
        GeometryError: a face names a vertex that is not there, or a coordinate is not finite.
    """
    text = path.read_text(encoding="utf-8", errors="replace").replace("\\\n", " ")
    try:
        lines = _scan(text)
        size = np.array([len(p.split()) for p in lines.polygons], dtype=np.int64)
        corner = _corners(lines.polygons, size) - 1 if len(size) else np.zeros((0, 2), dtype=np.int64)
        places, vertices = _columns(lines.textures, 3), _columns(lines.positions, 3)
    except (ValueError, IndexError, OverflowError) as error:
        raise FormatError(f"{path}: expected an OBJ file ({error})") from error
    if len(corner) and not (corner[:, 0].min() >= 0 and (corner.max(0) < (len(vertices), max(len(places), 1))).all()):
        raise GeometryError(f"{path.name}: expected faces of vertices 1 to {len(vertices)}, got others")
    if not (np.isfinite(vertices).all() and np.isfinite(places).all()):
        raise GeometryError(f"{path.name}: expected finite coordinates, got NaN or infinity")
    vertex, place = torch.from_numpy(corner.copy()).unbind(1)
    return Polygons(torch.from_numpy(vertices), torch.from_numpy(places), torch.from_numpy(size), vertex, place)


class _Lines(NamedTuple):
    """What the lines of a file say, in their order.

    Attributes:
        positions: coordinates of the vertices.
        textures: texture coordinates.
        polygons: corners of the faces, counted from the start of the file.
        groups: of every polygon, the place of its material in `names`.
        libraries: names of MTL files.
        names: names of materials.
    """

    positions: list[str]
    textures: list[str]
    polygons: list[str]
    groups: list[int]
    libraries: list[str]
    names: list[str]


def _scan(text: str) -> _Lines:
    """Sort the lines of a file by what they hold."""
    found = _Lines([], [], [], [], [], [])
    number: dict[str, int] = {}
    group = -1
    for line in text.splitlines():
        key, _, rest = line.strip().partition(" ")
        if key == "v":
            found.positions.append(rest)
        elif key == "vt":
            found.textures.append(rest)
        elif key == "f":
            if group < 0:
                group = number.setdefault("", len(number))
            if "-" in rest:
                rest = _absolute(rest, len(found.positions), len(found.textures))
            found.polygons.append(rest.partition("#")[0])
            found.groups.append(group)
        elif key == "usemtl":
            group = number.setdefault(rest.strip(), len(number))
        elif key == "mtllib":
            found.libraries.append(rest.strip())
    found.names.extend(number)
    return found


def _columns(lines: list[str], count: int) -> np.ndarray:
    """Return the first `count` numbers of every line; a missing second texture coordinate is 0."""
    if not lines:
        return np.zeros((0, count))
    flat = " ".join(lines)
    rows = [line.split() for line in lines] if "#" not in flat else [line.partition("#")[0].split() for line in lines]
    if {len(row) for row in rows} != {count}:
        flat = " ".join(" ".join((row + ["0"] * count)[:count]) for row in rows)
    # float() of Python reads text faster than numpy does.
    return np.fromiter(map(float, flat.split()), np.float64, count * len(rows)).reshape(-1, count)


def _absolute(polygon: str, n_position: int, n_texture: int) -> str:
    """Return a face with numbers counted from the start of the file instead of from its own line."""
    counts = (n_position, n_texture, 0)
    corners = []
    for corner in polygon.split():
        fields = corner.split("/")
        corners.append("/".join(str(int(x) + n + 1) if x.startswith("-") else x for x, n in zip(fields, counts)))  # noqa: B905
    return " ".join(corners)


def _triangles(polygons: list[str], groups: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (F, 3, 2) position and texture of every triangle's corners, counted from 0, and each one's group."""
    size = np.array([len(p.split()) for p in polygons], dtype=np.int64)
    if not (size >= 3).any():
        raise GeometryError("expected triangles, got none")
    corner = _corners(polygons, size) - 1
    # A fan around each polygon's first corner.
    fans = np.maximum(size - 2, 0)
    polygon = np.repeat(np.arange(len(size)), fans)
    k = np.arange(len(polygon)) - np.repeat(np.cumsum(fans) - fans, fans)
    first = (np.cumsum(size) - size)[polygon]
    return np.stack([corner[first], corner[first + k + 1], corner[first + k + 2]], 1), groups[polygon]


def _corners(polygons: list[str], size: np.ndarray) -> np.ndarray:
    """Return (corners, 2) numbers of position and texture as they are written, 0 where there is none."""
    text = " ".join(polygons).replace("//", "/0/")
    fields = {p.count("/") / n for p, n in zip(polygons, size.tolist(), strict=True) if n}
    if len(fields) == 1 and fields <= {0.0, 1.0, 2.0}:  # all are written alike
        width = int(fields.pop()) + 1
        numbers = np.fromiter(map(int, text.replace("/", " ").split()), np.int64).reshape(-1, width)
        return numbers[:, :2] if width > 1 else np.concatenate([numbers, np.zeros_like(numbers)], 1)
    pairs = [(token + "/0").split("/")[:2] for token in text.split()]
    return np.array([(int(a), int(b)) for a, b in pairs], dtype=np.int64)


def _join(corners: np.ndarray, textured: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return the distinct pairs of position and texture, and faces that count them."""
    flat = corners.reshape(-1, 2)
    if flat[:, 0].min() < 0:
        raise IndexError("a face names vertex 0; the first is 1")
    key = flat[:, 0] * (flat[:, 1].max() + 2) + flat[:, 1] + 1 if textured else flat[:, 0]
    _, first, number = np.unique(key, return_index=True, return_inverse=True)
    return flat[first], number.reshape(-1, 3)


def _read_mtl(path: Path) -> dict[str, Finish]:
    """Return the looks of an MTL file by name; none where it is missing: meshes travel without it."""
    if not path.is_file():
        return {}
    found: dict[str, dict[str, str]] = {}
    here: dict[str, str] = {}
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        key, _, rest = line.partition("#")[0].strip().partition(" ")
        if key == "newmtl":
            here = found.setdefault(rest.strip(), {})
        elif key:
            here[key.lower()] = rest.strip()
    return {name: _finish(keys, path) for name, keys in found.items()}


def _finish(keys: dict[str, str], path: Path) -> Finish:
    normal = next((keys[k] for k in NORMAL_MAPS if k in keys), None)
    scale, colour = 1.0, (1.0, 1.0, 1.0) if "map_kd" in keys else (0.6, 0.6, 0.6)
    try:
        if "kd" in keys:
            r, g, b = (float(x) for x in keys["kd"].split()[:3])
            colour = r, g, b
        if normal is not None and "-bm" in normal.split():
            scale = float(normal.split()[normal.split().index("-bm") + 1])
    except (ValueError, IndexError) as error:
        raise FormatError(f"{path}: expected numbers for Kd and -bm ({error})") from error
    return Finish(
        albedo=colour,
        albedo_map=_picture(keys.get("map_kd"), path),
        normal_map=_picture(normal, path),
        normal_scale=scale,
    )


def _picture(statement: str | None, path: Path) -> Path | None:
    """Return the file that a map statement names, whose name stands behind its options (and may hold spaces)."""
    if statement is None:
        return None
    words = statement.split(" ")
    while words and words[0].startswith("-"):
        words.pop(0)
        while words and _is_number(words[0]) | (words[0] in ("on", "off")):
            words.pop(0)
    return path.parent / " ".join(words).replace("\\", "/")


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
