"""Other programs on the same triangles, for ratios taken in one run: llvmpipe (OpenGL on the CPU), Embree, Mitsuba.

And torch's own compiler.

Extra `peers`: moderngl and open3d; llvmpipe also needs the Debian packages libegl1 and libgl1-mesa-dri.

Test: tests/bench/test_peers.py
"""

import ctypes.util
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from functools import lru_cache
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from torch import Tensor

from torchmeso.bench.scenes import knot_view
from torchmeso.bench.timing import time_together
from torchmeso.geometry import shapes
from torchmeso.geometry.camera import Camera

FAR = 1e3
"""Far plane of the peers in units of the near plane they are given."""

VERTEX = "#version 330\nuniform mat4 M; in vec3 p; void main() { gl_Position = M * vec4(p, 1); }"
PLAIN = "#version 330\nout vec4 o; void main() { o = vec4(gl_FragCoord.z); }"
PEEL = """#version 330
uniform sampler2D nearer; out vec4 o;
void main() {
  if (gl_FragCoord.z <= texelFetch(nearer, ivec2(gl_FragCoord.xy), 0).r + 1e-7) discard;
  o = vec4(gl_FragCoord.z);
}"""


class Llvmpipe:
    """Depth peeling by OpenGL on llvmpipe: one z pass per layer, each against the depth of the last."""

    def __init__(self, camera: Camera, vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]):
        """Upload the triangles.

        Raises:
            PeerMissing: there is no moderngl, or no software OpenGL.
        """
        self._gl = _context()
        size = (camera.width, camera.height)
        gl = self._gl
        buffer = gl.buffer(np.ascontiguousarray(vertices.float().numpy()).tobytes())
        index = gl.buffer(np.ascontiguousarray(faces.int().numpy()).tobytes())
        matrix = _clip_matrix(camera).T.astype("f4").tobytes()
        self._passes = []
        for fragment in (PLAIN, PEEL):
            program = gl.program(vertex_shader=VERTEX, fragment_shader=fragment)
            program["M"].write(matrix)
            self._passes.append(gl.vertex_array(program, [(buffer, "3f", "p")], index))
        self._depth = [gl.depth_texture(size) for _ in range(2)]
        for texture in self._depth:
            texture.compare_func = ""
            texture.filter = (9728, 9728)  # GL_NEAREST
        self._target = [gl.framebuffer([gl.texture(size, 4)], depth) for depth in self._depth]
        gl.enable(gl.DEPTH_TEST)
        self._size = size

    def peel(self, layers: int) -> None:
        """Draw the first `layers` layers; no read-back."""
        for k in range(layers):
            self._target[k % 2].use()
            self._target[k % 2].clear(depth=1.0)
            if k:
                self._depth[(k + 1) % 2].use(0)
            self._passes[min(k, 1)].render()
        self._gl.finish()

    def coverage(self) -> float:
        """Return the share of pixels the first layer covers."""
        self.peel(1)
        depth = np.frombuffer(self._depth[0].read(), "f4")
        return float((depth < 1).mean())


class PeerMissing(Exception):
    """A peer is not installed; the text says what is missing."""


class Embree:
    """Camera rays, and shadow rays from where they hit, by open3d's RaycastingScene on both cores."""

    def __init__(
        self, vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"], camera: Camera, light: Float[Tensor, "3"]
    ):
        """Build the scene and all rays; `light` is the direction towards it.

        Raises:
            PeerMissing: open3d does not load.
        """
        self.primary = embree_first_hit(camera, vertices, faces)
        open3d: Any = import_module("open3d")
        tensor = open3d.core.Tensor
        self._scene = open3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(tensor(vertices.float().numpy()), tensor(faces.numpy().astype(np.uint32)))
        t = self.primary()["t_hit"].numpy()
        origin, direction, _ = camera.rays(camera.pixel_centres().reshape(-1, 2))
        hit = np.isfinite(t)
        place = origin.numpy()[hit] + t[hit, None] * direction.numpy()[hit] + 1e-3 * light.numpy()
        self._shadow = tensor(np.concatenate([place, np.broadcast_to(light.numpy(), place.shape)], 1).astype("f4"))

    def both(self) -> None:
        """Cast the camera rays, then the shadow rays."""
        self.primary()
        self._scene.test_occlusions(self._shadow)


def mitsuba(
    vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"], camera: Camera, light: Float[Tensor, "3"], *, n: int
) -> list[float]:
    """Return the milliseconds of `n` pictures by Mitsuba's llvm variant, in a process of its own.

    Raises:
        PeerMissing: Mitsuba or its LLVM is missing; the text says which.
    """
    with tempfile.TemporaryDirectory() as folder:
        np.savez(
            Path(folder) / "mesh.npz", vertices=vertices.numpy(), faces=faces.numpy(), eye=camera.eye.numpy(),
            axes=camera.axes.numpy(), fov_deg=camera.fov_deg, direction=light.numpy(), width=camera.width,
            height=camera.height, n=n,
        )  # fmt: skip
        command = [sys.executable, "-m", "torchmeso.bench.mitsuba_peer", folder]
        llvm = ctypes.util.find_library("LLVM-19")  # older ones do not know this processor's instructions
        environment = os.environ | ({"DRJIT_LIBLLVM_PATH": llvm} if llvm else {})
        run = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    if run.returncode:
        reason = run.stderr.strip().splitlines()[-1:] or ["no word"]
        raise PeerMissing(f"Mitsuba ({reason[0]}); pip install 'torchmeso[mitsuba]' and the package libllvm19")
    return json.loads(run.stdout.splitlines()[-1])["ms"]


def compiled_torch(*, n: int) -> tuple[list[float], float]:
    """Return the milliseconds of `n` frames of the 12k knot through torch.compile, and the seconds that compiling took.

    Raises:
        PeerMissing: there is no C++ compiler, or what it made does not run.
    """
    if shutil.which("c++") is None and shutil.which("g++") is None:
        raise PeerMissing("torch.compile: no C++ compiler; install g++")
    command = [sys.executable, "-m", "torchmeso.bench.compiled_peer", str(n)]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    if run.returncode:
        reason = run.stderr.strip().splitlines()[-1:] or ["no word"]
        raise PeerMissing(f"torch.compile ended with status {run.returncode} ({reason[0].strip()})")
    found = json.loads(run.stdout.splitlines()[-1])
    return found["ms"], found["compiling"]


def embree_first_hit(camera: Camera, vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]) -> Callable[[], Any]:
    """Return a call that casts all camera rays by open3d's RaycastingScene and finds first hits.

    Raises:
        PeerMissing: open3d does not load.
    """
    try:
        open3d: Any = import_module("open3d")
    except (ImportError, OSError) as error:
        raise PeerMissing(f"open3d ({error})") from error
    tensor = open3d.core.Tensor
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(tensor(vertices.float().numpy()), tensor(faces.numpy().astype(np.uint32)))
    origin, direction, _ = camera.rays(camera.pixel_centres().reshape(-1, 2))
    rays = tensor(np.concatenate([origin.numpy(), direction.numpy()], 1))
    return lambda: scene.cast_rays(rays)


def llvmpipe_probe() -> float | None:
    """Return the milliseconds of a z pass over the 12k knot at 800 x 600: how fast the machine is right now."""
    knot = shapes.torus_knot()
    try:
        peer = Llvmpipe(knot_view(), knot.vertices, knot.faces)
    except PeerMissing:
        return None
    return round(time_together({"z": lambda: peer.peel(1)}, n=9)["z"].wall, 2)


@lru_cache(maxsize=1)
def _context() -> Any:
    os.environ.setdefault("LP_NUM_THREADS", str(os.cpu_count()))
    os.environ.setdefault("LIBGL_ALWAYS_SOFTWARE", "1")
    try:
        moderngl: Any = import_module("moderngl")
        context = moderngl.create_context(standalone=True, backend="egl")
    except Exception as error:  # moderngl raises bare exceptions where EGL is missing
        raise PeerMissing(f"llvmpipe ({error}); run tools/setup --peers") from error
    if "llvmpipe" not in context.info["GL_RENDERER"]:
        raise PeerMissing(f"llvmpipe (OpenGL runs on {context.info['GL_RENDERER']})")
    return context


def _clip_matrix(camera: Camera) -> np.ndarray:
    """Return the 4 x 4 matrix from world to clip space, row 0 of the picture at the bottom."""
    axes, eye = camera.axes.double().numpy(), camera.eye.double().numpy()
    view = np.eye(4)
    view[:3, :3], view[:3, 3] = axes, -axes @ eye
    scale = 2 / camera.pixel_size
    near = max(camera.near, 0.1)
    far = near * FAR
    project = np.zeros((4, 4))
    project[0, 0], project[1, 1] = scale / camera.width, scale / camera.height
    project[2, 2], project[2, 3] = -(far + near) / (far - near), -2 * far * near / (far - near)
    project[3, 2] = -1
    return project @ view
