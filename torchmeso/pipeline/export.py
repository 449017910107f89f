"""Files for other programs: meshes and configurations as GLB with tangents, BTFs as EXR pictures or Bonn's `.btf`.

Test: tests/pipeline/test_export.py
"""

from dataclasses import asdict
from pathlib import Path
from typing import Literal

from torchmeso import config
from torchmeso.compress import dfmf
from torchmeso.compress.dfmf import DfmfOptions
from torchmeso.data import btf, btf_file, btfdbb_write, exr_stack, journal, store
from torchmeso.data.store import replacing
from torchmeso.errors import ConfigError
from torchmeso.geometry import glb, mesh, mesh_file
from torchmeso.geometry.glb import Body
from torchmeso.geometry.mesh_file import Finish, Group
from torchmeso.pipeline import bake, scene
from torchmeso.pipeline.bake import Report, silent


def to_glb(path: str | Path, out: str | Path) -> None:
    """Write `path`, a mesh file or a configuration, as a GLB file: normals, tangents, texture coordinates, parts.

    Parts keep the looks that glTF has words for (colour, normal map); materials with a mesostructure leave their name.

    Raises:
        MesoError: a file is missing or unreadable, or a mesh has no texture coordinates.
    """
    path = Path(path)
    if path.suffix.lower() in (".yaml", ".yml"):
        bodies = _of_configuration(config.load(path))
    else:
        found = mesh_file.read(path)
        dressed, part = mesh.dress_parts(found, name=path.name)
        bodies = [Body(path.stem, dressed, part, found.groups)]
    with replacing(out) as beside:
        beside.write_bytes(glb.encode(bodies))


def to_exr_stack(path: str | Path, out: str | Path, report: Report = silent) -> None:
    """Write the BTF of a raw table (.btf.zarr) as the folder `out`: EXR pictures and their directions.

    Raises:
        FormatError: the table is missing or damaged.
        StorageError: the disk is full, or the place cannot be written to.
    """
    exr_stack.write(btf.load(path), out, progress=lambda x: report("pictures", x))


def to_bonn(
    path: str | Path,
    out: str | Path,
    *,
    method: Literal["dfmf", "bdi"] = "dfmf",
    rank: int | None = None,
    report: Report = silent,
) -> None:
    """Write the BTF `path` as a `.btf` file: factored (dfmf), or all values as halves (bdi).

    Args:
        path: a raw table (.btf.zarr), or another `.btf`.
        out: the file.
        method: dfmf is what readers by others know; bdi loses nothing but the bits below half.
        rank: of dfmf, components of each colour channel; none = 64 or all.
        report: called with a name and the share done, 0..1.

    Raises:
        ConfigError: the rank is out of range, or given to bdi.
        MesoError: the BTF is missing, damaged, or holds values that the format cannot.
    """
    table = btf_file.load(path)
    if method == "bdi":
        if rank is not None:
            raise ConfigError("export: --method bdi keeps all values; leave --rank out")
        btfdbb_write.write_bdi(out, table, progress=lambda x: report("chunks", x))
        return
    options = DfmfOptions(rank=rank)
    key = store.content_hash(journal.state_of(path), bake.code_hash(), asdict(options))
    with journal.beside(out, key) as kept:
        factors = dfmf.fit(table, options, kept=kept, progress=lambda x: report("factors", x))
        btfdbb_write.write_dfmf(out, btfdbb_write.header_of(table, "!DFMF08FCR"), options.colour, factors)


def _of_configuration(settings: config.Config) -> list[Body]:
    bodies = []
    for item, body in zip(settings.objects, scene.read_bodies(settings), strict=True):
        groups = tuple(_group(settings, look, k) for k, look in enumerate(body.looks))
        name = item.shape or Path(str(item.mesh)).stem
        bodies += [Body(name, mesh.transform(body.mesh, place), body.part, groups) for place in item.places()]
    return bodies


def _group(settings: config.Config, look: str | Finish, k: int) -> Group:
    if isinstance(look, Finish):
        return Group(f"look_{k}", look)
    return Group(look, settings.materials[look].finish)
