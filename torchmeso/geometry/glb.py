"""Meshes as a GLB file (glTF 2.0): positions, normals, tangents with their sign, texture coordinates, and named parts.

The other direction of `gltf`: what is read there comes back, vertex by vertex.

Test: tests/geometry/test_gltf.py
"""

import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from torchmeso.errors import FormatError
from torchmeso.geometry.gltf import BINARY_CHUNK, JSON_CHUNK, MAGIC
from torchmeso.geometry.mesh import Mesh
from torchmeso.geometry.mesh_file import Finish, Group, Picture

FLOAT, UINT, ARRAYS, INDICES = 5126, 5125, 34962, 34963


class Body(NamedTuple):
    """A mesh to be written.

    Attributes:
        name: of the mesh.
        mesh: where it stands.
        part: (F,) row of `groups`; None = all faces have the first.
        groups: named parts with their looks.
    """

    name: str
    mesh: Mesh
    part: Int[Tensor, "F"] | None
    groups: Sequence[Group]


def encode(bodies: Sequence[Body]) -> bytes:
    """Return bodies as a GLB file: positions, normals, tangents, texture coordinates, one primitive per part."""
    return _Writer().file(bodies)


class _Writer:
    """A GLB file in the making."""

    def __init__(self) -> None:
        self.chunks: list[bytes] = []
        self.size = 0
        self.lists: dict[str, list[dict]] = {
            k: [] for k in ("bufferViews", "accessors", "materials", "textures", "images", "meshes", "nodes")
        }
        self.materials: dict[Group, int] = {}

    def file(self, bodies: Sequence[Body]) -> bytes:
        for body in bodies:
            self.append("nodes", {"mesh": self.mesh(body), "name": body.name})
        document = {
            "asset": {"version": "2.0", "generator": "torchmeso"},
            "scene": 0,
            "scenes": [{"nodes": list(range(len(bodies)))}],
            **{k: v for k, v in self.lists.items() if v},
            "buffers": [{"byteLength": self.size}],
        }
        text = json.dumps(document).encode()
        text += b" " * (-len(text) % 4)
        binary = b"".join(self.chunks)
        head = struct.pack("<III", MAGIC, 2, 12 + 8 + len(text) + 8 + len(binary))
        text_head, binary_head = (
            struct.pack("<II", len(text), JSON_CHUNK),
            struct.pack("<II", len(binary), BINARY_CHUNK),
        )
        return head + text_head + text + binary_head + binary

    def append(self, name: str, item: dict) -> int:
        self.lists[name].append(item)
        return len(self.lists[name]) - 1

    def mesh(self, body: Body) -> int:
        m = body.mesh
        position = m.vertices.float().numpy()
        uv = torch.stack([m.uv[:, 0], 1 - m.uv[:, 1]], -1)
        box = {"min": position.min(0).tolist(), "max": position.max(0).tolist()}
        attributes = {
            "POSITION": self.array(position, "VEC3", **box),
            "NORMAL": self.array(m.normals.float().numpy(), "VEC3"),
            "TANGENT": self.array(torch.cat([m.tangents, m.sign[:, None]], 1).float().numpy(), "VEC4"),
            "TEXCOORD_0": self.array(uv.float().numpy(), "VEC2"),
        }
        primitives = []
        for k, group in enumerate(body.groups):
            faces = (
                m.faces if body.part is None and k == 0 else m.faces[body.part == k] if body.part is not None else None
            )
            if faces is None or len(faces) == 0:
                continue
            indices = self.array(faces.numpy().astype(np.uint32).reshape(-1, 1), "SCALAR")
            primitives.append({"attributes": attributes, "indices": indices, "material": self.material(group)})
        return self.append("meshes", {"name": body.name, "primitives": primitives})

    def array(self, values: np.ndarray, kind: str, **box: list[float]) -> int:
        index = kind == "SCALAR"
        view = self.view(np.ascontiguousarray(values).tobytes(), target=INDICES if index else ARRAYS)
        about = {"bufferView": view, "componentType": UINT if index else FLOAT, "count": len(values), "type": kind}
        return self.append("accessors", {**about, **box})

    def view(self, content: bytes, **about: int) -> int:
        first, padding = self.size, -len(content) % 4
        self.chunks.append(content + b"\0" * padding)
        self.size += len(content) + padding
        return self.append("bufferViews", {"buffer": 0, "byteOffset": first, "byteLength": len(content), **about})

    def material(self, group: Group) -> int:
        if group not in self.materials:
            finish = group.finish or Finish()
            base: dict[str, Any] = {"baseColorFactor": [*finish.albedo, 1.0], "metallicFactor": 0.0}
            about: dict[str, Any] = {"name": group.name, "pbrMetallicRoughness": base}
            if finish.albedo_map is not None:
                base["baseColorTexture"] = {"index": self.texture(finish.albedo_map)}
            if finish.normal_map is not None:
                about["normalTexture"] = {"index": self.texture(finish.normal_map), "scale": finish.normal_scale}
            self.materials[group] = self.append("materials", about)
        return self.materials[group]

    def texture(self, picture: Picture) -> int:
        if isinstance(picture, Path) and not picture.is_file():
            raise FormatError(f"{picture}: expected a picture, found none; check the path")
        content = picture.read_bytes() if isinstance(picture, Path) else picture
        kinds = {b"\x89PNG": "image/png", b"\xff\xd8\xff": "image/jpeg"}
        kind = next((v for k, v in kinds.items() if content.startswith(k)), None)
        if kind is None:
            raise FormatError("glTF: expected a PNG or JPEG picture for a texture, got another kind; convert it first")
        image = self.append("images", {"bufferView": self.view(content), "mimeType": kind})
        return self.append("textures", {"source": image})
