import pytest
import torch

from torchmeso.data import weave_pattern
from torchmeso.data.weave_pattern import WeavePattern
from torchmeso.errors import FormatError, ShapeError


def pattern(over, **more):
    over = torch.tensor(over).bool()
    sizes = {"x_yarns": torch.tensor([[0.8, 0.1, 1.0]] * len(over)), "thickness": 0.3}
    sizes["y_yarns"] = torch.tensor([[0.5, 0.05, 2.0]] * over.shape[1] if over.ndim == 2 else [[1.0] * 3])
    return WeavePattern(x_over=over, **{**sizes, **more})


def test_yarns_lie_in_the_middle_of_their_lanes_over_and_under():
    found = weave_pattern.yarns(pattern([[1, 0, 0], [0, 1, 1]]))
    assert found.domain.tolist() == [[0, 0], [6, 2]]
    first = found.yarns[0].nodes
    torch.testing.assert_close(first[:, 0], torch.tensor([1.0, 3, 5, 7]).double())
    torch.testing.assert_close(first[:, 1], torch.full((4,), 0.5).double())
    torch.testing.assert_close(first[:, 2], torch.tensor([0.1, -0.1, -0.1, 0.1]).double())  # 0.15 - 0.05
    across = found.yarns[2].nodes
    torch.testing.assert_close(across[:, 1], torch.tensor([0.5, 1.5, 2.5]).double())
    torch.testing.assert_close(across[:, 0], torch.ones(3).double())
    torch.testing.assert_close(across[:, 2], torch.tensor([-0.125, 0.125, -0.125]).double())
    assert len(found.yarns) == 5
    assert found.yarns[0].sections[0].width == pytest.approx(0.8)
    assert found.yarns[2].sections[0].height == pytest.approx(0.05)


def test_yarns_fill_the_thickness_and_no_more():
    found = weave_pattern.yarns(pattern([[1, 0, 0], [0, 1, 1]]))
    z = torch.cat([yarn.rings(0.05, 32)[..., 2].flatten() for yarn in found.yarns])
    assert float(z.max()) == pytest.approx(0.15, abs=1e-6)
    assert float(z.min()) == pytest.approx(-0.15, abs=1e-6)


@pytest.mark.parametrize(
    ("over", "more", "text"),
    [
        ([[]], {"y_yarns": torch.zeros(0, 3)}, "expected yarns in both directions"),
        ([[1]], {"x_yarns": torch.tensor([[1.2, 0.1, 1.0]])}, "of x yarns above 0 .* no yarn wider than its spacing"),
        ([[1]], {"y_yarns": torch.tensor([[1.0, 0.0, 1.0]])}, "of y yarns above 0"),
        ([[1]], {"y_yarns": torch.tensor([[1.0, torch.nan, 1.0]])}, "of y yarns above 0"),
        ([[1]], {"thickness": 0.1}, r"a thickness of at least two yarns \(0.15\), got 0.1"),
    ],
)
@pytest.mark.errors
def test_impossible_weaves_are_refused(over, more, text):
    with pytest.raises(FormatError, match=text):
        pattern(over, **more)
    with pytest.raises(ShapeError, match=r"weave_pattern\.x_yarns"):
        pattern([[1, 0]], x_yarns=torch.ones(2, 3))
