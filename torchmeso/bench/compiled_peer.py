"""A frame of the 12k knot by torch's own compiler, in a process of its own because its code may abort.

    python -m torchmeso.bench.compiled_peer REPETITIONS

What the compiler fails on runs eagerly. Prints {"ms": [...], "compiling": seconds}.

Test: tests/bench/test_peers.py
"""

import json
import logging
import sys
import time

import torch
import torch._dynamo

from torchmeso.bench import frames
from torchmeso.render import frame
from torchmeso.render.frame import FrameOptions


def main(repetitions: int) -> None:
    """Compile, then time `repetitions` frames."""
    for name in ("torch._dynamo", "torch._inductor"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    torch._dynamo.config.suppress_errors = True
    timed = frames.knot()
    scene = frames.build(timed)
    camera = frames.camera_at(scene, timed, 0.28)
    options = FrameOptions(silhouette="curved", shadow_map_size=768)
    render = torch.compile(frame.render, dynamic=True)
    ms = []
    for _ in range(repetitions + 1):
        start = time.perf_counter()
        render(scene, camera, options)
        ms.append(1e3 * (time.perf_counter() - start))
    print(json.dumps({"ms": ms[1:], "compiling": round(1e-3 * ms[0], 1)}))


if __name__ == "__main__":
    main(int(sys.argv[1]))
