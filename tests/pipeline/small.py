"""A small configuration that the tests of the pipeline share."""

from pathlib import Path

from torchmeso.config import parse
from torchmeso.config_sections import Config

CONTENT = {
    "name": "small",
    "materials": {
        "brick": {
            "meso": {"type": "brick"},
            "btf": {"texels": 8, "lights": "grid(4, 2, 80)", "views": "grid(4, 2, 80)", "samples": 1, "bounces": 0},
            "mdf": {"texels": 16, "views": "grid(6, 3, 87.5)"},
            "eigen": {"rank": 2},
        },
        "clay": {"albedo": [0.5, 0.5, 0.5]},
        "unused": {"meso": {"type": "weave"}},
    },
    "objects": [
        {"shape": "torus", "options": {"triangles": 600}, "tiles": [4, 2], "material": "brick"},
        {"shape": "plane", "translate": [0, -0.6, 0], "material": "clay"},
    ],
    "lights": [{"type": "directional", "direction": [0.3, 1, 0.2]}],
    "camera": {"eye": [0, 2.2, 3.2], "width": 48, "height": 36},
    "render": {"shadow_map_size": 64},
    "truth": {"samples": 1, "bounces": 0, "max_edge": 0.5},
}


def small(**changes) -> Config:
    return parse({**CONTENT, **changes}, folder=Path())
