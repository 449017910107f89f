"""glTF 2.0 files, .glb and .gltf: triangles with tangents, one of their sets of texture coordinates, and looks.

glTF's textures begin at the top left, so v is turned over; its bitangent, cross(n, t) w, runs along our +v, so w is the
frame's sign. Looks are base colour and normal map. Meshes are placed by their nodes; skins and morphs stay in
the pose they were stored in. A transform of the base colour's texture (KHR_texture_transform) moves the texture
coordinates themselves. `glb` writes such files.

Test: tests/geometry/test_gltf.py
"""

import base64
import json
import struct
import warnings
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote

import numpy as np
import torch
from torch import Tensor

from torchmeso.errors import FormatError, GeometryError
from torchmeso.geometry.mesh_file import Finish, Group, MeshFile, Picture

MAGIC, JSON_CHUNK, BINARY_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942
TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
UNDERSTOOD = {"KHR_mesh_quantization", "KHR_materials_unlit", "KHR_texture_transform"}
"""Extensions that a file may require: numbers of few bits are read anyway."""

MOST_MOVED = 1e6
"""Offsets and scales of texture coordinates are at most this."""


def read(path: Path, uv_set: int = 0) -> MeshFile:
    """Return the triangles of a glTF file's scene as one mesh; parts are named by material, else by mesh.

    Raises:
        FormatError: the file is damaged, or needs an extension that is not understood (such as Draco).
        GeometryError: there are no triangles, or a part has other sets of texture coordinates.
    """
    try:
        return _Reader(path, uv_set).mesh()
    except (GeometryError, FormatError):
        raise
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, struct.error) as error:
        raise FormatError(f"{path}: expected a glTF 2.0 file ({type(error).__name__}: {error})") from error


class _Piece(NamedTuple):
    """A primitive in the world."""

    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray | None
    normals: np.ndarray | None
    tangents: np.ndarray | None
    group: int
    uv_sets: int


class _Reader:
    """A glTF file that was opened."""

    def __init__(self, path: Path, uv_set: int):
        self.path, self.uv_set, self.binary = path, uv_set, b""
        raw = path.read_bytes()
        if raw[:4] == struct.pack("<I", MAGIC):
            at, content = 12, b""
            while at + 8 <= len(raw):
                size, kind = struct.unpack_from("<II", raw, at)
                chunk, at = raw[at + 8 : at + 8 + size], at + 8 + size
                if len(chunk) < size:
                    raise FormatError(f"{path}: a chunk of {size} bytes ends early; the copy may be incomplete")
                content = chunk if kind == JSON_CHUNK and not content else content
                self.binary = chunk if kind == BINARY_CHUNK and not self.binary else self.binary
        else:
            content = raw
        self.json: dict[str, Any] = json.loads(content)
        unknown = set(self.json.get("extensionsRequired", [])) - UNDERSTOOD
        if unknown:
            raise FormatError(
                f"{path}: needs the extension {', '.join(sorted(unknown))}, which is not understood; "
                "export it without compression"
            )
        self.buffers: dict[int, bytes] = {}
        self.groups: dict[object, tuple[int, Group]] = {}

    def mesh(self) -> MeshFile:
        pieces = [
            self.primitive(primitive, matrix, self.json["meshes"][number].get("name", f"mesh_{number}"), key)
            for number, matrix in self.placed()
            for key, primitive in enumerate(self.json["meshes"][number]["primitives"])
            if primitive.get("mode", 4) in (4, 5, 6)
        ]
        if not pieces:
            raise GeometryError("expected triangles, got none")
        most = max(p.uv_sets for p in pieces)
        if self.uv_set >= max(most, 1):
            raise GeometryError(f"expected uv_set 0 to {max(most, 1) - 1}, got {self.uv_set}")
        first = np.cumsum([0, *(len(p.vertices) for p in pieces)])

        def join(name: str, dtype: type = np.float32) -> Tensor | None:
            arrays = [getattr(p, name) for p in pieces]
            if any(x is None for x in arrays):
                return None
            return torch.from_numpy(np.concatenate(arrays).astype(dtype))

        vertices, tangents = join("vertices", np.float64), join("tangents")
        normals = join("normals") if tangents is not None else None
        assert vertices is not None
        return MeshFile(
            vertices=vertices,
            faces=torch.from_numpy(np.concatenate([p.faces + n for p, n in zip(pieces, first[:-1], strict=True)])),
            uv=join("uv"),
            normals=normals,
            tangents=tangents if normals is not None else None,
            part=torch.arange(len(pieces))
            .new_tensor([p.group for p in pieces])
            .repeat_interleave(torch.tensor([len(p.faces) for p in pieces])),
            groups=tuple(group for _, group in self.groups.values()),
            uv_sets=min(p.uv_sets for p in pieces),
        )

    def placed(self) -> list[tuple[int, np.ndarray]]:
        """Return the meshes of the scene with their matrices."""
        nodes = self.json.get("nodes", [])
        if not nodes:
            return [(i, np.eye(4)) for i in range(len(self.json.get("meshes", [])))]
        scenes = self.json.get("scenes")
        below = {child for node in nodes for child in node.get("children", [])}
        roots = scenes[self.json.get("scene", 0)].get("nodes", []) if scenes else set(range(len(nodes))) - below
        found, stack = [], [(i, np.eye(4), 0) for i in reversed(list(roots))]
        while stack:
            i, matrix, depth = stack.pop()
            if depth > len(nodes):
                raise FormatError(f"{self.path}: its nodes stand in a circle")
            here = matrix @ _matrix(nodes[i])
            if "mesh" in nodes[i]:
                found.append((nodes[i]["mesh"], here))
            stack += [(child, here, depth + 1) for child in reversed(nodes[i].get("children", []))]
        return found

    def primitive(self, primitive: dict, matrix: np.ndarray, mesh_name: str, key: int) -> _Piece:
        attributes = primitive["attributes"]
        position = self.accessor(attributes["POSITION"]).astype(np.float64)
        number = self.accessor(primitive["indices"])[:, 0] if "indices" in primitive else np.arange(len(position))
        faces = _triangles(number.astype(np.int64), primitive.get("mode", 4))
        linear, mirrored = matrix[:3, :3], np.linalg.det(matrix[:3, :3]) < 0
        uv_name = f"TEXCOORD_{self.uv_set}"
        uv = self.accessor(attributes[uv_name]).astype(np.float64) if uv_name in attributes else None
        moved = self.moved(primitive.get("material"))
        if uv is not None and moved is not None:
            uv = uv @ moved[:, :2].T + moved[:, 2]
        # Tangents follow +u as it stands in the file: where it is turned over or round they are made again.
        upright = moved is None or (moved[0, 0] > 0 and moved[1, 1] > 0 and moved[0, 1] == moved[1, 0] == 0)
        normals = tangents = None
        if "NORMAL" in attributes and "TANGENT" in attributes and upright:
            normals = _unit(self.accessor(attributes["NORMAL"]) @ np.linalg.inv(linear))
            given = self.accessor(attributes["TANGENT"]).astype(np.float64)
            sign = np.where(given[:, 3:] < 0, -1.0, 1.0) * (-1 if mirrored else 1)
            tangents = np.concatenate([_unit(given[:, :3] @ linear.T), sign], 1)
        return _Piece(
            position @ linear.T + matrix[:3, 3],
            faces[:, ::-1] if mirrored else faces,
            None if uv is None else np.stack([uv[:, 0], 1 - uv[:, 1]], -1),
            normals,
            tangents,
            self.group(primitive.get("material"), f"{mesh_name}_{key}" if key else mesh_name),
            sum(name.startswith("TEXCOORD_") for name in attributes),
        )

    def group(self, material: int | None, name: str) -> int:
        """Return the number of a part; primitives of one material are one part."""
        key = name if material is None else material
        if key not in self.groups:
            finish = None
            if material is not None:
                about = self.json["materials"][material]
                name, finish = about.get("name", f"material_{material}"), self.finish(about)
            self.groups[key] = len(self.groups), Group(name, finish)
        return self.groups[key][0]

    def finish(self, material: dict) -> Finish:
        base, normal = material.get("pbrMetallicRoughness", {}), material.get("normalTexture", {})
        r, g, b = base.get("baseColorFactor", (1, 1, 1))[:3]
        return Finish(
            albedo=(float(r), float(g), float(b)),
            albedo_map=self.picture(base.get("baseColorTexture")),
            normal_map=self.picture(normal),
            normal_scale=float(normal.get("scale", 1)),
        )

    def moved(self, material: int | None) -> np.ndarray | None:
        """Return the 2 x 3 matrix that a material lays over texture coordinates, v downwards; None where it has none.

        One mesh has one set of coordinates: the base colour's transform counts, else the normal map's.
        """
        if material is None:
            return None
        about = self.json["materials"][material]
        textures = about.get("pbrMetallicRoughness", {}).get("baseColorTexture"), about.get("normalTexture")
        matrices = [self.transform(texture) for texture in textures if texture]
        if len(matrices) == 2 and not np.array_equal(*matrices):
            warnings.warn(
                f"{self.path.name}: its normal map is laid by other texture coordinates than its colours; "
                "it is laid as they are",
                stacklevel=2,
            )
        return None if not matrices or np.array_equal(matrices[0], np.eye(2, 3)) else matrices[0]

    def transform(self, texture: dict) -> np.ndarray:
        """Return the 2 x 3 matrix of a texture's own transform: scaled, turned counter-clockwise, shifted."""
        about = texture.get("extensions", {}).get("KHR_texture_transform", {})
        shift, scale = (np.array(about.get(k, (x, x)), dtype=np.float64) for k, x in (("offset", 0), ("scale", 1)))
        angle = float(about.get("rotation", 0))
        if not (np.abs([*shift, *scale, angle]) <= MOST_MOVED).all():
            raise FormatError(
                f"{self.path}: KHR_texture_transform: expected numbers up to {MOST_MOVED:g}, got offset "
                f"{shift.tolist()}, scale {scale.tolist()}, rotation {angle:g}"
            )
        # v runs down, so counter-clockwise on the texture is clockwise in numbers (glTF issue 1563).
        turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        return np.concatenate([turn * scale, shift[:, None]], 1)

    def picture(self, texture: dict | None) -> Picture | None:
        if not texture:
            return None
        asked = (
            texture.get("extensions", {}).get("KHR_texture_transform", {}).get("texCoord", texture.get("texCoord", 0))
        )
        if asked != self.uv_set:
            warnings.warn(
                f"{self.path.name}: a texture asks for other texture coordinates than set {self.uv_set}; "
                "it is laid by these",
                stacklevel=2,
            )
        image = self.json["images"][self.json["textures"][texture["index"]]["source"]]
        if "bufferView" in image:
            return self.view(image["bufferView"])
        return self.resource(image["uri"])

    def resource(self, uri: str) -> Picture:
        """Return what a URI names: the content of a data URI, else the path of a file."""
        if uri.startswith("data:"):
            return base64.b64decode(uri.partition(",")[2])
        return self.path.parent / unquote(uri)

    def buffer(self, number: int) -> bytes:
        if number not in self.buffers:
            uri = self.json["buffers"][number].get("uri")
            content: Picture = self.binary if uri is None else self.resource(uri)
            if isinstance(content, Path):
                if not content.is_file():
                    raise FormatError(f"{self.path}: its buffer {content.name} is missing; keep both files together")
                content = content.read_bytes()
            self.buffers[number] = content
        return self.buffers[number]

    def view(self, number: int) -> bytes:
        about = self.json["bufferViews"][number]
        first = about.get("byteOffset", 0)
        content = self.buffer(about["buffer"])[first : first + about["byteLength"]]
        if len(content) < about["byteLength"]:
            raise FormatError(f"{self.path}: a buffer ends early; the copy may be incomplete")
        return content

    def accessor(self, number: int) -> np.ndarray:
        """Return (count, width) values of an accessor; integers that stand for [0, 1] or [-1, 1] become floats."""
        about = self.json["accessors"][number]
        kind, width, count = np.dtype(TYPES[about["componentType"]]), WIDTHS[about["type"]], about["count"]
        if "bufferView" in about:
            view = self.json["bufferViews"][about["bufferView"]]
            values = self.values(about["bufferView"], about, kind, width, count, view.get("byteStride"))
        else:
            values = np.zeros((count, width), kind)
        if "sparse" in about:
            sparse, values = about["sparse"], values.copy()
            at, to = sparse["indices"], sparse["values"]
            where = self.values(at["bufferView"], at, np.dtype(TYPES[at["componentType"]]), 1, sparse["count"], None)
            values[where[:, 0]] = self.values(to["bufferView"], to, kind, width, sparse["count"], None)
        if about.get("normalized") and kind.kind in "iu":
            return np.maximum(values / np.iinfo(kind).max, -1.0)
        return values

    def values(self, view: int, about: dict, kind: np.dtype, width: int, count: int, stride: int | None) -> np.ndarray:
        step = (stride or kind.itemsize * width, kind.itemsize)
        return np.ndarray((count, width), kind, self.view(view), about.get("byteOffset", 0), step)


def _matrix(node: dict) -> np.ndarray:
    """Return the 4 x 4 matrix of a node."""
    if "matrix" in node:
        return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    x, y, z, w = np.array(node.get("rotation", (0, 0, 0, 1)), dtype=np.float64)
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    result = np.eye(4)
    result[:3, :3] = turn * np.array(node.get("scale", (1, 1, 1)), dtype=np.float64)
    result[:3, 3] = node.get("translation", (0, 0, 0))
    return result


def _triangles(number: np.ndarray, mode: int) -> np.ndarray:
    """Return the faces of a list (4), a strip (5) or a fan (6) of triangles."""
    if mode == 4:
        return number[: len(number) // 3 * 3].reshape(-1, 3)
    if len(number) < 3:
        return np.zeros((0, 3), np.int64)
    if mode == 6:
        return np.stack([np.full(len(number) - 2, number[0]), number[1:-1], number[2:]], -1)
    faces = np.stack([number[:-2], number[1:-1], number[2:]], -1)
    faces[1::2] = faces[1::2, [1, 0, 2]]
    return faces


def _unit(x: np.ndarray) -> np.ndarray:
    x = x.astype(np.float64)
    return x / np.maximum(np.linalg.norm(x, axis=-1, keepdims=True), 1e-30)
