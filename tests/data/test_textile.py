"""Paths and rings against straight lines, sines and circles."""

import math

import pytest
import torch

from torchmeso.data.textile import Textile, Yarn
from torchmeso.data.yarn_section import Ellipse
from torchmeso.errors import FormatError, ShapeError

ROUND = Ellipse(width=0.2, height=0.1)


def make(nodes, *, up=(0.0, 0.0, 1.0), **more):
    nodes = torch.tensor(nodes, dtype=torch.float64)
    parts = {"tangents": torch.zeros_like(nodes), "ups": torch.tensor([up] * len(nodes)).double(), "sections": (ROUND,)}
    return Yarn(nodes=nodes, repeats=torch.zeros(0, 3), **{**parts, **more})


@pytest.mark.parametrize("path", ["linear", "cubic", "bezier"])
@pytest.mark.parametrize("periodic", [False, True])
def test_a_straight_yarn_is_a_cylinder(path, periodic):
    rings = make([[0, 0, 0.3], [0.7, 0, 0.3], [2, 0, 0.3]], path=path, periodic=periodic).rings(0.1, 64)
    along, right, up = rings.unbind(-1)
    assert (along.diff(dim=0) > 0).all()
    torch.testing.assert_close(along, along[:, :1].expand_as(along), rtol=0, atol=1e-12)
    torch.testing.assert_close(
        (right / 0.1).square() + ((up - 0.3) / 0.05).square(), torch.ones_like(up), rtol=0, atol=1e-9
    )
    assert float(right[0, 0]) == pytest.approx(-0.1)  # to the right of who walks along +x is -y
    assert float(along.diff(dim=0).max()) <= 0.1 + 1e-9


def test_a_periodic_spline_through_a_sine_is_nearly_one():
    x = torch.arange(17).double() / 8
    nodes = torch.stack([x, torch.zeros(17).double(), (math.pi * x).sin()], -1)
    rings = make(nodes.tolist(), path="cubic").rings(0.02, 4)
    middle = rings.mean(1)
    assert ((math.pi * middle[:, 0]).sin() - middle[:, 2]).abs().max() < 0.01
    ends = rings[-1] - rings[0]
    torch.testing.assert_close(ends, torch.tensor([2.0, 0.0, 0.0]).double().expand(4, 3), rtol=0, atol=1e-9)


def test_a_natural_spline_is_straight_at_its_ends():
    middle = make([[0, 0, 0], [1, 0, 1], [2, 0, 0]], path="cubic", periodic=False).rings(0.01, 4).mean(1)
    bend = middle.diff(dim=0).diff(dim=0).norm(dim=-1)
    assert bend[0] < 0.02 * bend.max()
    assert bend[-1] < 0.02 * bend.max()


def test_bezier_goes_along_its_tangents_and_reaches_no_higher_than_its_nodes():
    nodes = [[0, 0, 0], [1, 0, 1], [2, 0, 1], [3, 0, 0]]
    ahead = torch.tensor([[1.0, 0, 0]] * 4).double()
    middle = make(nodes, path="bezier", tangents=ahead, periodic=False).rings(0.01, 4).mean(1)
    assert middle[:, 2].max() < 1 + 1e-9
    slope = middle[1] - middle[0]
    assert abs(slope[2] / slope[0]) < 0.05
    free = make(nodes, path="bezier", periodic=False).rings(0.01, 4).mean(1)
    slope = free[1] - free[0]
    assert float(slope[2] / slope[0]) == pytest.approx(1, abs=0.05)  # the chord to its only neighbour
    assert free[:, 2].max() > 1.02


def test_sections_stand_across_the_path_and_upright():
    rings = make([[0, 0, 0], [1, 1, 1], [2, 2, 2]], path="linear", periodic=False).rings(0.5, 8)
    way = torch.tensor([1.0, 1, 1]).double() / math.sqrt(3)
    assert ((rings - rings.mean(1, keepdim=True)) @ way).abs().max() < 1e-12
    top = rings[0, 2] - rings[0].mean(0)
    assert float(top.norm()) == pytest.approx(0.05)
    assert top[2] > 0


def test_sections_at_nodes_and_at_places_go_over_into_each_other():
    thin, thick = Ellipse(width=0.1, height=0.1), Ellipse(width=0.3, height=0.1)
    nodes = [[0, 0, 0], [1, 0, 0], [2, 0, 0]]
    at_nodes = make(nodes, path="linear", sections=(thin, thick, thin)).rings(0.25, 4)
    half = (at_nodes[:, 0, 1] - at_nodes[:, 2, 1]).abs() / 2
    torch.testing.assert_close(half, 0.05 + 0.1 * (1 - (at_nodes[:, 0, 0] - 1).abs()), rtol=0, atol=1e-12)
    slow = make(nodes, path="linear", sections=(thin, thick, thin), ramped=False).rings(0.25, 4)
    half = (slow[:, 0, 1] - slow[:, 2, 1]).abs() / 2
    share = 1 - (slow[:, 0, 0] - 1).abs()
    torch.testing.assert_close(half, 0.05 + 0.1 * share**2 * (3 - 2 * share), rtol=0, atol=1e-12)
    placed = make(nodes, path="linear", sections=(thin, thick), places=(0.25, 0.75)).rings(0.25, 4)
    half = (placed[:, 0, 1] - placed[:, 2, 1]).abs() / 2
    share = 1 - ((placed[:, 0, 0] / 2 - 0.75).abs() / 0.5)  # up to 0.75, then down over the end to 0.25
    torch.testing.assert_close(half, 0.05 + 0.1 * torch.where(share < 0, -share, share), rtol=0, atol=1e-9)


def test_corners_of_a_linear_path_are_mitred():
    rings = make([[0, 0, 0], [1, 0, 0], [1, 1, 0]], path="linear", periodic=False).rings(1, 4)
    corner = rings[(rings.mean(1) - torch.tensor([1.0, 0, 0]).double()).norm(dim=-1).argmin()]
    across = corner[0] - corner[2]
    assert float(across[0]) == pytest.approx(-float(across[1]), abs=1e-12)


@pytest.mark.parametrize(
    ("more", "text"),
    [
        ({"nodes": [[0, 0, 0]]}, "at least two nodes, no two in a row at one place, got 1"),
        ({"nodes": [[0, 0, 0], [1, 0, 0], [1, 0, 0]]}, "no two in a row at one place, got 3"),
        ({"nodes": [[0, 0, 0], [math.inf, 0, 0]]}, "finite nodes within 1e.06"),
        ({"up": (0.0, 0.0, math.nan)}, "finite ups within 1e.06"),
        ({"sections": (ROUND,) * 3}, r"1 section or one for each node \(2\), got 3"),
        ({"sections": ()}, "1 section or one for each node"),
        ({"sections": (ROUND,) * 3, "places": (0.0, 1.0)}, r"1 section or one for each place \(2\), got 3"),
        ({"sections": (ROUND,) * 2, "places": (0.5, 0.5)}, "rising places of sections from 0 to 1"),
        ({"sections": (ROUND,) * 2, "places": (0.5, 1.5)}, "rising places of sections from 0 to 1"),
    ],
)
@pytest.mark.errors
def test_impossible_yarns_are_refused(more, text):
    nodes = more.pop("nodes", [[0, 0, 0], [1, 0, 0]])
    with pytest.raises(FormatError, match=text):
        make(nodes, **more)


@pytest.mark.errors
def test_paths_without_a_frame_and_long_ones_are_refused():
    with pytest.raises(FormatError, match="expected an up across the path at every place"):
        make([[0, 0, 0], [0, 0, 1]], periodic=False).rings(0.1, 8)
    with pytest.raises(FormatError, match="at every place, got one along it, or a cusp"):
        make([[0, 0, 0], [1, 0, 0], [0, 0, 0]], path="linear", periodic=False).rings(0.1, 8)
    with pytest.raises(FormatError, match=r"expected at most 65536 rings, got 1e\+06"):
        make([[0, 0, 0], [1e3, 0, 0]]).rings(1e-3, 8)
    with pytest.raises(FormatError, match="textile: expected at least one yarn"):
        Textile(yarns=())
    with pytest.raises(FormatError, match="textile: expected a domain with two sides"):
        Textile(yarns=(make([[0, 0, 0], [1, 0, 0]]),), domain=torch.tensor([[0.0, 0.0], [0.0, 1.0]]))
    with pytest.raises(ShapeError, match=r"yarn\.ups"):
        make([[0, 0, 0], [1, 0, 0]], ups=torch.ones(3, 3))
