"""Whatever is damaged, only our own errors leave; hypothesis draws, and finds the smallest damage that breaks that."""

import warnings
from random import Random
from types import SimpleNamespace

import pytest
import torch
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from torchmeso import config
from torchmeso.bench import fuzz
from torchmeso.bench.suite import Context
from torchmeso.errors import MesoError


@pytest.fixture(scope="module", params=fuzz.KINDS, ids=lambda kind: kind.name)
def case(request, tmp_path_factory):
    return request.param.prepare(tmp_path_factory.mktemp(request.param.name))


@settings(
    max_examples=100, deadline=None, derandomize=True, database=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow, HealthCheck.data_too_large],
)  # fmt: skip
@given(random=st.randoms(use_true_random=False))
def test_only_our_errors_leave_the_readers(random, case):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            case(random)
        except MesoError:
            return


@pytest.mark.parametrize("kind", fuzz.KINDS, ids=lambda kind: kind.name)
def test_seeded_cases(kind):
    assert fuzz.strangers(kind, 25, seed=10**9) == []


def test_strangers_are_reported(tmp_path):
    def prepare(folder):
        def case(random):
            if random.random() < 0.5:
                raise KeyError("a bug")
            raise MesoError("ours")

        return case

    found = fuzz.strangers(fuzz.Kind("toy", 1.0, prepare), 20)
    assert 0 < len(found) < 20
    assert found[0].endswith("KeyError: 'a bug'")


def test_a_case_is_known_by_its_seed():
    tree = {"a": [1, {"b": 2}], "c": "d"}
    assert fuzz.damaged_tree(tree, Random(3)) == fuzz.damaged_tree(tree, Random(3))
    assert fuzz.damaged_bytes(b"abc" * 20, Random(3)) == fuzz.damaged_bytes(b"abc" * 20, Random(3))
    assert tree == {"a": [1, {"b": 2}], "c": "d"}


@pytest.mark.slow
def test_a_hundred_thousand_cases():
    rows = list(fuzz.fuzz(Context()))
    assert sum(row.n for row in rows) == fuzz.CASES
    assert [row.to_json() for row in rows if not row.met] == []


@pytest.mark.errors
def test_pictures_without_values_are_a_strangers(monkeypatch, tmp_path):
    monkeypatch.setattr(fuzz.frame, "render", lambda *_: SimpleNamespace(rgb=torch.full((2, 2, 3), torch.nan)))
    with pytest.raises(ArithmeticError, match="not finite"):
        fuzz._draw(config.parse(yaml.safe_load(fuzz.SHELLED), folder=tmp_path))
