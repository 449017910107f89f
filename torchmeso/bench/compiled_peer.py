"""A frame of the 12k knot by torch's own compiler, in a process of its own because its code may abort.

    python -m torchmeso.bench.compiled_peer REPETITIONS

Compiled is the arithmetic that takes most of the frame: the march along curved intervals and the reflection of the BTF.
Compiled whole, the frame takes more than ten minutes and then writes beyond an index (torch 2.13).
Prints {"ms": [...], "compiling": seconds}.

Test: tests/bench/test_peers.py
"""

import json
import logging
import sys
import time

import torch
import torch._dynamo

from torchmeso.backends.allocator import keep_freed_memory
from torchmeso.bench import frames
from torchmeso.render import btf_shade, curved_silhouette, frame
from torchmeso.render.frame import FrameOptions

HOT = (
    (curved_silhouette, ("_bend", "_depth", "_path", "_below_planes")),
    (btf_shade, ("_reflect",)),
)


def main(repetitions: int) -> None:
    """Compile, then time `repetitions` frames."""
    for name in ("torch._dynamo", "torch._inductor"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    torch._dynamo.config.suppress_errors = True
    keep_freed_memory()
    for module, names in HOT:
        for name in names:
            setattr(module, name, torch.compile(getattr(module, name), dynamic=True))
    timed = frames.knot()
    scene = frames.build(timed)
    camera = frames.camera_at(scene, timed, 0.28)
    options = FrameOptions(silhouette="curved", shadow_map_size=768)
    ms = []
    for _ in range(repetitions + 1):
        start = time.perf_counter()
        frame.render(scene, camera, options)
        ms.append(1e3 * (time.perf_counter() - start))
    print(json.dumps({"ms": ms[1:], "compiling": round(1e-3 * ms[0], 1)}))


if __name__ == "__main__":
    main(int(sys.argv[1]))
