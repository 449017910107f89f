"""Outlines against their closed forms: areas, circles, corners."""

import math

import pytest
import torch

from torchmeso.data.yarn_section import Ellipse, Hybrid, Lenticular, Polygon, Rectangle, Turned
from torchmeso.errors import FormatError

V = torch.arange(4096, dtype=torch.float64) / 4096


def area(points):
    a, b = points, points.roll(-1, 0)
    return float((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum()) / 2


def segment(sagitta, width):
    """Area of a segment of a circle."""
    r = (width**2 / 4 + sagitta**2) / (2 * sagitta)
    angle = 2 * math.acos((r - sagitta) / r)
    return r**2 / 2 * (angle - math.sin(angle))


@pytest.mark.parametrize(
    ("section", "expected"),
    [
        (Ellipse(width=3, height=2), math.pi * 1.5),
        (Ellipse(width=3, height=2, power=3), 3 * 2 * math.gamma(2.5) / math.gamma(3) * math.sqrt(math.pi) / 2),
        (Ellipse(width=3, height=2, power=0), 6.0),
        (Rectangle(width=3, height=2), 6.0),
        (Lenticular(width=3, height=2), 2 * segment(1.0, 3)),
        (Lenticular(width=3, height=2, distortion=-0.3), segment(1.3, 3) + segment(0.7, 3)),
        (Lenticular(width=1, height=4), 2 * segment(2.0, 1)),  # more than half a circle
        (Polygon(points=torch.tensor([[0.0, 0.0], [2.0, 0.0], [2.0, 3.0]])), 3.0),
        (Turned(section=Rectangle(width=3, height=2), angle=0.4, scale=(2.0, 0.5)), 6.0),
    ],
)
def test_areas(section, expected):
    assert area(section.outline(V)) == pytest.approx(expected, rel=2e-3)


def test_starts_to_the_right_and_turns_upwards():
    quarters = torch.tensor([0.0, 0.25, 0.5, 0.75], dtype=torch.float64)
    wanted = torch.tensor([[1.5, 0], [0, 1], [-1.5, 0], [0, -1]], dtype=torch.float64)
    for section in (Ellipse(width=3, height=2), Rectangle(width=3, height=2), Lenticular(width=3, height=2)):
        torch.testing.assert_close(section.outline(quarters), wanted, rtol=0, atol=1e-12)
    turned = Turned(section=Ellipse(width=3, height=2), angle=math.pi / 2).outline(quarters)
    torch.testing.assert_close(turned[0], torch.tensor([0.0, 1.5], dtype=torch.float64), rtol=0, atol=1e-12)


def test_corners_of_a_rectangle_are_met_by_multiples_of_eight():
    points = Rectangle(width=3, height=2).outline(torch.arange(24, dtype=torch.float64) / 24)
    for x in (-1.5, 1.5):
        for y in (-1.0, 1.0):
            assert (points - torch.tensor([x, y], dtype=torch.float64)).norm(dim=-1).min() < 1e-12


def test_lenticular_arcs_are_circles():
    points = Lenticular(width=3, height=2, distortion=0.4).outline(V)
    for half, sign in ((points[:2048], 1), (points[2048:], -1)):
        sagitta = 1 - sign * 0.4
        r = (1.5**2 + sagitta**2) / (2 * sagitta)
        middle = torch.tensor([0.0, sign * (1 - r)], dtype=torch.float64)
        torch.testing.assert_close((half - middle).norm(dim=-1), torch.full((2048,), r).double(), rtol=1e-6, atol=0)
        assert float((half[:, 1] * sign).max()) == pytest.approx(1, abs=1e-6)


def test_hybrid_takes_each_piece_from_its_section():
    big, small = Ellipse(width=2, height=2), Ellipse(width=1, height=1)
    found = Hybrid(ends=(0.5, 0.75), sections=(big, small)).outline(V).norm(dim=-1)
    inner = (V >= 0.5) & (V < 0.75)
    torch.testing.assert_close(found, torch.where(inner, 0.5, 1.0).double(), rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: Ellipse(width=0, height=1), "ellipse: expected a width above 0"),
        (lambda: Ellipse(width=1, height=math.nan), "ellipse: expected a height above 0"),
        (lambda: Ellipse(width=1, height=1, power=-1), "expected a power from 0 to 64"),
        (lambda: Rectangle(width=1e9, height=1), "rectangle: expected a width"),
        (lambda: Lenticular(width=1, height=1, distortion=0.5), "expected a distortion of less than half its height 1"),
        (lambda: Polygon(points=torch.zeros(2, 2)), "at least 3 corners within 1e.06, got 2"),
        (lambda: Polygon(points=torch.zeros(0, 2)), "at least 3 corners within 1e.06, got 0"),
        (lambda: Hybrid(ends=(0.5, 0.2), sections=(Rectangle(width=1, height=1),) * 2), "one rising division"),
        (lambda: Turned(section=Rectangle(width=1, height=1), scale=(0.0, 1.0)), "expected factors above 0, got 0, 1"),
    ],
)
@pytest.mark.errors
def test_impossible_sections_are_refused(make, text):
    with pytest.raises(FormatError, match=text):
        make()
