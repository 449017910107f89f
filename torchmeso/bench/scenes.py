"""The scenes that figures are measured on, by the names of wang2005mdf's figures and tables.

Test: tests/bench/test_scenes.py
"""

import torch

from torchmeso.geometry import shapes
from torchmeso.geometry.camera import Camera, look_at
from torchmeso.geometry.mesh import Mesh

TORUS_TILES = ((8, 3), (6, 2), (3, 1), (2, 1))
"""The four texture scales of Fig. 11."""


def view(eye: tuple[float, float, float], at: tuple[float, float, float] = (0.0, 0.0, 0.0), **options) -> Camera:
    """Return a camera of 800 x 600 pixels, y up, unless told otherwise."""
    place, axes = look_at(*(torch.tensor(x, dtype=torch.float64) for x in (eye, at, (0.0, 1.0, 0.0))))
    return Camera(eye=place, axes=axes, **{"width": 800, "height": 600, **options})


def knot_view() -> Camera:
    """Return a view of the knot that covers about half of the picture's height and width."""
    return view((0.3, -1.6, 4.2))


def silhouette_cases() -> dict[str, tuple[Mesh, Camera]]:
    """Return the meshes and views silhouettes are judged on: Fig. 10's cylinder, Fig. 11's four scales, a knot."""
    cases = {"cylinder": (shapes.cylinder(tiles=(8, 3), triangles=4096), view((0, 0.8, 5.5)))}
    for tiles in TORUS_TILES:
        cases[f"torus{tiles[0]}x{tiles[1]}"] = (shapes.torus(tiles=tiles, triangles=4276), view((0, 2.2, 3.2)))
    cases["knot20x2"] = (shapes.torus_knot(tiles=(20, 2)), knot_view())
    return cases
