"""Mitsuba 3 on the displaced mesh, in a process of its own: `python -m torchmeso.bench.mitsuba_peer FOLDER`.

FOLDER holds mesh.npz (vertices, faces, eye, axes, fov_deg, direction, width, height, n). One sample per pixel, direct
light, a diffuse surface; prints the milliseconds of n pictures as JSON. Variant llvm_ad_rgb, which needs libLLVM.

Extra `mitsuba`.          Test: tests/bench/test_peers.py
"""

import json
import sys
import time
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np


def main(folder: str) -> None:
    """Print the times of the pictures of one mesh."""
    mi: Any = import_module("mitsuba")
    mi.set_variant("llvm_ad_rgb")
    about = np.load(Path(folder) / "mesh.npz")
    mesh = mi.Mesh("displaced", len(about["vertices"]), len(about["faces"]))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = about["vertices"].astype(np.float32).ravel()
    parameters["faces"] = about["faces"].astype(np.uint32).ravel()
    parameters.update()
    mesh.write_ply(str(Path(folder) / "mesh.ply"))
    right, up, back = about["axes"]
    to_world = np.eye(4)
    to_world[:3, :] = np.stack([-right, up, -back, about["eye"]], 1)  # Mitsuba's camera looks along +z, x to the left
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "direct", "emitter_samples": 1, "bsdf_samples": 0},
            "sensor": {
                "type": "perspective",
                "fov": float(about["fov_deg"]),
                "fov_axis": "y",
                "to_world": mi.ScalarTransform4f(to_world),
                "film": {"type": "hdrfilm", "width": int(about["width"]), "height": int(about["height"]),
                         "rfilter": {"type": "box"}},
                "sampler": {"type": "independent", "sample_count": 1},
            },
            "light": {"type": "directional", "direction": [-float(x) for x in about["direction"]]},
            "mesh": {"type": "ply", "filename": str(Path(folder) / "mesh.ply"), "face_normals": True,
                     "bsdf": {"type": "diffuse"}},
        }
    )  # fmt: skip
    times, picture = [], np.zeros((1, 1, 3))
    for seed in range(int(about["n"]) + 3):
        start = time.perf_counter()
        picture = np.array(mi.render(scene, spp=1, seed=seed))
        times.append(1e3 * (time.perf_counter() - start))
    print(json.dumps({"ms": times[3:], "coverage": float((picture.max(-1) > 0).mean())}))


if __name__ == "__main__":
    main(sys.argv[1])
