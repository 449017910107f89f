"""The suite `light`: environments as lights, in the frequency domain and through transfer.

Test: tests/bench/test_light.py
"""

from torchmeso.bench import light_error, light_pick, light_speed
from torchmeso.bench.suite import Measurement

MEASUREMENTS = [
    Measurement("sampling", light_error.sampling),
    Measurement("flicker", light_error.flicker),
    Measurement("energy", light_error.energy),
    Measurement("bands", light_error.bands),
    Measurement("transfer", light_error.through_transfer),
    Measurement("pick", light_pick.methods),
    Measurement("frame", light_speed.frames_under_environments),
]
