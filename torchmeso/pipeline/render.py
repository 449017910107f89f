"""Render a configuration: materials from the cache or baked, one frame on the backend that is there.

Test: tests/pipeline/test_render.py
"""

import warnings
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import UInt8

from torchmeso.backends import BackendChoice, opencl
from torchmeso.config_sections import Config
from torchmeso.data import image
from torchmeso.errors import BackendError
from torchmeso.geometry.camera import Camera
from torchmeso.geometry.light import Light
from torchmeso.pipeline import environment
from torchmeso.pipeline import scene as scenes
from torchmeso.pipeline.bake import Asset, Report, prepare, silent
from torchmeso.render import frame
from torchmeso.render.film import Picture
from torchmeso.render.frame import FrameOptions
from torchmeso.render.renderer import Renderer
from torchmeso.render.scene import Scene


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Rendering:
    """A picture and what it was made from.

    Attributes:
        picture: the frame.
        scene: meshes, materials and lights.
        assets: the materials with times and sizes.
    """

    picture: Picture
    scene: Scene
    assets: dict[str, Asset]


class Painter:
    """Paints one scene, frame after frame, on the backend that was asked for."""

    def __init__(self, scene: Scene, options: FrameOptions, backend: BackendChoice):
        """Get ready; `auto` is opencl, or torch with a warning where there is no device or a material it cannot read.

        Raises:
            BackendError: opencl was asked for and cannot be had.
        """
        self._scene, self._options = scene, options
        self._renderer: Renderer | None = None
        if opencl.resolve(backend) == "torch":
            return
        try:
            self._renderer = Renderer(scene, options)
        except BackendError as error:
            if backend != "auto":
                raise
            warnings.warn(f"{error}; rendering on torch", stacklevel=2)

    def change(self, scene: Scene) -> None:
        """Paint `scene` from now on; what is the same as before stays ready."""
        self._scene = scene
        if self._renderer is not None:
            self._renderer.update(scene)

    def paint(self, camera: Camera, lights: tuple[Light, ...] | None = None) -> Picture:
        """Return the picture seen by `camera`; the next one may be written into the same memory."""
        if self._renderer is not None:
            return self._renderer.render(camera, lights)
        scene = self._scene if lights is None else replace(self._scene, lights=lights)
        return frame.render(scene, camera, self._options)

    def show(self, camera: Camera, lights: tuple[Light, ...] | None = None) -> UInt8[np.ndarray, "H W 3"]:
        """Return what a screen shows of that picture, in sRGB bytes."""
        if self._renderer is not None:
            return self._renderer.show(camera, lights)[..., :3].numpy()
        return image.to_bytes(self.paint(camera, lights).rgb)


def render(config: Config, report: Report = silent) -> Rendering:
    """Return the picture of `config`.

    Raises:
        MesoError: a file is missing or unreadable, or an option is out of range.
    """
    camera = config.camera.build()
    assets = prepare(config, report)
    scene = environment.prepare(config, scenes.build(config, assets), report)(0.0)
    report("render", 0)
    picture = Painter(scene, config.render, config.backend).paint(camera)
    report("render", 1)
    return Rendering(picture=picture, scene=scene, assets=assets)
