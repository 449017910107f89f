from torchmeso.bench.timing import time_together


def test_calls_are_timed_in_turns():
    order = []
    timing = time_together({"a": lambda: order.append("a"), "b": lambda: order.append("b")}, n=3, warm=0)
    assert order == ["a", "b"] * 3
    assert timing["a"].low <= timing["a"].wall <= timing["a"].high
    assert timing["b"].n == 3
