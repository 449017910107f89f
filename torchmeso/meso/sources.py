"""Where mesostructures come from, by name: the generators, and the readers of files.

Test: tests/meso/test_sources.py
"""

from collections.abc import Callable

from torchmeso.data import height_field
from torchmeso.meso import mesostructure, textile
from torchmeso.meso.generators import GENERATORS
from torchmeso.meso.mesostructure import Mesostructure, Rgb


def _from_pictures(
    *,
    displacement: str,
    albedo: str | None = None,
    h: float,
    texels: int = 256,
    roughness: float = 0.5,
    f0: float = 0.0,
    colour: Rgb | None = None,
) -> Mesostructure:
    """Height field from a displacement picture and a colour picture."""
    field = height_field.from_pictures(displacement, albedo, h=h, texels=texels)
    plain = colour or ((1.0, 1.0, 1.0) if albedo else (0.6, 0.6, 0.6))
    return mesostructure.from_height_field(field, albedo=plain, roughness=roughness, f0=f0)


def _from_scan(
    *,
    path: str,
    relief: float | None = None,
    texels: int = 256,
    blend: float = 0.1,
    colour: Rgb = (0.6, 0.6, 0.6),
    roughness: float = 0.5,
    f0: float = 0.0,
) -> Mesostructure:
    """Height field from a GelSight .tmd scan."""
    field = height_field.from_tmd(path, relief=relief, texels=texels, blend=blend)
    return mesostructure.from_height_field(field, albedo=colour, roughness=roughness, f0=f0)


def _from_mesh(
    *, path: str, h: float | None = None, colour: Rgb = (0.6, 0.6, 0.6), roughness: float = 0.5, f0: float = 0.0
) -> Mesostructure:
    """Any triangle tile that trimesh reads."""
    return mesostructure.from_file(path, h=h, albedo=colour, roughness=roughness, f0=f0)


SOURCES: dict[str, Callable[..., Mesostructure]] = {
    **GENERATORS,
    "pictures": _from_pictures,
    "scan": _from_scan,
    "mesh": _from_mesh,
    "textile": textile.from_tg3,
}
"""What `meso.type` may be: the generators, and the readers of files."""

SUFFIXES = {".tg3": "textile", ".tmd": "scan", ".obj": "mesh", ".ply": "mesh", ".stl": "mesh", ".off": "mesh"}
"""The reader of a file that is named alone."""
