"""Configurations: a YAML file -> what every stage is asked to do.

A file names materials (a mesostructure and how to bake and compress it, a finished model, or a plain colour),
objects, lights, a camera and how to render (`config_sections`). Of unknown keys the nearest known one is named. Paths
that start with `data:` lie in TORCHMESO_DATA, others beside the file.

Test: tests/test_config.py
"""

import inspect
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, ValidationError

from torchmeso.compress.double_sh import DoubleShOptions
from torchmeso.compress.eigen import EigenOptions
from torchmeso.compress.sh_pca import ShPcaOptions
from torchmeso.config_sections import (
    CameraConfig,
    Config,
    EnvironmentConfig,
    FeatureConfig,
    MaterialConfig,
    MesoConfig,
    ObjectConfig,
    PlaceConfig,
    RegionConfig,
    SkyConfig,
    SpotConfig,
    TruthConfig,
    WangConfig,
    first_problem,
)
from torchmeso.errors import ConfigError, FormatError
from torchmeso.geometry.unwrap import UnwrapOptions
from torchmeso.meso.bake_btf import BtfOptions
from torchmeso.meso.bake_mdf import MdfOptions
from torchmeso.meso.mesostructure import Mesostructure
from torchmeso.meso.sources import SUFFIXES
from torchmeso.render.frame import FrameOptions
from torchmeso.render.silhouette import Silhouette
from torchmeso.synthesize.parameterize import SurfaceOptions


def load(path: str | Path) -> Config:
    """Return the configuration in the YAML file `path`.

    Raises:
        FormatError: the file is missing or no YAML.
        ConfigError: a key is unknown, or a value is of the wrong kind or out of range.
    """
    path = Path(path)
    if not path.is_file():
        raise FormatError(f"{path}: expected a configuration (.yaml), found none; check the path")
    try:
        content = yaml.safe_load(path.read_text())
    except (yaml.YAMLError, ValueError, RecursionError) as error:  # of dates, of numbers, of text, of nesting
        raise FormatError(f"{path}: expected YAML ({' '.join(str(error).split())})") from error
    if not isinstance(content, dict):
        raise FormatError(f"{path}: expected keys and values, got {type(content).__name__}")
    return parse(content, folder=path.parent, name=str(path))


def parse(content: dict[str, Any], *, folder: Path, name: str = "config") -> Config:
    """Return the configuration in `content`; relative paths lie in `folder`.

    Raises:
        ConfigError: a key is unknown, or a value is of the wrong kind or out of range.
    """
    try:
        return Config.model_validate(_resolve(content, folder))
    except RecursionError as error:
        raise ConfigError(f"{name}: expected keys and values, got a section that holds itself") from error
    except ValidationError as error:
        raise ConfigError(f"{name}: {first_problem(error, _known_keys)}") from error


def build_meso(content: dict[str, Any]) -> Mesostructure:
    """Return the mesostructure that `content` ('type' and its arguments) describes.

    Raises:
        ConfigError: the type or an argument is unknown or out of range.
    """
    try:
        return MesoConfig.model_validate(content).build()
    except ValidationError as error:
        raise ConfigError(f"meso: {first_problem(error, _known_keys)}") from error


def meso_called(name: str) -> MesoConfig:
    """Return the mesostructure that a command line names: a generator, or a file by its suffix (`data:` allowed).

    Raises:
        ConfigError: there is none of that name.
    """
    reader = SUFFIXES.get(Path(name).suffix.lower())
    content = {"type": name} if reader is None else {"type": reader, "path": _absolute(name, Path())}
    try:
        return MesoConfig.model_validate(content)
    except ValidationError as error:
        raise ConfigError(f"meso: {first_problem(error, _known_keys)}") from error


def with_silhouette(config: Config, silhouette: Silhouette) -> Config:
    """Return `config` with another silhouette test."""
    return config.model_copy(update={"render": replace(config.render, silhouette=silhouette)})


def with_environment(config: Config, source: str | None, method: str | None) -> Config:
    """Return `config` under another environment, in place of its lights and ambient light, or by another method.

    Args:
        config: what is lit.
        source: a map, or 'sky'; None = the configuration's own.
        method: sampling, frequency or transfer; None = as it is.

    Raises:
        ConfigError: there is no environment whose method could be another.
    """
    if source is None and config.environment is None:
        raise ConfigError("render: --env-method needs an environment; name one with --env F, or --env sky")
    changes: dict[str, Any] = {} if method is None else {"method": method}
    if source is None:
        assert config.environment is not None
        return config.model_copy(update={"environment": config.environment.model_copy(update=changes)})
    light = {"sky": {}} if source == "sky" else {"map": _absolute(source, Path())}
    update = {"environment": EnvironmentConfig.model_validate({**light, **changes}), "lights": [], "ambient": 0.0}
    return config.model_copy(update=update)


def data_dir() -> Path:
    """Return the folder `data:` stands for: TORCHMESO_DATA, else shared/data beside the checkout."""
    beside = Path(__file__).resolve().parents[2] / "shared" / "data"
    return Path(os.environ.get("TORCHMESO_DATA", beside))


PATH_KEYS = ("map", "mesh", "model", "displacement", "albedo", "albedo_map", "normal_map", "path", "quilting", "mask")


def _resolve(content: Any, folder: Path) -> Any:
    """Return `content` with every path made absolute."""
    if isinstance(content, dict):
        return {
            k: _absolute(v, folder) if k in PATH_KEYS and isinstance(v, str) else _resolve(v, folder)
            for k, v in content.items()
        }
    if isinstance(content, list):
        return [_resolve(x, folder) for x in content]
    return content


def _absolute(text: str, folder: Path) -> str:
    if not text.startswith("data:"):
        return str(folder / text)
    root = data_dir()
    if not root.is_dir():
        raise FormatError(
            f"{text}: the folder of real inputs {root} is missing; set TORCHMESO_DATA to where it is on this machine"
        )
    return str(root / text.removeprefix("data:"))


def _known_keys(place: str) -> list[str]:
    """Return the keys that are known at a dotted place of a configuration."""
    here: Any = Config
    for step in place.split(".") if place else []:
        fields = _fields(here)
        here = fields.get(step, here)
    return list(_fields(here)) or [place]


def _fields(kind: Any) -> dict[str, Any]:
    """Return the keys of a kind of section, with the kind of what is below each."""
    below = {
        "materials": MaterialConfig,
        "objects": ObjectConfig,
        "instances": PlaceConfig,
        "regions": RegionConfig,
        "unwrap": UnwrapOptions,
        "camera": CameraConfig,
        "environment": EnvironmentConfig,
        "sky": SkyConfig,
        "render": FrameOptions,
        "truth": TruthConfig,
        "btf": BtfOptions,
        "mdf": MdfOptions,
        "eigen": EigenOptions,
        "double_sh": DoubleShOptions,
        "sh_pca": ShPcaOptions,
        "lights": SpotConfig,
        "surface": SurfaceOptions,
        "wang": WangConfig,
        "features": FeatureConfig,
    }
    if inspect.isclass(kind) and issubclass(kind, BaseModel):
        names = list(kind.model_fields)
    else:
        names = list(inspect.signature(kind).parameters)
    return {name: below.get(name, kind) for name in names}
