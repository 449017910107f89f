import pytest
import torch

from torchmeso.bench import extremes, stability
from torchmeso.bench.extremes import Case
from torchmeso.bench.suite import Context

FEW = (
    "view_89.9deg",
    "eye_inside_slab",
    "picture_1x1",
    "far_1e+07",
    "mesh_two_sided",
    "btf_one_direction",
    "mdf_no_hits",
)


@pytest.mark.parametrize("name", FEW)
def test_pictures_at_the_edge(name, device):
    (case,) = [c for c in extremes.cases(32) if c.name == name]
    rows = list(stability.judge(case))
    assert [r.id.rpartition(".")[2] for r in rows] == ["finite", "differ"]
    assert all(r.met for r in rows), [r.to_json() for r in rows if not r.met]


def test_rows_turn_red(device):
    """A failure that is none of our errors, a refusal, and a picture of something else."""
    scene, camera = extremes.grazing(45, 16)

    def fail():
        raise KeyError("bug")

    (row,) = stability.judge(Case(name="a", what="a bug", make=fail))
    assert row.met is False
    assert row.peer == "KeyError: 'bug'"
    other = stability.judge(
        Case(name="b", what="b", make=lambda: (scene, camera), truth=lambda: extremes.moved_to(0, 16))
    )
    assert [r.met for r in other] == [True, False]


def test_values_that_are_not_finite_are_found(device):
    picture = stability._draw("torch", *extremes.grazing(45, 16))
    picture.rgb[0, 0, 0] = torch.nan
    picture.depth[picture.owner >= 0] = torch.inf
    assert stability._not_finite(picture) == 1 + int((picture.owner >= 0).sum())


def test_the_fit_keeps_its_bound():
    rows = list(stability.condition(Context(quick=True)))
    assert len(rows) == 26
    assert all(r.met for r in rows)
    assert {r.curve["series"] for r in rows} == {"float32", "float64"}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*the texture is stretched")
@pytest.mark.parametrize("measurement", stability.MEASUREMENTS, ids=lambda m: m.name)
def test_every_row_is_green(measurement, device):
    """Pictures of 8192 x 8192 pixels among them: about 5 GB."""
    missed = [r.to_json() for r in measurement.run(Context()) if r.met is False]
    assert not missed
