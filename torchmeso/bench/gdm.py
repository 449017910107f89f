"""The suite `gdm`: generalised displacement maps, run time against error.

Test: tests/bench/test_gdm.py
"""

from torchmeso.bench import (
    gdm_bake,
    gdm_distortion,
    gdm_error,
    gdm_finest,
    gdm_identity,
    gdm_speed,
    gdm_tables,
    gdm_vdm,
)
from torchmeso.bench.suite import Measurement

MEASUREMENTS = [
    Measurement("bake", gdm_bake.bake),
    Measurement("embree", gdm_speed.against_embree),
    Measurement("fig7", gdm_speed.figure_7),
    Measurement("backends", gdm_speed.backends),
    Measurement("walk", gdm_speed.walk),
    Measurement("leaks", gdm_speed.leaks),
    Measurement("slices", gdm_speed.slices),
    Measurement("distance", gdm_error.distance),
    Measurement("refined", gdm_error.refined),
    Measurement("silhouette", gdm_error.silhouette),
    Measurement("finest", gdm_finest.finest),
    Measurement("tables", gdm_tables.tables),
    Measurement("distortion", gdm_distortion.distortion),
    Measurement("vdm", gdm_vdm.beside),
    Measurement("identity", gdm_identity.identity),
    Measurement("outline", gdm_identity.outlines),
    Measurement("pace", gdm_identity.pace),
]
