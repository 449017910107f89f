"""The maps of a run-time model as textures, with a small JSON of what they are: for engines that know no `.meso`.

A folder holds, of an eigen BTF, a picture per component and light (`eigen/k00_l000.png`); of a double-SH BTF one per
pair of coefficients (`sh/i00_j00.png`), of an SH + PCA BTF a grey one per component and view
(`sh_pca/k00_v000.png`), each with the formula that puts them together, scales, offsets, directions
and weights in `maps.json`. Codes of 8 bits become PNG, value for value, floats become EXR. For engines that only want
the usual maps there are `ambient.exr` (what even light from everywhere shows from above, linear), and where the
model has an MDF `height.exr` (depth below the reference plane in tile units, minus, as displacement maps have it) and
`mdf/v000.png` (the drop, and in its alpha where the ray hits).

Test: tests/pipeline/test_textures.py
"""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Shaped
from torch import Tensor

from torchmeso.data import image, store
from torchmeso.data.address import texel_centres
from torchmeso.data.eigen_btf import EigenBtf
from torchmeso.data.mdf import Mdf
from torchmeso.data.sh_btf import ShBtf
from torchmeso.data.sh_pca_btf import ShPcaBtf
from torchmeso.errors import ConfigError
from torchmeso.geometry import gaps
from torchmeso.geometry.hemisphere import DirectionSet
from torchmeso.pipeline.bake import Report, open_model, silent

EIGEN = "T(wi, wo) = sum_k W_k(wo) (offset_k + scale_k E_k(wi)), E_k interpolated between lights, W_k between views"
SH_PCA = (
    "T(wi, wo) = sum_km (offset_k + scale_k W_k(wo)) b_kmc y_m(wi), real spherical harmonics, (l, m) order, W_k "
    "interpolated between views"
)
HARMONICS = "T(wi, wo) = sum_ij (offset_ij + scale_ij C_ij) y_i(wi) y_j(wo), real spherical harmonics, (l, m) order"


def write(path: str | Path, folder: str | Path, report: Report = silent) -> None:
    """Write the maps of the run-time model `path` (.meso) into `folder`; one that stood there is replaced.

    Raises:
        ConfigError: the model is of a kind without maps that could be textures.
        FormatError: the model is missing or damaged.
        StorageError: the disk is full, or the place cannot be written to.
    """
    found, folder = open_model(path), Path(folder)
    beside = folder.with_name(folder.name + ".part")
    with store.writing(folder):
        if beside.exists():  # of a run that was stopped
            shutil.rmtree(beside)
        beside.mkdir(parents=True)
        about: dict[str, Any] = {
            "made_from": Path(path).name,
            "values": "T = pi f_r cos(theta_i), linear RGB; u right, v up, row 0 on top; tiles repeat",
            "light_beyond_last_ring": "T of that ring times cos(theta_i) / cos(last); 0 below the horizon",
        }
        if isinstance(found.btf, EigenBtf):
            about["btf"] = _eigen(found.btf, beside, report)
        elif isinstance(found.btf, ShBtf):
            about["btf"] = _harmonic(found.btf, beside, report)
        elif isinstance(found.btf, ShPcaBtf):
            about["btf"] = _components(found.btf, beside, report)
        else:
            raise ConfigError(f"{path}: expected a compressed BTF, got {type(found.btf).__name__}")
        uv = texel_centres(*found.btf.texels).reshape(-1, 2)
        up = torch.tensor([0.0, 0, 1]).expand(len(uv), 3)
        image.write_exr(beside / "ambient.exr", found.btf.ambient(uv, up).unflatten(0, found.btf.texels))
        about["ambient"] = "ambient.exr"
        if isinstance(found.mdf, Mdf):
            about["mdf"] = _mdf(found.mdf, beside)
        (beside / "maps.json").write_text(json.dumps(about, indent=1) + "\n", encoding="utf-8")
        store.replace_directory(beside, folder)


def _eigen(model: EigenBtf, folder: Path, report: Report) -> dict[str, Any]:
    (folder / "eigen").mkdir()
    maps = model.maps
    for k in range(model.rank):
        for l in range(len(model.lights)):
            _texture(folder / "eigen" / f"k{k:02d}_l{l:03d}", maps[l, :, :, k])
        report("textures", (k + 1) / model.rank)
    return {
        "formula": EIGEN, "files": f"eigen/k00_l000{_suffix(maps)}: component, light", "code_unit": _unit(maps),
        "lights_deg": _angles(model.lights), "views_deg": _angles(model.views),
        "scale": model.scale.tolist(), "offset": model.offset.tolist(), "view_weights": model.weights.tolist(),
    }  # fmt: skip


def _harmonic(model: ShBtf, folder: Path, report: Report) -> dict[str, Any]:
    (folder / "sh").mkdir()
    for i in range(model.terms[0]):
        for j in range(model.terms[1]):
            _texture(folder / "sh" / f"i{i:02d}_j{j:02d}", model.maps[i, j])
        report("textures", (i + 1) / model.terms[0])
    return {
        "formula": HARMONICS, "files": f"sh/i00_j00{_suffix(model.maps)}: light's and view's coefficient",
        "code_unit": _unit(model.maps), "last_light_deg": model.lights.theta_deg[-1],
        "last_view_deg": model.views.theta_deg[-1], "scale": model.scale.tolist(), "offset": model.offset.tolist(),
    }  # fmt: skip


def _components(model: ShPcaBtf, folder: Path, report: Report) -> dict[str, Any]:
    (folder / "sh_pca").mkdir()
    for k in range(model.rank):
        for v in range(len(model.views)):
            _texture(folder / "sh_pca" / f"k{k:02d}_v{v:03d}", model.maps[v, :, :, k, None].expand(-1, -1, 3))
        report("textures", (k + 1) / model.rank)
    return {
        "formula": SH_PCA, "files": f"sh_pca/k00_v000{_suffix(model.maps)}: component, view, the same in all channels",
        "code_unit": _unit(model.maps), "last_light_deg": model.lights.theta_deg[-1], "views_deg": _angles(model.views),
        "scale": model.scale.tolist(), "offset": model.offset.tolist(), "basis": model.basis.tolist(),
    }  # fmt: skip


def _mdf(model: Mdf, folder: Path) -> dict[str, Any]:
    from PIL import Image

    (folder / "mdf").mkdir()
    codes = model.delta if model.delta.dtype == torch.uint8 else (model.delta * 255).round().to(torch.uint8)
    hit = torch.ones_like(codes, dtype=torch.bool) if model.no_hit is None else ~model.no_hit
    for v in range(len(codes)):
        both = np.stack([codes[v].numpy(), 255 * hit[v].numpy().astype(np.uint8)], -1)
        Image.fromarray(both).save(folder / "mdf" / f"v{v:03d}.png", format="PNG")
    depth = model.depth(texel_centres(*model.texels))
    height = torch.where(depth.isfinite(), -depth, -model.h)
    image.write_exr(folder / "height.exr", height[..., None].expand(*height.shape, 3))
    return {
        "formula": "D(wo) = h delta(wo) / cos(theta_o): distance along -wo from the reference plane",
        "files": "mdf/v000.png: view; grey = 255 delta, alpha = 255 where the ray hits", "h": model.h,
        "views_deg": _angles(model.directions), "height": "height.exr: height in tile units, 0 = reference plane",
    }  # fmt: skip


def _texture(path: Path, values: Shaped[Tensor, "H W 3"]) -> None:
    """Write codes as they are, or floats; not sRGB."""
    from PIL import Image

    if values.dtype == torch.uint8:
        Image.fromarray(values.contiguous().numpy()).save(path.with_suffix(".png"), format="PNG")
    else:
        image.write_exr(path.with_suffix(".exr"), values.float())


def _suffix(maps: Tensor) -> str:
    return ".png" if maps.dtype == torch.uint8 else ".exr"


def _unit(maps: Tensor) -> str:
    return "codes 0 to 255, data and not sRGB" if maps.dtype == torch.uint8 else "values"


def _angles(directions: DirectionSet) -> list[list[float]]:
    """Return theta and phi."""
    return [list(pair) for pair in gaps.angles_deg(directions)]
