"""What a frame on the device is asked for, and what it writes into.

Kernels: kernels_cl/render/lights.clh, kernels_cl/render/stamp.clh          Test: tests/render/test_renderer.py
"""

from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from torchmeso.backends import opencl
from torchmeso.geometry.camera import Camera
from torchmeso.geometry.light import Light
from torchmeso.render import device
from torchmeso.render.device_raster import DeviceViews
from torchmeso.render.film import Picture

DETAILS, DISPLAY = 1, 2
"""What a frame writes: a `Picture`, or bytes for a screen."""

MOST_STARTS = 4
"""Tetrahedra of shells that the eye is in; the others of a shell that overlaps itself more often are left out."""

FRAME = np.dtype(
    [(name, "i4") for name in ("lights", "ambient_paper", "depths", "outputs")]
    + [(name, "i4") for name in ("capacity", "skips", "stride", "pitch")]
    + [("ambient", "f4"), ("background", "f4", 3), ("rank_error", "f4"), ("pixel", "f4")]
    + [
        ("starts", "i4"),
        ("distant_degree", "i4"),
        ("start_tet", "i4", MOST_STARTS),
        ("start_surface", "i4", MOST_STARTS),
    ]
    + [("start_place", "f4", (MOST_STARTS, 4))]
)


@dataclass(eq=False, kw_only=True)
class DevicePicture:
    """What a frame of one size writes into."""

    key: tuple
    views: DeviceViews
    results: "list[tuple[opencl.Buffer, Tensor]]"
    lights: opencl.Shared
    frame: opencl.Shared
    empty: opencl.Shared
    draw: opencl.Call = field(init=False)
    shown: Tensor
    rgba: Tensor
    depth: Tensor
    owner: Tensor
    shadowed: Tensor
    outputs: int = 0
    shone: tuple[Light, ...] | None = None
    lit: tuple[int, list[int]] = (0, [])

    @classmethod
    def make(cls, key: tuple, views: DeviceViews) -> "DevicePicture":
        """Return room for a picture of the width, height and number of lights that `key` begins with."""
        width, height, n_light, *_ = key
        rows, pitch = -(-height // 4) * 4, -(-width // 4) * 4
        rgba, depth = torch.zeros(rows, pitch, 4), torch.zeros(rows, pitch)
        owner = torch.zeros(rows, pitch, dtype=torch.int32)
        shadowed = torch.zeros(max(n_light, 1), rows, pitch, dtype=torch.uint8)
        shown = torch.zeros(rows, pitch, 4, dtype=torch.uint8)
        results = [(opencl.buffer(x), x) for x in (shown, rgba, depth, owner, shadowed)]
        lights = opencl.Shared(np.zeros(max(n_light, 1), device.LIGHT))
        frame, empty = opencl.Shared(np.zeros(1, FRAME)), opencl.Shared(np.zeros(rows * pitch // 16, np.uint8))
        return cls(
            key=key, views=views, results=results, lights=lights, frame=frame, empty=empty,
            shown=shown, rgba=rgba, depth=depth, owner=owner, shadowed=shadowed,
        )  # fmt: skip

    def finished(
        self, camera: Camera, object_of: list[int], counts: dict[str, int], seconds: dict[str, float]
    ) -> Picture:
        """Return the frame just drawn; kernels count surfaces, `object_of` says whose they are."""
        height, width = camera.height, camera.width
        count, reaching = self.lit
        shadowed = torch.zeros(count, height, width, dtype=torch.bool)
        shadowed[reaching] = self.shadowed[: len(reaching), :height, :width].bool()
        return Picture(
            rgb=self.rgba[:height, :width, :3],
            depth=self.depth[:height, :width],
            owner=torch.tensor([*object_of, -2, -1])[self.owner[:height, :width].long()],
            shadowed=shadowed,
            counts=counts,
            seconds=seconds,
        )


def named(counts: dict[str, int], camera: Camera) -> dict[str, int]:
    """Return the counters under the names of `Picture.counts`."""
    return {
        "triangles drawn": counts["drawn"],
        "fragments": counts["fragments"],
        "layers": counts["deepest"],
        "pixels with a fragment": counts["covered"],
        "pixels": camera.width * camera.height,
        "intervals": counts["intervals"],
        "intervals passed by their length": counts["deep"],
        "intervals passed by the facets alone": counts["bounded"],
        "intervals carved": counts["carved"],
        "pixels inside an object": counts["inside"],
        "depth look-ups": counts["looked"],
        "stretches behind a resolved pixel": counts["hidden"],
        "triangles without a pixel": counts["degenerate"],
        "triangles behind the eye": counts["behind"],
        "stamps that stayed empty": counts["empty"],
        "groups of components spared": counts["spared"],
        "triangles beside the view": counts["beside"],
        "triangles turned away": counts["turned"],
        "losing fragments not shaded": counts["losers"],
        "shadow tests of what leans away": counts["averted"],
        "prisms passed": counts["prisms"],
        "tetrahedra passed": counts["tets"],
        "rays lost in a shell": counts["endless"],
        "prisms passed without a look-up": counts["carried"],
    }
