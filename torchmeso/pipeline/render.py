"""Render a configuration: materials from the cache or baked, one frame.

Test: tests/pipeline/test_render.py
"""

from dataclasses import dataclass

from torchmeso.config import Config
from torchmeso.pipeline import scene as scenes
from torchmeso.pipeline.bake import Asset, Report, prepare, silent
from torchmeso.render import frame
from torchmeso.render.film import Picture
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


def render(config: Config, report: Report = silent) -> Rendering:
    """Return the picture of `config`.

    Raises:
        MesoError: a file is missing or unreadable, or an option is out of range.
    """
    camera = config.camera.build()
    assets = prepare(config, report)
    scene = scenes.build(config, assets)
    report("render", 0)
    picture = frame.render(scene, camera, config.render)
    report("render", 1)
    return Rendering(picture=picture, scene=scene, assets=assets)
