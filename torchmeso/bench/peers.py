"""Other programs for ratios taken in one run: llvmpipe (OpenGL on the CPU), Embree, Mitsuba, torch's own compiler.

Extra `peers`: moderngl and open3d; llvmpipe also needs the Debian packages libegl1 and libgl1-mesa-dri.

Test: tests/bench/test_peers.py
"""

import ctypes.util
import json
import os
import re
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
from torchmeso.bench.timing import Timing, time_together
from torchmeso.geometry import shapes
from torchmeso.geometry.camera import Camera

Rays = Float[np.ndarray, "n 3"]
Distances = Callable[[], np.ndarray]
Caster = Callable[[Rays, Rays], Distances]
"""Takes origins and directions, returns a call that casts these rays."""

MISSED = 1e30
"""Distances of rays that hit something are less."""

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
    """Camera rays, and shadow rays from where they hit, by Embree: through open3d on all cores, through embreex on one.

    Attributes:
        calls: by "open3d primary", "open3d primary + shadow", and so with embreex. Time of embreex counts as CPU time
            over cores, as if it used them all.
        missing: what is not installed of the two.
    """

    def __init__(
        self, vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"], camera: Camera, light: Float[Tensor, "3"]
    ):
        """Build both scenes and all rays; `light` is the direction towards it.

        Raises:
            PeerMissing: neither loads.
        """
        self.calls: dict[str, Callable[[], Any]] = {}
        missing = []
        for name, peer in (("open3d", _open3d_rays), ("embreex", _embreex_rays)):
            try:
                first_hit, occluded = peer(vertices, faces)
            except PeerMissing as error:
                missing.append(str(error))
                continue
            primary = _camera_rays(camera)
            t = first_hit(*primary)()
            hit = t < MISSED
            place = primary[0][hit] + t[hit, None] * primary[1][hit] + np.float32(1e-3) * light.numpy()
            toward = np.ascontiguousarray(np.broadcast_to(light.float().numpy(), place.shape))
            calls = first_hit(*primary), occluded(np.ascontiguousarray(place, np.float32), toward)
            self.calls[f"{name} primary"] = calls[0]
            self.calls[f"{name} primary + shadow"] = lambda calls=calls: [call() for call in calls]
        self.missing = "; ".join(missing)
        if not self.calls:
            raise PeerMissing(self.missing)

    def faster(self, timing: dict[str, Timing], rays: str) -> Timing:
        """Return the time of the faster of the two for "primary" or "primary + shadow" rays."""
        found = []
        if f"open3d {rays}" in timing:
            found.append(timing[f"open3d {rays}"])
        if f"embreex {rays}" in timing:
            t = timing[f"embreex {rays}"]
            found.append(t._replace(wall=t.cpu, low=t.low * t.cpu / t.wall, high=t.high * t.cpu / t.wall))
        return min(found, key=lambda t: t.wall)


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
        said = re.sub(r"/\S*/", "", reason[0].strip())  # of folders that only this machine has
        raise PeerMissing(f"torch.compile ended with status {run.returncode} ({said})")
    found = json.loads(run.stdout.splitlines()[-1])
    return found["ms"], found["compiling"]


def embree_first_hit(camera: Camera, vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]) -> Distances:
    """Return a call that casts all camera rays by open3d's RaycastingScene and finds first hits.

    Raises:
        PeerMissing: open3d does not load.
    """
    return _open3d_rays(vertices, faces)[0](*_camera_rays(camera))


def _camera_rays(camera: Camera) -> tuple[Rays, Rays]:
    origin, direction, _ = camera.rays(camera.pixel_centres().reshape(-1, 2))
    return np.ascontiguousarray(origin.float().numpy()), np.ascontiguousarray(direction.float().numpy())


def _open3d_rays(vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]) -> tuple[Caster, Caster]:
    """Return what makes calls of origins and directions: one for distances, one for whether anything is hit."""
    try:
        open3d: Any = import_module("open3d")
    except (ImportError, OSError) as error:
        raise PeerMissing(f"open3d ({error})") from error
    tensor = open3d.core.Tensor
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(tensor(vertices.float().numpy()), tensor(faces.numpy().astype(np.uint32)))

    def first_hit(origin: Rays, direction: Rays) -> Distances:
        rays = tensor(np.concatenate([origin, direction], 1))
        return lambda: scene.cast_rays(rays)["t_hit"].numpy()

    def occluded(origin: Rays, direction: Rays) -> Distances:
        rays = tensor(np.concatenate([origin, direction], 1))
        return lambda: scene.test_occlusions(rays).numpy()

    return first_hit, occluded


def _embreex_rays(vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]) -> tuple[Caster, Caster]:
    """Return the same by embreex, called directly, in Embree's fast mode."""
    try:
        scenes: Any = import_module("embreex.rtcore_scene")
        meshes: Any = import_module("embreex.mesh_construction")
    except (ImportError, OSError) as error:
        raise PeerMissing(f"embreex ({error})") from error
    scene = scenes.EmbreeScene(robust=False)
    arrays = np.ascontiguousarray(vertices.float().numpy()), np.ascontiguousarray(faces.int().numpy())
    mesh = meshes.TriangleMesh(scene, *arrays)

    def first_hit(origin: Rays, direction: Rays) -> Distances:
        return lambda mesh=mesh: scene.run(origin, direction, query="DISTANCE")  # 1e37 where nothing is hit

    def occluded(origin: Rays, direction: Rays) -> Distances:
        return lambda mesh=mesh: scene.run(origin, direction, query="OCCLUDED")

    return first_hit, occluded


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
