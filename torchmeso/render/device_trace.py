"""Lists of rays through a shell on OpenCL: `gdm_trace.trace`, sixteen rays at once and in float32.

Frames walk in kernels of their own; this is for rays that are not those of a picture.

Kernels: kernels_cl/render/gdm_trace.cl          Test: tests/render/test_device_trace.py
"""

import numpy as np
import torch

from torchmeso.backends import opencl
from torchmeso.data.gdm import Gdm
from torchmeso.geometry.mesh import Mesh
from torchmeso.geometry.shell import Shell
from torchmeso.render.device_gdm import Dressing, upload_gdms
from torchmeso.render.device_shell import upload_shells
from torchmeso.render.gdm_trace import Entries, Traced

RAY = np.dtype([("origin", "f4", 3), ("direction", "f4", 3), ("entry", "i4"), ("pad", "i4")])
ANSWER = np.dtype(
    [("t", "f4"), ("place", "f4", 3), ("way", "f4", 3), ("prism", "i4")]
    + [(name, "i4") for name in ("hit", "through", "prisms")]
    + [("pad", "i4", 5)]
)


class DeviceTrace:
    """A shell and its material on the device.

    Attributes:
        milliseconds: that the kernel took for the last rays.
        passed: prisms and tetrahedra that they passed, and those prisms that took no look-up.
    """

    def __init__(
        self, shell: Shell, mesh: Mesh, gdm: Gdm | None, *, queries: int = 1, floor: bool = True, bend: float = 0.0
    ):
        """Upload them; `gdm` None: rays walk through to the end.

        Raises:
            BackendError: there is no device, or the shell has too many prisms.
        """
        self._shells = upload_shells([(shell, mesh, 0)])
        h = float(-shell.uvz[..., 2].min())
        self._gdms = upload_gdms([Dressing(gdm, h, queries, floor, bend=bend)])
        self.milliseconds, self.passed = 0.0, (0, 0, 0)

    def trace(self, entries: Entries) -> Traced:
        """Return what rays meet, as `gdm_trace.trace`; rays that do not end have `prisms` -1."""
        n = len(entries.tet)
        rays = np.zeros(n, RAY)
        rays["origin"], rays["direction"] = entries.origin.numpy(), entries.direction.numpy()
        rays["entry"] = (4 * entries.tet + entries.corner).numpy()
        answers, counted = opencl.allocate(ANSWER.itemsize * n), opencl.upload(np.zeros(16, np.int32))
        call = opencl.Call(
            "render/gdm_trace.cl", "trace", (max(-(-n // 16), 1),), (1,),
            (opencl.upload(rays), *self._shells, self._gdms.tables, self._gdms.gdms, np.int32(n), answers, counted),
        )  # fmt: skip
        call()
        found = opencl.fetch(answers, np.zeros(n, ANSWER))
        self.milliseconds = call.milliseconds
        self.passed = tuple(opencl.fetch(counted, np.zeros(16, np.int32))[:3].tolist())
        columns = {name: torch.from_numpy(np.ascontiguousarray(found[name])) for name in found.dtype.names or ()}
        return Traced(
            hit=columns["hit"] != 0,
            t=columns["t"].double(),
            place=columns["place"].double(),
            direction=columns["way"].double(),
            prism=columns["prism"].long(),
            through=columns["through"].long(),
            prisms=columns["prisms"].long(),
        )
