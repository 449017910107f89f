import base64
import io
import json
import math
import struct

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from torchmeso.errors import FormatError, GeometryError
from torchmeso.geometry import glb, mesh, mesh_file, shapes
from torchmeso.geometry.glb import Body
from torchmeso.geometry.mesh_file import Finish, Group


def png(colour=(10, 200, 30)):
    content = io.BytesIO()
    Image.new("RGB", (2, 2), colour).save(content, format="PNG")
    return content.getvalue()


def mirrored(body):
    """The body with its texture mirrored on the upper half."""
    corner, uv = body.vertices[body.faces], body.uv[body.faces]
    upper = (corner.mean(1)[:, 1] > 0)[:, None, None]
    uv = torch.where(upper, uv * torch.tensor([-1.0, 1.0]), uv)
    return mesh.dress(corner.reshape(-1, 3), torch.arange(len(uv) * 3).reshape(-1, 3), uv.reshape(-1, 2))


def test_a_mesh_comes_back_as_it_was(tmp_path):
    """Positions, frames and parts to the bit; v to a rounding, because it is turned over twice."""
    body = mirrored(shapes.torus(tiles=(6, 2), triangles=400))
    assert set(body.sign.tolist()) == {-1.0, 1.0}
    part = (torch.arange(len(body.faces)) % 3 == 0).long()
    looks = Finish(albedo=(0.2, 0.4, 0.6), albedo_map=png(), normal_map=png((128, 128, 255)), normal_scale=0.5)
    groups = (Group("bark", looks), Group("moss", Finish()))
    (tmp_path / "a.glb").write_bytes(glb.encode([Body("torus", body, part, groups)]))

    found = mesh_file.read(tmp_path / "a.glb")
    back = mesh.dress_file(found)
    order = torch.cat([(part == k).nonzero()[:, 0] for k in (0, 1)])
    assert found.groups == groups
    assert torch.equal(found.part, part[order])
    assert back.closed.tolist() == [True]
    for name in ("vertices", "normals", "tangents", "sign"):
        mine, theirs = getattr(body, name)[body.faces[order]], getattr(back, name)[back.faces]
        torch.testing.assert_close(theirs, mine, rtol=0, atol=2e-7)
    torch.testing.assert_close(back.uv[back.faces], body.uv[body.faces[order]], rtol=0, atol=1e-6)
    torch.testing.assert_close(back.scale[back.faces], body.scale[body.faces[order]], rtol=1e-4, atol=0)


def test_others_read_what_is_written(tmp_path):
    body = shapes.sphere(triangles=200)
    (tmp_path / "a.glb").write_bytes(glb.encode([Body("ball", body, None, (Group("clay", None),))]))
    scene = trimesh.load(tmp_path / "a.glb", process=False)
    (geometry,) = scene.geometry.values()
    assert geometry.visual.material.name == "clay"
    np.testing.assert_allclose(geometry.vertices[geometry.faces], body.vertices[body.faces].numpy(), atol=1e-6)
    np.testing.assert_allclose(geometry.visual.uv[geometry.faces], body.uv[body.faces].numpy(), atol=1e-5)


def document(**changes):
    """A square of two triangles in the xy plane, with two sets of texture coordinates."""
    position = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], "<f4")
    normal = np.tile(np.array([0, 0, 1], "<f4"), (4, 1))
    tangent = np.tile(np.array([1, 0, 0, 1], "<f4"), (4, 1))
    uv = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], "<f4")
    small = np.array([[0, 255], [128, 255], [128, 0], [0, 0]], "u1")
    indices = np.array([0, 1, 2, 3], "<u2")
    arrays = [position, normal, tangent, uv, small, indices]
    kinds = [(5126, "VEC3"), (5126, "VEC3"), (5126, "VEC4"), (5126, "VEC2"), (5121, "VEC2"), (5123, "SCALAR")]
    content, views, accessors = b"", [], []
    for i, (x, (kind, width)) in enumerate(zip(arrays, kinds, strict=True)):
        views.append({"buffer": 0, "byteOffset": len(content), "byteLength": x.nbytes})
        accessors.append({"bufferView": i, "componentType": kind, "type": width, "count": 4, "normalized": i == 4})
        content += x.tobytes()
    attributes = {"POSITION": 0, "NORMAL": 1, "TANGENT": 2, "TEXCOORD_0": 3, "TEXCOORD_1": 4}
    return {
        "asset": {"version": "2.0"},
        "buffers": [{"uri": "data:;base64," + base64.b64encode(content).decode(), "byteLength": len(content)}],
        "bufferViews": views,
        "accessors": accessors,
        "meshes": [{"primitives": [{"attributes": attributes, "indices": 5, "mode": 6}], "name": "square"}],
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
        **changes,
    }


def write(path, content):
    path.write_text(json.dumps(content))
    return path


def test_fans_sets_and_numbers_of_few_bits(tmp_path):
    path = write(tmp_path / "a.gltf", document())
    found, second = mesh_file.read(path), mesh_file.read(path, uv_set=1)
    assert found.faces.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert (found.groups[0].name, found.uv_sets) == ("square", 2)
    assert found.uv is not None
    assert found.uv.tolist() == [[0, 0], [1, 0], [1, 1], [0, 1]]  # v up
    assert second.uv is not None
    assert second.uv[2].tolist() == pytest.approx([128 / 255, 1])


def test_nodes_place_meshes_and_mirrors_keep_the_outside_outside(tmp_path):
    half = math.sqrt(0.5)
    nodes = [
        {"children": [1], "translation": [0, 0, 5]},
        {"mesh": 0, "rotation": [0, half, 0, half], "scale": [-2, 2, 2]},  # a quarter turn around y, mirrored in x
    ]
    found = mesh_file.read(write(tmp_path / "a.gltf", document(nodes=nodes)))
    torch.testing.assert_close(found.vertices[2].float(), torch.tensor([0.0, 2.0, 7.0]), rtol=0, atol=1e-6)
    a, b, c = found.vertices[found.faces[0]]
    assert found.normals is not None
    assert found.tangents is not None
    facing = torch.linalg.cross(b - a, c - a)
    torch.testing.assert_close((facing / facing.norm()).float(), found.normals[0], rtol=0, atol=1e-6)
    body = mesh.dress_file(found)
    # Mirrored in the world: t along +u, b along +v, and a left-handed frame.
    torch.testing.assert_close(body.tangents[0], torch.tensor([0.0, 0.0, 1.0]), rtol=0, atol=1e-6)
    assert body.sign.tolist() == [-1.0] * 4
    bitangent = torch.linalg.cross(body.normals, body.tangents) * body.sign[:, None]
    torch.testing.assert_close(bitangent[0], torch.tensor([0.0, 1.0, 0.0]), rtol=0, atol=1e-6)


def test_sparse_values_replace_others(tmp_path):
    content = document()
    patch = struct.pack("<H2x3f", 3, 0.0, 9.0, 0.0)
    content["buffers"].append({"uri": "data:;base64," + base64.b64encode(patch).decode(), "byteLength": 16})
    content["bufferViews"] += [
        {"buffer": 1, "byteOffset": 0, "byteLength": 2},
        {"buffer": 1, "byteOffset": 4, "byteLength": 12},
    ]
    content["accessors"][0]["sparse"] = {
        "count": 1, "indices": {"bufferView": 6, "componentType": 5123}, "values": {"bufferView": 7},
    }  # fmt: skip
    assert mesh_file.read(write(tmp_path / "a.gltf", content)).vertices[3].tolist() == [0, 9, 0]


def test_materials_name_parts(tmp_path):
    content = document(
        materials=[
            {
                "name": "tile",
                "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "baseColorFactor": [1, 0, 0, 1]},
            }
        ],
        textures=[{"source": 0}],
        images=[{"uri": "my%20colour.png"}],
    )
    content["meshes"][0]["primitives"][0]["material"] = 0
    (group,) = mesh_file.read(write(tmp_path / "a.gltf", content)).groups
    assert group.name == "tile"
    assert group.finish == Finish(albedo=(1.0, 0.0, 0.0), albedo_map=tmp_path / "my colour.png")


def test_textures_for_another_set_are_told(tmp_path):
    base = {"baseColorTexture": {"index": 0, "texCoord": 1}}
    content = document(materials=[{"pbrMetallicRoughness": base}], textures=[{"source": 0}], images=[{"uri": "a.png"}])
    content["meshes"][0]["primitives"][0]["material"] = 0
    with pytest.warns(UserWarning, match="other texture coordinates than set 0"):
        mesh_file.read(write(tmp_path / "a.gltf", content))


def laid(**transforms):
    """The square with a material whose textures are `transforms`: base, normal."""
    about = {k: {"index": 0, "extensions": {"KHR_texture_transform": x}} for k, x in transforms.items()}
    material = {"pbrMetallicRoughness": {"baseColorTexture": about["base"]}} if "base" in about else {}
    material |= {"normalTexture": about["normal"]} if "normal" in about else {}
    content = document(materials=[material], textures=[{"source": 0}], images=[{"uri": "a.png"}])
    content["extensionsRequired"] = ["KHR_texture_transform"]
    content["meshes"][0]["primitives"][0]["material"] = 0
    return content


@pytest.mark.parametrize("texture", ["base", "normal"])
def test_a_texture_that_is_shifted_and_repeated(tmp_path, texture):
    """On a square whose texture coordinates are its positions; v of the file runs down from the top."""
    found = mesh_file.read(write(tmp_path / "a.gltf", laid(**{texture: {"offset": [0.25, 0.5], "scale": [2, 3]}})))
    x, y = found.vertices[:, 0], found.vertices[:, 1]
    expected = torch.stack([2 * x + 0.25, 1 - (3 * (1 - y) + 0.5)], -1)
    torch.testing.assert_close(found.uv.double(), expected)
    assert found.tangents is not None


def test_texture_coordinates_are_turned_counter_clockwise(tmp_path):
    """A quarter turn takes +u, to the right, to up: to smaller v of the file, larger v of ours."""
    content = laid(base={"rotation": math.pi / 2, "scale": [2, 1]})
    found = mesh_file.read(write(tmp_path / "a.gltf", content))
    x, y = found.vertices[:, 0], found.vertices[:, 1]
    torch.testing.assert_close(found.uv.double(), torch.stack([1 - y, 1 + 2 * x], -1), rtol=0, atol=1e-6)
    assert found.tangents is None
    body = mesh.dress_file(found)
    torch.testing.assert_close(body.tangents[0], torch.tensor([0.0, -1.0, 0.0]), rtol=0, atol=1e-6)


def test_colours_lead_where_a_normal_map_is_laid_otherwise(tmp_path):
    content = laid(base={"scale": [2, 2]}, normal={"scale": [3, 3]})
    with pytest.warns(UserWarning, match="laid as they are"):
        found = mesh_file.read(write(tmp_path / "a.gltf", content))
    assert float(found.uv[:, 0].max()) == 2


@pytest.mark.errors
def test_what_cannot_be_read(tmp_path):
    draco = document(extensionsRequired=["KHR_draco_mesh_compression"])
    with pytest.raises(FormatError, match="needs the extension KHR_draco_mesh_compression"):
        mesh_file.read(write(tmp_path / "a.gltf", draco))
    with pytest.raises(GeometryError, match=r"a\.gltf: expected uv_set 0 to 1, got 2"):
        mesh_file.read(write(tmp_path / "a.gltf", document()), uv_set=2)
    with pytest.raises(GeometryError, match="expected triangles, got none"):
        mesh_file.read(write(tmp_path / "a.gltf", document(meshes=[{"primitives": []}])))
    with pytest.raises(FormatError, match="is missing; keep both files together"):
        mesh_file.read(write(tmp_path / "a.gltf", document(buffers=[{"uri": "a.bin", "byteLength": 9}])))
    with pytest.raises(FormatError, match="a buffer ends early"):
        mesh_file.read(write(tmp_path / "a.gltf", document(buffers=[{"uri": "data:,AAAA", "byteLength": 9}])))
    with pytest.raises(FormatError, match=r"expected a glTF 2\.0 file \(KeyError"):
        mesh_file.read(write(tmp_path / "a.gltf", document(accessors=[{}])))
    for wild in ({"scale": [1e30, 1]}, {"offset": [0, float("nan")]}):
        with pytest.raises(FormatError, match="KHR_texture_transform: expected numbers up to 1e"):
            mesh_file.read(write(tmp_path / "a.gltf", laid(base=wild)))
    circle = [{"mesh": 0, "children": [0]}]
    with pytest.raises(FormatError, match="nodes stand in a circle"):
        mesh_file.read(write(tmp_path / "a.gltf", document(nodes=circle)))
    whole = glb.encode([Body("ball", shapes.sphere(triangles=200), None, (Group("clay", None),))])
    (tmp_path / "a.glb").write_bytes(whole[:-100])
    with pytest.raises(FormatError, match="ends early; the copy may be incomplete"):
        mesh_file.read(tmp_path / "a.glb")


@pytest.mark.errors
def test_pictures_that_cannot_be_written(tmp_path):
    body = shapes.sphere(triangles=200)
    for picture, message in ((tmp_path / "none.png", "found none"), (b"GIF89a", "PNG or JPEG picture for a texture")):
        with pytest.raises(FormatError, match=message):
            glb.encode([Body("ball", body, None, (Group("clay", Finish(albedo_map=picture)),))])
