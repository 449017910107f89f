import gc
import json

import pytest
import torch

from torchmeso.bench import suite
from torchmeso.bench.suite import Context, Measurement, Row
from torchmeso.errors import ConfigError


def row(**changes):
    return Row(**{"id": "a.b", "what": "one sentence", "value": 2.0, "unit": "x", "better": "higher", **changes})


def measurements():
    def first(context):
        yield row(id="first.a")
        yield row(id="first.b")

    def second(context):
        yield row(id="second.a", value=None, why="full run only" if context.quick else "no peer")

    return [Measurement("first", first), Measurement("second", second)]


@pytest.mark.parametrize(
    ("changes", "met"),
    [({}, None), ({"goal": 1}, True), ({"goal": 3}, False), ({"goal": 3, "better": "lower"}, True),
     ({"goal": 3, "value": None}, None)],
)  # fmt: skip
def test_goal(changes, met):
    assert row(**changes).met is met


def test_json_keeps_what_is_known():
    assert row(goal=3, n=5).to_json() == {
        "id": "a.b", "what": "one sentence", "value": 2.0, "unit": "x", "better": "higher", "goal": 3, "n": 5,
        "met": False,
    }  # fmt: skip
    nothing = row(value=None, why="no peer").to_json()
    assert (nothing["value"], nothing["met"], nothing["why"]) == (None, None, "no peer")


@pytest.mark.parametrize(
    ("only", "ids"),
    [((), ["first.a", "first.b", "second.a"]), (("first",), ["first.a", "first.b"]), (("first.b",), ["first.b"]),
     (("sec*",), ["second.a"])],
)  # fmt: skip
def test_only(only, ids):
    assert [r.id for r in suite.run(measurements(), Context(), only)] == ids


def test_context_reaches_the_measurement():
    said = []
    rows = suite.run(
        measurements(), Context(quick=True, report=lambda what, share: said.append((what, share))), ["second"]
    )
    assert rows[0].why == "full run only"
    assert said == [("bench second", 0), ("bench second", 1)]


def test_written_file_names_the_machine(tmp_path):
    content = suite.to_json("render", [row()], {"cpu": "a"})
    suite.write_json(tmp_path / "a.json", content)
    assert json.loads((tmp_path / "a.json").read_text()) == content
    assert list(tmp_path.iterdir()) == [tmp_path / "a.json"]


def test_device_has_probes():
    device = suite.describe_device()
    assert device["cores"] >= 1
    assert device["probe"]["gemm2048_ms"] > 0
    assert "llvmpipe_z_ms" in device["probe"]


@pytest.mark.errors
def test_unknown_rows():
    with pytest.raises(ConfigError, match="no row begins with 'frist'; did you mean 'first'"):
        suite.run(measurements(), Context(), ["frist"])


def test_every_row_tells_its_memory():
    """The peak of a row does not hold what rows before it took and gave back."""

    def rows(context):
        large = torch.ones(60_000_000)
        yield row(id="a.large")
        del large
        gc.collect()
        yield row(id="a.after")

    first, second = suite.run([Measurement("a", rows)], Context())
    assert first.peak_mb > 200
    assert second.peak_mb <= first.peak_mb
