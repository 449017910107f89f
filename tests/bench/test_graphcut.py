import sys

import pytest
import torch

from tests.reference import seam_graphcut as reference
from torchmeso.bench import graphcut
from torchmeso.bench.suite import Context
from torchmeso.synthesize.seam_graphcut import cut


def test_the_certificate_is_the_cost_edge_by_edge(rng):
    e, side = graphcut.overlap(7, 2), graphcut.strip(7)
    errors = graphcut.old_errors(e[0])
    found = cut(e, side, errors=errors)
    expected = reference.cost(e[0], side, errors, found.old[0])
    assert graphcut.certificate(e[0], side, errors, found) == expected == int(found.cost[0])


def test_arcs_join_each_texel_to_its_neighbours_and_its_terminal():
    e, side = torch.ones(3, 4, dtype=torch.int64), graphcut.strip(4)[:3]
    tails, heads, rooms = graphcut.arcs(e, side, torch.full_like(side, 5))
    assert len(tails) == len(heads) == len(rooms) == 2 * (3 * 3 + 2 * 4) + 3 * 4
    assert (tails == 12).sum() == 3 and (heads == 13).sum() == 9
    assert sorted(set(rooms.tolist())) == [2, 5, 2 * 12 + 60 + 1]


def test_rows_name_the_peer_that_is_missing(monkeypatch, device):
    monkeypatch.setitem(sys.modules, "ortools.graph.python.max_flow", None)
    rows = list(graphcut._rows("path", 12, False, 5, Context(quick=True)))
    assert rows[0].value == 0 and rows[0].met
    assert [row.value for row in rows[1:]] == [None] * 3 and "peers" in rows[1].why


@pytest.mark.slow
def test_rows_beside_ortools(device):
    pytest.importorskip("ortools")
    for row in graphcut._rows("flow", 24, True, 1, Context(quick=True)):
        assert row.value is not None and (row.id.endswith("ortools") or row.value == 0)
