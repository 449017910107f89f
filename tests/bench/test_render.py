"""The suite's own helpers are right; what it measures is judged by its rows, and speed never here."""

import pytest
import torch

from torchmeso.bench import render
from torchmeso.bench.suite import Context
from torchmeso.geometry.directions import from_angles
from torchmeso.meso import generators
from torchmeso.meso.bake_mdf import RayCastMdf


@pytest.mark.parametrize(
    ("tile", "closed_form"),
    [
        (generators.sheet(), render._sheet_depth),
        (generators.groove(), render._groove_depth),
        (generators.spheres(segments=256), render._spheres_depth),
    ],
    ids=["sheet", "groove", "spheres"],
)
def test_closed_forms_agree_with_rays(tile, closed_form, rng):
    theta = torch.rand(500, generator=rng) * 1.2
    wo = from_angles(theta, torch.rand(500, generator=rng) * 6.28)
    uv = torch.rand(500, 2, generator=rng)
    error = (closed_form(uv, wo) - RayCastMdf(tile).evaluate(uv, wo)).abs()
    assert error.quantile(0.99) < 2e-3


def test_sheet_rows_meet_their_goals():
    rows = list(render.sheet(Context()))
    assert [r.id for r in rows] == ["sheet.cylinder.none", "sheet.cylinder.paper", "sheet.cylinder.curved"]
    assert all(r.met for r in rows)


def test_measurements_have_names_of_their_own():
    names = [m.name for m in render.MEASUREMENTS]
    assert len(set(names)) == len(names)


def test_small_carves_are_judged_by_outlines():
    bare = torch.ones(30, 30, dtype=torch.bool)
    limit, table = bare.clone(), bare.clone()
    limit[:, :2] = False
    table[:, :3] = False
    row = render._table_row("paper", "brick", "knot", bare, limit, table)
    assert (row.unit, row.value) == ("px", 1.0)
    limit[:, :15] = False
    table[:, :15] = False
    assert render._table_row("paper", "brick", "knot", bare, limit, table).unit == "IoU"
