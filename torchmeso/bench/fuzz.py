"""Damaged configurations, meshes, models and tables, and what reads them: only our own errors may leave.

Every damage is drawn from a `random.Random`, so that a case is known by its seed; the tests let hypothesis draw.

Test: tests/bench/test_fuzz.py
"""

import copy
import shutil
import tempfile
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from random import Random
from typing import Any, NamedTuple

import torch
import yaml

from torchmeso import config
from torchmeso.bench.suite import Context, Measurement, Row
from torchmeso.compress import eigen
from torchmeso.compress.eigen import EigenOptions
from torchmeso.data import btf, eigen_btf, gdm, image, mdf
from torchmeso.data.btf import Btf
from torchmeso.data.mdf import Mdf
from torchmeso.errors import MesoError
from torchmeso.geometry import hemisphere, mesh, mesh_file, shapes
from torchmeso.meso import bake_gdm, generators
from torchmeso.meso.bake_gdm import GdmOptions
from torchmeso.pipeline import demo
from torchmeso.pipeline.bake import open_model
from torchmeso.render import frame
from torchmeso.render.frame import FrameOptions
from torchmeso.render.scene import Material, Object, Scene

ODDITIES: tuple[Any, ...] = (
    None, True, False, 0, 1, -1, 2**31, 2**63, 10**400, 0.0, -0.0, 1e-300, 1e300, float("inf"), float("nan"), "", " ",
    "auto", "brick", "nan", "1e-3", "\0", "\ud7ff", "../" * 40, "x" * 5000, "grid(0, 0, 0)", "grid(12, 5, 80)",
    "grid(99999999999, 1, 1)", "grid(3, 3, 1.2.3)", [], {}, [1], [0, 0, 0], [1, 2, 3], [1e300] * 3, [[]], {"type": 1},
    {1: 2}, {"a": {"b": []}}, ["x"] * 3,
)  # fmt: skip
"""What a value of a configuration is replaced by."""


class Kind(NamedTuple):
    """One kind of input: what it is called, its share of all cases, and a maker of its cases."""

    name: str
    share: float
    prepare: "Callable[[Path], Callable[[Random], None]]"
    """Takes an empty folder, and returns a function that damages one input there and has it read."""


def damaged_tree(tree: Any, random: Random) -> Any:
    """Return a copy of a tree of dictionaries and lists with one to four places changed."""
    tree = copy.deepcopy(tree)
    for _ in range(random.randint(1, 4)):
        places = [
            (node, key) for node in _nodes(tree) for key in (node if isinstance(node, dict) else range(len(node)))
        ]
        if not places:
            return tree
        node, key = random.choice(places)
        kind = random.randrange(5)
        if kind == 0:
            del node[key]
        elif kind == 1:
            node[key] = copy.deepcopy(random.choice(ODDITIES))
        elif kind == 2 and isinstance(node, dict):
            node[random.choice(["rank", "typ", "mesh", "model", "", 7, None, "btf", "unwrap"])] = node.pop(key)
        elif kind == 3:
            other, place = random.choice(places)
            node[key] = copy.deepcopy(other[place]) if place in other or isinstance(other, list) else None
        elif isinstance(node[key], int | float) and not isinstance(node[key], bool) and abs(node[key]) < 1e300:
            node[key] = random.choice([-node[key], node[key] * 1e6, node[key] * 1e-6, str(node[key]), [node[key]]])
        else:
            node[key] = copy.deepcopy(random.choice(ODDITIES))
    return tree


def damaged_bytes(content: bytes, random: Random) -> bytes:
    """Return `content` cut off, with bits turned, or with pieces left out, repeated or made up."""
    found = bytearray(content)
    for _ in range(random.randint(1, 4)):
        if not found:
            break
        at, length = random.randrange(len(found)), random.randint(1, 16)
        kind = random.randrange(6)
        if kind == 0:
            del found[at:]
        elif kind == 1:
            found[at] ^= 1 << random.randrange(8)
        elif kind == 2:
            del found[at : at + length]
        elif kind == 3:
            found[at:at] = found[at : at + length]
        elif kind == 4:
            found[at : at + length] = bytes(random.randrange(256) for _ in range(length))
        else:
            found[at : at + length] = random.choice(
                [b"nan", b"inf", b"-1", b"1e999", b"99999999999", b"0", b"\n", b"/"]
            )
    return bytes(found)


def _nodes(tree: Any) -> Iterator[dict | list]:
    if isinstance(tree, dict | list):
        yield tree
        for child in tree.values() if isinstance(tree, dict) else tree:
            yield from _nodes(child)


def configurations(folder: Path) -> Callable[[Random], None]:
    """Configurations: trees of the ones that ship, and their text."""
    texts = [path.read_text() for path in sorted(demo.built_in("demo").parent.glob("*.yaml"))]
    trees, path = [yaml.safe_load(text) for text in texts], folder / "a.yaml"

    def case(random: Random) -> None:
        if random.random() < 0.3:
            path.write_bytes(damaged_bytes(random.choice(texts).encode(), random))
            found = config.load(path)
        else:
            found = config.parse(damaged_tree(random.choice(trees), random), folder=folder)
        found.camera.build()
        for light in found.lights:
            light.build()
        for item in found.objects:
            item.matrix()
            if item.shape is not None and random.random() < 0.02:
                item.model_copy(update={"options": {**item.options, "triangles": 300}}).build_shape()

    return case


SHELLED = """
name: shell
materials:
  a: {meso: {type: weave, h: 0.16, segments: 4}, gdm: {texels: 4, layers: 2, n_theta: 2, n_phi: 3, cap: 1.0},
      shell: {side: outward, base: open, queries: 2}, floor: [0.1, 0.2, 0.3]}
objects:
  - {shape: torus, options: {triangles: 100, tube: 0.4}, tiles: [3, 1], scale: 1.0, material: a}
lights: [{type: directional, direction: [0.5, 0.8, 0.4]}]
camera: {eye: [0, 2, 2], width: 4, height: 4}
"""
"""A configuration small enough to be baked and drawn, whatever its numbers become."""

MOST_SAMPLES = 1 << 14
"""Of a table that is baked for a case."""


def shells(folder: Path) -> Callable[[Random], None]:
    """Configurations with a GDM in a shell: read, baked and drawn."""
    tree = yaml.safe_load(SHELLED)

    def case(random: Random) -> None:
        section = random.choice([tree["materials"]["a"], tree["materials"]["a"], tree["objects"][0], tree])
        part = damaged_tree(section, random)
        content = copy.deepcopy(tree)
        if section is tree:
            content = part
        elif section is tree["objects"][0]:
            content["objects"][0] = part
        else:
            content["materials"]["a"] = part
        _draw(config.parse(content, folder=folder))

    return case


def _draw(found: config.Config) -> None:
    """Bake and draw a configuration of a shape in a shell, unless it has become too large for that."""
    material, item = found.materials["a"], found.objects[0]
    if material.gdm is None or material.meso is None or item.shape is None:
        return
    meso = material.meso.build()
    body, camera = item.build_shape(), found.camera.build()
    if len(body.faces) > 200 or camera.width * camera.height > 256:
        return
    yarns = material.meso.arguments
    if yarns.get("count", 4) * yarns.get("segments", 24) > 24:
        return
    options = material.gdm
    if options.layers * options.texels**2 * options.n_theta * options.n_phi * options.supersample**3 > MOST_SAMPLES:
        return
    table = bake_gdm.in_memory(meso, options)
    scene = Scene(
        objects=(
            Object(
                mesh=mesh.transform(body, item.matrix()),
                material=Material(gdm=table, shell=material.shell, albedo=material.floor),
            ),
        ),
        lights=tuple(light.build() for light in found.lights),
    )  # fmt: skip
    picture = frame.render(scene, camera, FrameOptions(shadow_map_size=16))
    if not bool(picture.rgb.isfinite().all()):
        raise ArithmeticError("values of the picture are not finite")


def meshes(folder: Path) -> Callable[[Random], None]:
    """Mesh files, and random triangles."""
    import trimesh
    from trimesh.visual import TextureVisuals

    body = shapes.sphere(triangles=64)
    visual = TextureVisuals(uv=body.uv.numpy())
    solid = trimesh.Trimesh(body.vertices.numpy(), body.faces.numpy(), visual=visual, process=False)
    files = {}
    for suffix in ("obj", "ply", "off", "stl", "glb"):
        exported = solid.export(file_type=suffix)
        files[suffix] = exported.encode() if isinstance(exported, str) else bytes(exported)

    def case(random: Random) -> None:
        if random.random() < 0.3:
            mesh.dress(*_soup(random))
            return
        suffix = random.choice(sorted(files))
        path = folder / f"a.{suffix}"
        path.write_bytes(damaged_bytes(files[suffix], random))
        found = mesh_file.read(path)
        if found.uv is not None:
            mesh.dress_file(found)

    return case


def _soup(random: Random) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return a few random triangles, degenerate and far-out ones among them."""
    rng = torch.Generator().manual_seed(random.randrange(2**31))
    n_vertex, n_face = random.randint(0, 12), random.randint(0, 20)
    size = random.choice([1.0, 0.0, 1e-30, 1e-6, 1e6, 1e20, float("nan")])
    vertices = torch.randn(n_vertex, 3, generator=rng) * size
    if random.random() < 0.3:
        vertices = vertices.round()
    faces = torch.randint(-1 if random.random() < 0.1 else 0, max(n_vertex, 1), (n_face, 3), generator=rng)
    uv = torch.rand(n_vertex, 2, generator=rng) * random.choice([1.0, 0.0, 1e-20, 1e4, 1e12])
    return vertices, faces, uv


def models(folder: Path) -> Callable[[Random], None]:
    """Run-time models: bytes damaged, in the header more often than in the tensors, or a tensor left out."""
    directions, depth = hemisphere.parse("grid(3, 2, 80)"), hemisphere.parse("grid(3, 2, 87.5)")
    images = torch.rand(6, 6, 4, 4, 3, generator=torch.Generator().manual_seed(0))
    model = eigen.fit(Btf(images=images, lights=directions, views=directions), EigenOptions(rank=2))
    holes = torch.zeros(6, 4, 4, dtype=torch.bool)
    silhouette = Mdf(delta=torch.zeros(6, 4, 4, dtype=torch.uint8), no_hit=holes, directions=depth, h=0.1)
    path = folder / "a.meso"
    eigen_btf.save(model, path, silhouette=silhouette)
    whole = path.read_bytes()
    head = 8 + int.from_bytes(whole[:8], "little")

    def case(random: Random) -> None:
        if random.random() < 0.7:
            header = damaged_bytes(whole[8:head], random)
            start = len(header).to_bytes(8, "little") if random.random() < 0.9 else whole[:8]
            path.write_bytes(start + header + whole[head:])
        else:
            path.write_bytes(damaged_bytes(whole, random))
        open_model(path)

    return case


def tables(folder: Path) -> Callable[[Random], None]:
    """Raw tables: a file of theirs damaged or left out, and a picture in the formats that are read."""
    directions = hemisphere.parse("grid(3, 2, 80)")
    images = torch.rand(6, 6, 4, 4, 3, generator=torch.Generator().manual_seed(0))
    whole = folder / "whole"
    btf.save(Btf(images=images, lights=directions, views=directions, h=0.1), whole / "a.btf.zarr")
    delta = torch.zeros(6, 4, 4, dtype=torch.uint8)
    mdf.save(Mdf(delta=delta, no_hit=None, directions=directions, h=0.1), whole / "a.mdf.zarr")
    tile = bake_gdm.in_memory(generators.sheet(), GdmOptions(texels=2, layers=2, n_theta=2, n_phi=3))
    gdm.save(tile, whole / "a.gdm.zarr")
    image.write_png(whole / "a.png", images[0, 0])
    image.write_exr(whole / "a.exr", images[0, 0])
    files = sorted(p.relative_to(whole) for p in whole.rglob("*") if p.is_file())
    shutil.copytree(whole, folder / "at")

    def case(random: Random) -> None:
        # Metadata are few among the files, and break more.
        near = [f for f in files if f.suffix == ".json"] if random.random() < 0.5 else files
        place = random.choice(near)
        target = folder / "at" / place
        try:
            if random.random() < 0.1:
                target.unlink()
            else:
                target.write_bytes(damaged_bytes((whole / place).read_bytes(), random))
            _read_table(folder / "at", place.parts[0])
        finally:
            shutil.copyfile(whole / place, target)

    return case


def _read_table(folder: Path, name: str) -> None:
    if name.endswith(".btf.zarr"):
        table = btf.load(folder / name)
        table.rows(0, table.texels[0])
    elif name.endswith(".mdf.zarr"):
        mdf.load(folder / name)
    elif name.endswith(".gdm.zarr"):
        gdm.load(folder / name)
    else:
        image.read(folder / name)


KINDS = (
    Kind("config", 0.49, configurations),
    Kind("shell", 0.01, shells),
    Kind("mesh", 0.25, meshes),
    Kind("model", 0.2, models),
    Kind("table", 0.05, tables),
)

CASES = 100_000


def strangers(kind: Kind, count: int, seed: int = 0) -> list[str]:
    """Return what left the readers of `count` damaged inputs and was none of our errors: the case and its text."""
    found = []
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        case = kind.prepare(Path(folder))
        for number in range(seed, seed + count):
            try:
                case(Random(number))
            except MesoError:
                pass
            except Exception as error:
                found.append(f"case {number}: {type(error).__name__}: {error}")
    return found


def fuzz(context: Context) -> Iterator[Row]:
    """Damaged inputs of every kind."""
    for kind in KINDS:
        count = round(kind.share * (CASES // 50 if context.quick else CASES))
        found = strangers(kind, count)
        yield Row(
            id=f"fuzz.{kind.name}", what=f"of {count} damaged inputs ({kind.name}), those that another error left",
            value=len(found), unit="cases", better="lower", goal=0, n=count, peer=found[0][:200] if found else None,
        )  # fmt: skip


MEASUREMENTS = [Measurement("fuzz", fuzz)]
