from torchmeso.bench import speed
from torchmeso.bench.timing import Timing


def test_a_ratio_says_how_often_as_fast():
    timing = {"ours": Timing(2.0, 1.0, 4.0, 1.5, 9), "peer": Timing(8.0, 6.0, 12.0, 8.0, 9)}
    row = speed.ratio("a.b", "what", timing, "ours", "peer", 3.0)
    assert (row.value, row.spread, row.met, row.n) == (4.0, (1.5, 12.0), True, 9)
    missing = speed.ratio("a.b", "what", timing, "ours", "nobody", 3.0, "nobody is not installed")
    assert (missing.value, missing.met, missing.why) == (None, None, "nobody is not installed")
