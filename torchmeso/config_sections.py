"""Sections of a configuration: materials, objects, lights, camera, and all of them together.

The stages' own options are used as they are; unknown keys are refused. Files are read by `config`.

Test: tests/test_config.py
"""

import inspect
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator, validate_call

from torchmeso.backends import BackendChoice
from torchmeso.compress.double_sh import DoubleShOptions
from torchmeso.compress.eigen import EigenOptions
from torchmeso.compress.sh_pca import ShPcaOptions
from torchmeso.data import environment as environments
from torchmeso.data import image
from torchmeso.data import sky as skies
from torchmeso.data.environment import Environment
from torchmeso.errors import ConfigError, MesoError, did_you_mean
from torchmeso.geometry.camera import Camera, look_at
from torchmeso.geometry.light import DirectionalLight, Light, PointLight, SpotLight
from torchmeso.geometry.mesh import Mesh
from torchmeso.geometry.mesh_file import Finish
from torchmeso.geometry.shapes import SHAPES
from torchmeso.geometry.unwrap import UnwrapOptions
from torchmeso.meso.bake_btf import BtfOptions
from torchmeso.meso.bake_gdm import GdmOptions
from torchmeso.meso.bake_mdf import MdfOptions
from torchmeso.meso.mesostructure import Mesostructure, Rgb
from torchmeso.meso.sources import SOURCES
from torchmeso.render.frame import FrameOptions
from torchmeso.render.scene import ShellOptions
from torchmeso.synthesize.parameterize import SurfaceOptions
from torchmeso.synthesize.wang import Feature, WangOptions
from torchmeso.transport import light_sampling

Vector = tuple[float, float, float]


class Strict(BaseModel):
    """Frozen, and nothing but the known keys."""

    model_config = ConfigDict(extra="forbid", frozen=True, arbitrary_types_allowed=True, allow_inf_nan=False)


class MesoConfig(BaseModel):
    """A mesostructure: `type`, and the arguments of that generator or reader."""

    model_config = ConfigDict(extra="allow", frozen=True)

    type: str

    @model_validator(mode="after")
    def _check(self) -> "MesoConfig":
        if self.type not in SOURCES:
            raise ValueError(f"expected a mesostructure, got '{self.type}'{did_you_mean(self.type, SOURCES)}")
        parameters = inspect.signature(SOURCES[self.type]).parameters
        for key in self.arguments:
            if key not in parameters:
                raise ValueError(f"{self.type} has no option '{key}'{did_you_mean(key, parameters)}")
        for name, parameter in parameters.items():
            if parameter.default is inspect.Parameter.empty and name not in self.arguments:
                raise ValueError(f"{self.type} needs the option '{name}'")
        return self

    @property
    def arguments(self) -> dict[str, Any]:
        """Options of the generator or reader."""
        return dict(self.model_extra or {})

    @property
    def files(self) -> list[Path]:
        """Files it is made from."""
        return [
            Path(v) for k, v in self.arguments.items() if k in ("displacement", "albedo", "path") and isinstance(v, str)
        ]

    def build(self) -> Mesostructure:
        """Return the mesostructure.

        Raises:
            MesoError: an argument is out of range, or a file is missing or unreadable.
        """
        return call("meso", SOURCES[self.type], self.arguments)


GDMS = (".gdm.zarr", ".gdm.meso")
"""How files end that hold a GDM."""


class FeatureConfig(Strict):
    """A part of the exemplar that is put on an edge or into a tile and stays; see `synthesize.wang.Feature`.

    A rectangle of `size` (rows, columns), or what is brighter than half in a picture `mask`.
    """

    on: Literal["horizontal", "vertical", "tile"]
    number: int = Field(ge=0)
    at: tuple[int, int]
    taken: tuple[int, int]
    size: tuple[int, int] | None = None
    mask: str | None = None

    @model_validator(mode="after")
    def _check(self) -> "FeatureConfig":
        if (self.size is None) == (self.mask is None):
            raise ValueError("expected exactly one of 'size' (rows, columns) and 'mask' (a picture)")
        if self.size is not None and min(self.size) < 1:
            raise ValueError(f"'size': expected at least one row and column, got {self.size}")
        return self

    def build(self) -> Feature:
        """Return the feature.

        Raises:
            FormatError: the mask is missing or unreadable.
        """
        mask = torch.ones(self.size or (1, 1), dtype=torch.bool)
        if self.mask is not None:
            mask = image.to_srgb(image.read(self.mask)).mean(-1) > 0.5
        return Feature(on=self.on, number=self.number, at=self.at, taken=self.taken, mask=mask)


@dataclass(frozen=True, kw_only=True)
class WangConfig(WangOptions):
    """Wang tiles that are cut from a material itself; see `synthesize.wang`.

    Attributes:
        bands: compare only harmonics below this degree, or so many eigen components; None = all.
        seed: the same one gives the same tiles.
        corners: first row and column of each corner sample in the exemplar, chosen by hand.
        features: what is put somewhere and stays.
    """

    bands: int | None = None
    seed: int = 0
    corners: tuple[tuple[int, int], ...] | None = None
    features: tuple[FeatureConfig, ...] = ()


class MaterialConfig(Strict):
    """A mesostructure with how to bake and compress it; or a finished model; or a plain colour with pictures.

    A BTF becomes an eigen BTF, or a double-SH BTF where `double_sh` is given, or an SH + PCA BTF where `sh_pca` is.
    `rank` reads only that many components of a model; the others stay on disk. `albedo` multiplies `albedo_map`.
    With `gdm` the mesostructure stands as material of any form in a `shell` instead, above a `floor` of that colour; a
    `model` may be a GDM too, as baked (.gdm.zarr) or compressed (.gdm.meso). `quilting` is a map (.quilt) that lays
    out BTF, MDF and pictures; texture coordinates stay those of the exemplar. `wang` cuts tiles from the material
    itself, and `quilting` may be a set of tiles (.tiles) too: for objects that are laid out in quads (`surface`).
    """

    meso: MesoConfig | None = None
    model: str | None = None
    rank: int | None = Field(default=None, ge=1)
    albedo: Rgb | None = None
    albedo_map: str | None = None
    normal_map: str | None = None
    normal_scale: float = 1.0
    btf: BtfOptions = Field(default_factory=BtfOptions)
    mdf: MdfOptions = Field(default_factory=MdfOptions)
    eigen: EigenOptions = Field(default_factory=EigenOptions)
    double_sh: DoubleShOptions | None = None
    sh_pca: ShPcaOptions | None = None
    gdm: GdmOptions | None = None
    shell: ShellOptions = Field(default_factory=ShellOptions)
    floor: Rgb = (0.6, 0.6, 0.6)
    quilting: str | None = None
    wang: WangConfig | None = None

    @model_validator(mode="after")
    def _check(self) -> "MaterialConfig":
        plain = self.albedo is not None or self.albedo_map is not None
        if (self.meso is not None) + (self.model is not None) + plain != 1:
            raise ValueError(
                "expected exactly one of 'meso', 'model' (a .meso file) and 'albedo' or 'albedo_map' (a plain colour)"
            )
        if self.normal_map is not None and not plain:
            raise ValueError("'normal_map' belongs to an 'albedo' or 'albedo_map'")
        if self.double_sh is not None and self.sh_pca is not None:
            raise ValueError("expected at most one of 'double_sh' and 'sh_pca', the kind of model")
        if self.gdm is not None and self.meso is None:
            raise ValueError("'gdm' says how to bake a 'meso'; it has none")
        if self.model_fields_set & {"shell", "floor"} and not self.in_shell:
            raise ValueError("'shell' and 'floor' belong to a 'gdm' or to a 'model' that is one (.gdm.zarr, .gdm.meso)")
        if self.quilting is not None and (self.in_shell or (plain and not (self.albedo_map or self.normal_map))):
            raise ValueError("'quilting' lays out a BTF, an MDF or pictures; a GDM and a plain colour have none")
        if self.wang is not None and (self.quilting is not None or self.in_shell or (plain and not self.albedo_map)):
            raise ValueError("'wang' cuts tiles from a BTF or an 'albedo_map', in place of a 'quilting'")
        if self.rank is not None and self.model is None:
            raise ValueError("'rank' belongs to a 'model'; a 'meso' has 'eigen: {rank: ...}'")
        return self

    @property
    def tiled(self) -> bool:
        """Whether it is laid out by tiles."""
        return self.wang is not None or (self.quilting is not None and self.quilting.lower().endswith(".tiles"))

    @property
    def in_shell(self) -> bool:
        """Whether it is a GDM."""
        return self.gdm is not None or (self.model is not None and self.model.rstrip("/").endswith(GDMS))

    @property
    def finish(self) -> Finish | None:
        """The plain look, None where there is a mesostructure or a model."""
        if self.albedo is None and self.albedo_map is None:
            return None
        return Finish(
            albedo=self.albedo or (1.0, 1.0, 1.0),
            albedo_map=None if self.albedo_map is None else Path(self.albedo_map),
            normal_map=None if self.normal_map is None else Path(self.normal_map),
            normal_scale=self.normal_scale,
        )


class PlaceConfig(Strict):
    """Where something stands: scaled, then turned around x, y and z, then moved."""

    scale: float = 1.0
    rotate_deg: Vector = (0.0, 0.0, 0.0)
    translate: Vector = (0.0, 0.0, 0.0)

    def matrix(self) -> torch.Tensor:
        """Return the 4 x 4 matrix."""
        result = torch.eye(4, dtype=torch.float64) * self.scale
        result[3, 3] = 1
        for axis, angle in enumerate(self.rotate_deg):
            a = torch.tensor(angle, dtype=torch.float64).deg2rad()
            i, j = (axis + 1) % 3, (axis + 2) % 3
            turn = torch.eye(4, dtype=torch.float64)
            turn[i, i] = turn[j, j] = a.cos()
            turn[j, i], turn[i, j] = a.sin(), -a.sin()
            result = turn @ result
        result[:3, 3] = torch.tensor(self.translate, dtype=torch.float64)
        return result


class RegionConfig(Strict):
    """Faces whose middle lies in a box, in the mesh's own coordinates before it is placed, and their material."""

    low: Vector
    high: Vector
    material: str


class ObjectConfig(PlaceConfig):
    """A built-in shape or a mesh file, its materials, and where it stands.

    `material` is that of all parts, `materials` gives others to parts of a file (`usemtl`, materials of a glTF file);
    parts without either look as their file says. `regions` give materials to faces by where they lie, later ones over
    earlier ones. `uv_set` chooses among a glTF file's texture coordinates; `unwrap`
    (true, or options of the atlas) makes new ones at one `tile_size`. `instances` are further places, each applied
    after the object's own; the mesh is read once. `surface` lays the mesh out in quads, for a material of tiles; a
    mesh may be a surface (.surface) that was laid out before.
    """

    material: str | None = None
    materials: dict[str, str] = Field(default_factory=dict)
    shape: str | None = None
    mesh: str | None = None
    options: dict[str, Any] = Field(default_factory=dict)
    tiles: float | tuple[float, float] | None = None
    uv_set: int = Field(default=0, ge=0)
    unwrap: bool | UnwrapOptions = False
    tile_size: float | None = None
    instances: list[PlaceConfig] = Field(default_factory=list)
    regions: list[RegionConfig] = Field(default_factory=list)
    surface: SurfaceOptions | None = None

    @model_validator(mode="after")
    def _check(self) -> "ObjectConfig":
        if (self.shape is None) == (self.mesh is None):
            raise ValueError("expected exactly one of 'shape' and 'mesh'")
        if self.shape is not None and self.shape not in SHAPES:
            raise ValueError(f"expected a shape, got '{self.shape}'{did_you_mean(self.shape, SHAPES)}")
        if self.shape is not None:
            known = set(inspect.signature(SHAPES[self.shape]).parameters) - {"tiles"}
            for key in self.options:
                if key not in known:
                    raise ValueError(f"{self.shape} has no option '{key}'{did_you_mean(key, known)}")
            if self.material is None or self.materials or self.uv_set:
                raise ValueError("a built-in 'shape' needs a 'material'; 'materials' and 'uv_set' belong to a 'mesh'")
        elif self.options:
            raise ValueError("'options' belong to built-in shapes")
        if self.unwrap and (self.mesh is None or self.tile_size is None):
            raise ValueError("'unwrap' makes texture coordinates for a 'mesh' and needs 'tile_size' (world units)")
        if self.in_quads and (self.mesh is None or self.material is None or self.materials or self.regions):
            raise ValueError("a mesh laid out in quads ('surface', or a .surface file) has one 'material', of tiles")
        if self.in_quads and (self.unwrap or self.tiles is not None or self.uv_set):
            raise ValueError("quads take the place of 'unwrap', 'tiles' and 'uv_set'; leave these out")
        return self

    @property
    def in_quads(self) -> bool:
        """Whether it is laid out in quads, a tile each."""
        return self.surface is not None or (self.mesh is not None and self.mesh.lower().endswith(".surface"))

    def build_shape(self) -> Mesh:
        """Return the built-in shape, before it is placed.

        Raises:
            ConfigError: an option is of the wrong kind or out of range.
        """
        assert self.shape is not None
        tiles = {} if self.tiles is None else {"tiles": self.tiles_pair}
        return call("objects.options", SHAPES[self.shape], {**self.options, **tiles})

    @property
    def tiles_pair(self) -> tuple[float, float]:
        """Repetitions of the texture along u and v."""
        if self.tiles is None:
            return 1.0, 1.0
        return self.tiles if isinstance(self.tiles, tuple) else (self.tiles, self.tiles)

    @property
    def used_materials(self) -> set[str]:
        """Names of the materials it asks for."""
        named = [*self.materials.values(), *(region.material for region in self.regions)]
        return set(named) | ({self.material} if self.material is not None else set())

    def places(self) -> list[torch.Tensor]:
        """Return the 4 x 4 matrix of every place it stands at."""
        own = self.matrix()
        return [(place.matrix().double() @ own.double()) for place in self.instances] or [own]


class DirectionalConfig(Strict):
    """A distant light; `irradiance` at normal incidence."""

    type: Literal["directional"]
    direction: Vector
    irradiance: Vector = (torch.pi, torch.pi, torch.pi)

    def build(self) -> Light:
        """Return the light."""
        towards = torch.tensor(self.direction, dtype=torch.float32)
        if float(towards.norm()) == 0:
            raise ConfigError("lights.direction: expected a direction towards the light, got 0, 0, 0")
        return DirectionalLight(direction=towards / towards.norm(), irradiance=torch.tensor(self.irradiance))


class PointConfig(Strict):
    """A point light; E = intensity / r^2."""

    type: Literal["point"]
    position: Vector
    intensity: Vector

    def build(self) -> Light:
        """Return the light."""
        position = torch.tensor(self.position, dtype=torch.float64)
        return PointLight(position=position, intensity=torch.tensor(self.intensity))


class SpotConfig(Strict):
    """A spot light at `position` that shines towards `at`."""

    type: Literal["spot"]
    position: Vector
    at: Vector
    intensity: Vector
    inner_deg: float = 25.0
    outer_deg: float = 30.0

    def build(self) -> Light:
        """Return the light."""
        position = torch.tensor(self.position, dtype=torch.float64)
        axis = (torch.tensor(self.at, dtype=torch.float64) - position).float()
        if float(axis.norm()) == 0:
            raise ConfigError("lights.at: expected another place than the light's position")
        return SpotLight(
            position=position,
            axis=axis / axis.norm(),
            intensity=torch.tensor(self.intensity),
            inner_deg=self.inner_deg,
            outer_deg=self.outer_deg,
        )


LightConfig = Annotated[DirectionalConfig | PointConfig | SpotConfig, Field(discriminator="type")]


class CameraConfig(Strict):
    """A camera at `eye` that looks at `at`."""

    eye: Vector
    at: Vector = (0.0, 0.0, 0.0)
    up: Vector = (0.0, 1.0, 0.0)
    projection: Literal["perspective", "orthographic"] = "perspective"
    fov_deg: float = 45.0
    view_height: float = 2.0
    width: int = 800
    height: int = 600
    near: float = 1e-3

    def build(self) -> Camera:
        """Return the camera.

        Raises:
            ConfigError: it looks nowhere, or a value is out of range.
        """
        eye, at, up = (torch.tensor(x, dtype=torch.float64) for x in (self.eye, self.at, self.up))
        place, axes = look_at(eye, at, up)
        rest = self.model_dump(exclude={"eye", "at", "up"})
        return Camera(eye=place, axes=axes, **rest)


class SkyConfig(Strict):
    """The built-in sky; see `data.sky`."""

    elevation_deg: float = 45.0
    azimuth_deg: float = 30.0
    turbidity: float = 3.0


class EnvironmentConfig(Strict):
    """Light from all around: a map or a sky, how it is turned and exposed, and how it lights the scene.

    `lights` and `sampling` are of the method sampling; `degree` of the others (7, and 5 with transfer), `rays` and
    `bounces` of transfer.
    """

    map: str | None = None
    sky: SkyConfig | None = None
    rotate_deg: Vector = (0.0, 0.0, 0.0)
    exposure: float = 0.0
    method: Literal["sampling", "frequency", "transfer"] = "sampling"
    lights: int = Field(default=200, ge=1, le=light_sampling.MOST_LIGHTS)
    sampling: light_sampling.Method = "quadtree"
    degree: int | None = Field(default=None, ge=0, le=10)
    rays: int = Field(default=4096, ge=16, le=65536)
    bounces: int = Field(default=1, ge=0, le=64)

    def build(self) -> Environment:
        """Return the environment.

        Raises:
            MesoError: the map is missing or unreadable, or an argument is out of range.
        """
        if (self.map is None) == (self.sky is None):
            raise ConfigError("environment: expected a map or a sky, got both or none; name one of them")
        if self.map is not None:
            found = environments.read(self.map)
        else:
            found = skies.build(**(self.sky or SkyConfig()).model_dump())
        rotation = PlaceConfig(rotate_deg=self.rotate_deg).matrix()[:3, :3]
        return replace(found, rotation=rotation.float(), exposure=self.exposure)


class TruthConfig(Strict):
    """How the ray-traced truth is made: paths per pixel, bounces, and the longest edge of displaced triangles."""

    samples: int = Field(default=16, ge=1, le=4096)
    bounces: int = Field(default=2, ge=0, le=64)
    max_edge: float = Field(default=0.1, gt=0)


class Config(Strict):
    """Everything a picture needs."""

    name: str = "scene"
    materials: dict[str, MaterialConfig] = Field(default_factory=dict)
    objects: list[ObjectConfig] = Field(min_length=1)
    lights: list[LightConfig] = Field(default_factory=list)
    ambient: float = Field(default=0.05, ge=0)
    ambient_rule: Literal["add", "paper"] = "add"
    background: Vector = (0.0, 0.0, 0.0)
    environment: EnvironmentConfig | None = None
    camera: CameraConfig
    backend: BackendChoice = "auto"
    render: FrameOptions = Field(default_factory=FrameOptions)
    truth: TruthConfig = Field(default_factory=TruthConfig)

    @model_validator(mode="before")
    @classmethod
    def _light_of_all_around(cls, content: Any) -> Any:
        """Light from an environment takes the place of ambient light, unless that is asked for."""
        if isinstance(content, dict) and content.get("environment") is not None and "ambient" not in content:
            return {**content, "ambient": 0.0}
        return content

    @model_validator(mode="after")
    def _check(self) -> "Config":
        for name in sorted(set().union(*(item.used_materials for item in self.objects))):
            if name not in self.materials:
                raise ValueError(f"objects: no material is called '{name}'{did_you_mean(name, self.materials)}")
        for item in self.objects:
            for name in item.used_materials:
                if item.in_quads != self.materials[name].tiled:
                    raise ValueError(
                        f"objects: material '{name}' and its object must both be of tiles: 'wang' or 'quilting' "
                        "(.tiles) of the one, 'surface' or a .surface file of the other"
                    )
        return self


def call(place: str, function: Callable[..., Any], arguments: dict[str, Any]) -> Any:
    """Call `function` with arguments from a file, brought to the types it asks for.

    Raises:
        ConfigError: an argument is of the wrong kind or out of range.
    """
    try:
        return validate_call(function)(**arguments)
    except ValidationError as error:
        raise ConfigError(f"{place}.{first_problem(error)}") from error


def first_problem(error: ValidationError, known: Callable[[str], Iterable[str]] = lambda place: (place,)) -> str:
    """Return one sentence on the first problem of a validation; `known` tells the keys at a dotted place."""
    problems = error.errors()
    # A misspelt key is both unknown and missing: say the former.
    unknown = [p for p in problems if p["type"] in ("extra_forbidden", "unexpected_keyword_argument")]
    problem = (unknown or problems)[0]
    # Union branches and model names are pydantic's own; readers know keys and positions.
    place = ".".join(str(x) for x in problem["loc"] if str(x) not in ("directional", "point", "spot"))
    context = problem.get("ctx", {}).get("error")
    if isinstance(context, MesoError):
        return str(context)
    if problem["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
        key = str(problem["loc"][-1])
        parent = place.rpartition(".")[0]
        return f"unknown key '{place}'{did_you_mean(key, known(parent))}"
    if problem["type"] in ("missing", "missing_keyword_only_argument"):
        return f"'{place}' is missing"
    text = problem["msg"].removeprefix("Value error, ")
    text = text[0].lower() + text[1:]
    if isinstance(context, ValueError):
        return f"{place}: {text}" if place else text
    return f"{place}: {text}, got {problem['input']!r}"
