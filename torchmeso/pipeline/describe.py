"""What is in a file: sizes, directions, origin.

Test: tests/pipeline/test_describe.py
"""

import math
from pathlib import Path
from typing import Any

import torch

from torchmeso import config
from torchmeso.config_sections import ObjectConfig
from torchmeso.data import (
    btf,
    btfdbb,
    btfdbb_colour,
    gdm,
    hsh,
    image,
    mdf,
    picture_set,
    ptm,
    quilting_map,
    rti,
    store,
    tile_set,
    tiled_surface,
)
from torchmeso.errors import FormatError, human_size
from torchmeso.geometry import mesh, mesh_file, unwrap
from torchmeso.geometry.mesh_file import Group
from torchmeso.pipeline import picture_sets


def file(path: str | Path) -> dict[str, Any]:
    """Return facts about a table, a model, a configuration, a picture or a mesh, by name.

    Raises:
        FormatError: the file is missing or damaged, or its kind is not known.
    """
    path = Path(path)
    if not path.exists():
        raise FormatError(f"{path}: expected a file, found none; check the path")
    name = path.name.lower()
    if name.endswith(".btf.zarr"):
        return _btf(path)
    if name.endswith(".mdf.zarr"):
        return _mdf(path)
    if name.endswith(".gdm.zarr"):
        return _gdm(path)
    if name.endswith(".btf"):
        return _bonn(path)
    if picture_sets.is_one(path):
        return _picture_set(path)
    if name.endswith(".meso"):
        return _model(path)
    if name.endswith(".quilt"):
        return {**quilting_map.describe(path), "on disk": _size(path)}
    if name.endswith(".tiles"):
        return {**tile_set.describe(path), "on disk": _size(path)}
    if name.endswith(".surface"):
        return {**tiled_surface.describe(path), "on disk": _size(path)}
    if name.endswith((".lp", ".ptm", ".rti")):
        return _rti(path)
    if name.endswith((".yaml", ".yml")):
        return _config(path)
    if name.endswith((".png", ".jpg", ".jpeg", ".tif", ".tiff", ".exr", ".hdr")):
        rgb = image.read(path)
        return {"kind": "picture", "size": f"{rgb.shape[1]} x {rgb.shape[0]}", "largest value": float(rgb.max())}
    if name.endswith((".obj", ".ply", ".glb", ".gltf", ".off", ".stl")):
        return _mesh(path)
    raise FormatError(
        f"{path}: expected a table (.btf.zarr, .mdf.zarr, .gdm.zarr, .btf), a model (.meso), "
        "a quilting map (.quilt), tiles (.tiles), a surface (.surface), a configuration (.yaml), a folder or zip of "
        "the pictures of a BTF, an RTI file (.lp, .ptm, .rti), a picture or a mesh"
    )


def _btf(path: Path) -> dict[str, Any]:
    table = btf.load(path)
    group = store.open_table(path, "btf")
    return {
        "kind": "BTF table",
        "lights": f"{len(table.lights)}, {table.lights.name}",
        "views": f"{len(table.views)}, {table.views.name}",
        "texels": f"{table.texels[1]} x {table.texels[0]}",
        "slab depth (tiles)": table.h,
        **({"filled in": store.attributes(group)["filled"]} if "filled" in store.attributes(group) else {}),
        **_origin(store.attributes(group)),
        "on disk": _size(path),
    }


def _picture_set(path: Path) -> dict[str, Any]:
    found = picture_sets.survey(path)
    height, width = picture_set.size(found)
    return {
        "kind": "BTF in pictures",
        "lights": f"{len(found.lights)}, {found.lights.name}",
        "views": f"{len(found.views)}, {found.views.name}",
        "texels": f"{width} x {height}",
        "values": "sRGB codes" if found.encoding == "srgb" else "linear",
        "pictures": len(found.files),
        "missing": found.missing_text(),
        "on disk": _size(path),
    }


def _bonn(path: Path) -> dict[str, Any]:
    found = btfdbb.survey(path)
    header = found.header
    try:
        lights, views = (f", {x.directions.name}" for x in found.directions())
    except FormatError:  # what is wrong with them is said where they are asked for
        lights = views = ", not all on rings of even steps"
    told = {None: "not told (taken as held)", True: "held", False: "not held (multiplied in)"}
    notes = {"measured with": ", ".join(filter(None, header.setup)), "pixels per mm": header.ppmm}
    return {
        "kind": f"Bonn BTF ({header.signature}, version {header.version})",
        "lights": f"{len(header.lights)}{lights}",
        "views": f"{len(header.views)}{views}",
        "texels": f"{header.width} x {header.height}",
        "channels": ", ".join(header.channels),
        "colour model": f"{found.colour.model} ({found.colour.name})",
        "cos(theta_i)": told[header.cosine],
        **found.body.facts(),
        **{name: value for name, value in notes.items() if value},
        "on disk": _size(path),
    }


def _rti(path: Path) -> dict[str, Any]:
    if path.suffix.lower() == ".lp":
        lights = rti.read(path)
        height, width, _ = next(lights.pictures()).shape
        last = math.degrees(math.acos(float(lights.directions[:, 2].clamp(-1, 1).min())))
        about = {"kind": "RTI picture set", "lights": len(lights.files), "lowest light": f"{last:.0f} deg from above"}
    elif path.suffix.lower() == ".ptm":
        found = ptm.read(path)
        height, width, planes, _ = found.codes.shape
        about = {"kind": "polynomial texture map", "format": "LRGB" if planes == 1 else "RGB"}
    else:
        height, width, _, terms = hsh.read(path).codes.shape
        about = {"kind": "hemispherical harmonics map", "terms": terms}
    return {**about, "texels": f"{width} x {height}", "on disk": _size(path)}


def _mdf(path: Path) -> dict[str, Any]:
    table = mdf.load(path)
    group = store.open_table(path, "mdf")
    return {
        "kind": "MDF table",
        "views": f"{len(table.directions)}, {table.directions.name}",
        "texels": f"{table.texels[1]} x {table.texels[0]}",
        "slab depth (tiles)": table.h,
        "largest drop": table.delta_max,
        "entries without a hit": 0.0 if table.no_hit is None else float(table.no_hit.float().mean()),
        **_origin(store.attributes(group)),
        "on disk": _size(path),
    }


def _gdm(path: Path) -> dict[str, Any]:
    table = gdm.load(path)
    layers, height, width = table.voxels
    return {
        "kind": "GDM table",
        "voxels": f"{width} x {height} x {layers}",
        "directions": f"{table.directions.n_theta} x {table.directions.n_phi}",
        "slab depth (tiles)": table.h,
        "longest distance (tiles)": table.cap,
        "solid": float((table.occupancy > 0.5).float().mean()),
        "rays that leave": float(table.left.float().mean()),
        **_origin(store.attributes(store.open_table(path, "gdm"))),
        "on disk": _size(path),
    }


def _model(path: Path) -> dict[str, Any]:
    model = store.Model(path)
    about: dict[str, Any] = {"kind": f"run-time model ({model.meta.get('kind', 'unknown')})"}
    kinds = {"eigen": _eigen, "sh": _double_sh, "sh_pca": _sh_pca, "transform": _transform, "factored": _factored}
    with store.reading(path):
        for kind, told in kinds.items():
            if kind in model.meta:
                about |= {**told(model), **_psnr(model), "BTF data": _held(model, f"{kind}.")}
        for kind, told in {"svd": _factored_gdm, "coded": _coded_gdm}.items():
            if kind in model.meta:
                about |= {**told(model), "distances": _held(model, f"{kind}."), "bits, material": _held(model, "gdm.")}
        if "mdf" in model.meta:
            about["MDF"] = f"{model.meta['mdf']['directions']}, h = {model.meta['mdf']['h']:g} tiles"
            about["MDF data"] = _held(model, "mdf.")
    return {**about, "on disk": _size(path)}


def _eigen(model: store.Model) -> dict[str, Any]:
    eigen = model.meta["eigen"]
    about = {name: eigen[name] for name in ("rank", "lights", "views")}
    return {**about, **_maps(model, eigen, "eigen.map.0")}


def _double_sh(model: store.Model) -> dict[str, Any]:
    sh = model.meta["sh"]
    about = {name: sh[name] for name in ("domain", "lights", "views")}
    terms = "{} x {} of light and view".format(*sh["terms"])
    return {"coefficients": terms, **about, **_maps(model, sh, "sh.map.0.0")}


def _maps(model: store.Model, about: dict[str, Any], first: str) -> dict[str, Any]:
    """Return size and storage of maps (..., H, W, 3), of which `first` is one."""
    if "texels" in about:
        return {"texels": "{1} x {0}".format(*about["texels"]), "storage": "uint8, adaptive steps, entropy-coded"}
    maps = model.read(first)
    return {"texels": f"{maps.shape[-2]} x {maps.shape[-3]}", "storage": str(maps.dtype).removeprefix("torch.")}


def _transform(model: store.Model) -> dict[str, Any]:
    transform = model.meta["transform"]
    about = {name: transform[name] for name in ("rank", "lights", "views")}
    return {**about, "texels": "{1} x {0}".format(*transform["texels"])}


def _factored(model: store.Model) -> dict[str, Any]:
    factored, texels = model.meta["factored"], model.read("factored.by_texel").shape[1:3]
    return {
        "rank": f"{factored['rank']} of each channel",
        "colour model": f"{factored['colour']} ({btfdbb_colour.NAMES[factored['colour']]})",
        "opens as": f"eigen BTF of rank {factored['opened_rank']}",
        "lights": factored["lights"],
        "views": factored["views"],
        "texels": f"{texels[1]} x {texels[0]}",
    }


def _factored_gdm(model: store.Model) -> dict[str, Any]:
    return {"rank": model.meta["svd"]["rank"], **_slab(model.meta["svd"])}


def _coded_gdm(model: store.Model) -> dict[str, Any]:
    step = model.meta["coded"]["step"]
    return {
        "exact": "yes" if step == 1 else f"to {step / 2:g} / 255 of the longest distance",
        **_slab(model.meta["coded"]),
    }


def _slab(about: dict[str, Any]) -> dict[str, Any]:
    """Return what GDMs of all forms have."""
    layers, height, width = about["voxels"]
    return {
        "voxels": f"{width} x {height} x {layers}",
        "directions": f"{about['n_theta']} x {about['n_phi']}",
        "slab depth (tiles)": about["h"],
        "longest distance (tiles)": about["cap"],
    }


def _psnr(model: store.Model) -> dict[str, Any]:
    """Return the error, where a fit was made to a budget and knew it."""
    return {"PSNR when fitted (dB)": model.meta["psnr"]} if "psnr" in model.meta else {}


def _sh_pca(model: store.Model) -> dict[str, Any]:
    sh, first = model.meta["sh_pca"], model.read("sh_pca.map.0")
    return {
        "rank": sh["rank"],
        "coefficients": f"{sh['terms']} of the light",
        "domain": sh["domain"],
        "lights": sh["lights"],
        "views": sh["views"],
        "texels": f"{first.shape[2]} x {first.shape[1]}",
        "storage": str(first.dtype).removeprefix("torch."),
    }


def _config(path: Path) -> dict[str, Any]:
    settings = config.load(path)
    return {
        "kind": "configuration",
        "name": settings.name,
        "materials": ", ".join(settings.materials),
        "objects": ", ".join(map(_object, settings.objects)),
        "lights": ", ".join(light.type for light in settings.lights) or "none",
        "picture": f"{settings.camera.width} x {settings.camera.height}",
        "silhouette": settings.render.silhouette,
    }


def _object(item: ObjectConfig) -> str:
    names = ", ".join(sorted(item.used_materials)) or "as its file says"
    times = f" x {len(item.instances)}" if item.instances else ""
    return f"{item.shape or Path(str(item.mesh)).name}{times} ({names})"


def _mesh(path: Path) -> dict[str, Any]:
    found = mesh_file.read(path)
    about: dict[str, Any] = {"kind": "mesh", "vertices": len(found.vertices), "triangles": len(found.faces)}
    if len(found.groups) > 1 or any(group.finish for group in found.groups):
        about["parts"] = ", ".join(map(_part, found.groups))
    if found.uv is None:
        return {**about, "texture coordinates": "none; a configuration can make some with unwrap: true"}
    dressed = mesh.dress_file(found, name=path.name)
    least, median, most = dressed.scale.quantile(torch.tensor([0.02, 0.5, 0.98])).tolist()
    return {
        **about,
        "components": f"{len(dressed.closed)}, {int(dressed.closed.sum())} closed",
        "texture coordinates": f"{found.uv_sets} sets" if found.uv_sets > 1 else "1 set",
        "texture scale": f"{median:.4g} world units per unit of uv ({least:.3g} to {most:.3g} but for 4 %)",
        "texture seams": str(unwrap.find_seams(dressed.vertices, dressed.faces, dressed.uv)),
        "mirrored": f"{float((dressed.sign[dressed.faces[:, 0]] < 0).float().mean()):.0%} of the triangles",
        "tangents": "from the file" if found.tangents is not None else "found",
        "anisotropy": round(mesh.anisotropy(dressed), 3),
    }


def _part(group: Group) -> str:
    pictures = []
    if group.finish is not None:
        pictures = [k for k in ("albedo_map", "normal_map") if getattr(group.finish, k) is not None]
    return f"{group.name} ({', '.join(pictures)})" if pictures else group.name


def _origin(about: dict[str, Any]) -> dict[str, Any]:
    return {"made from": about["source"]} if "source" in about else {}


def _held(model: store.Model, prefix: str) -> str:
    """Return the size of a model's tensors whose names begin with `prefix`."""
    tensors = (model.read(name) for name in model.names() if name.startswith(prefix))
    return human_size(sum(x.numel() * x.element_size() for x in tensors))


def _size(path: Path) -> str:
    files = [path] if path.is_file() else [f for f in path.rglob("*") if f.is_file()]
    return human_size(sum(f.stat().st_size for f in files))
