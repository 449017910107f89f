from dataclasses import fields

from torchmeso.bench import skips
from torchmeso.render.frame import Skips


def test_every_skip_is_measured():
    assert set(skips.COUNTERS) == {f.name for f in fields(Skips)}
