import pytest
import torch

from torchmeso.data import btfdbb_colour
from torchmeso.data.btfdbb_colour import Colour, from_rgb, to_rgb
from torchmeso.errors import FormatError, ShapeError

PCA = Colour(3, (0.3, 0.2, 0.1), (0.6, 0.6, 0.5, 0.7, -0.7, 0.0, 0.4, 0.4, -0.8))
COLOURS = [PCA if model == 3 else Colour(model) for model in btfdbb_colour.READ if model != 10]


@pytest.mark.parametrize("colour", COLOURS, ids=lambda c: c.name)
def test_both_ways(colour, rng):
    rgb = torch.exp(12 * torch.rand(1000, 3, dtype=torch.float64, generator=rng) - 8)  # to 55: highlights are kept
    torch.testing.assert_close(to_rgb(colour, from_rgb(colour, rgb)), rgb, rtol=1e-6, atol=1e-6)


def test_black_and_white():
    ends = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]], dtype=torch.float64)
    for colour in COLOURS:
        torch.testing.assert_close(to_rgb(colour, from_rgb(colour, ends)), ends, rtol=0, atol=1e-6)
    white = from_rgb(Colour(2), ends)[1]
    torch.testing.assert_close(white, torch.tensor([100.0, 0, 0], dtype=torch.float64), rtol=0, atol=1e-2)
    torch.testing.assert_close(from_rgb(Colour(4), ends)[1], ends.new_tensor([1, 0, 0]))


def test_model_11_multiplies_the_chroma_by_the_lifted_luminance():
    """U = u (Y + e), not u Y + e: at Y = 0 the second would leave no chroma but e."""
    Y, e = 2e-5, btfdbb_colour.EPSILON
    x = torch.tensor([Y + e, 1.0, 1.0], dtype=torch.float64)
    x = torch.cat([x[:1].log(), torch.tensor([0.5, -0.25], dtype=torch.float64)])
    U, V = 0.5 * (Y + e), -0.25 * (Y + e)
    expected = torch.tensor([Y + 1.13983 * V, Y - 0.39465 * U - 0.5806 * V, Y + 2.03211 * U], dtype=torch.float64)
    torch.testing.assert_close(to_rgb(Colour(11), x), expected, rtol=1e-12, atol=0)


def test_logarithms_of_all_three():
    """Model 10 holds no chroma below -e; where there is none it is the inverse too."""
    x = torch.tensor([[0.5, -2.0, -3.0]], dtype=torch.float64)
    Y, U, V = (x[0].exp() - 1e-5).tolist()
    expected = torch.tensor([[Y + 1.13983 * V, Y - 0.39465 * U - 0.5806 * V, Y + 2.03211 * U]], dtype=torch.float64)
    torch.testing.assert_close(to_rgb(Colour(10), x), expected, rtol=1e-12, atol=0)
    torch.testing.assert_close(from_rgb(Colour(10), expected), x, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(to_rgb(Colour(12), x), x.exp() - 1e-5)


def test_highlights_are_not_clamped():
    x = torch.tensor([8.0, 0.0, 0.0])
    torch.testing.assert_close(to_rgb(Colour(11), x), torch.full((3,), 2980.958), rtol=1e-5, atol=0)


@pytest.mark.errors
def test_other_models_are_refused():
    for model, name in ((5, "spectral"), (6, "spectral, linear"), (7, "unknown"), (-1, "unknown")):
        with pytest.raises(FormatError, match=rf"colour model {model} \({name}\): expected one of 0, 1, 2"):
            Colour(model)
    with pytest.raises(FormatError, match="a singular one"):
        Colour(3, (0.0, 0.0, 0.0), (0.0,) * 9)


@pytest.mark.errors
@pytest.mark.parametrize("model", [9, 10, 11, 12])
def test_logarithms_of_negative_values_are_refused(model):
    with pytest.raises(ShapeError, match=r"expected values from 0 on, got -.*a model without logarithms"):
        from_rgb(Colour(model), torch.tensor([-0.1, -0.1, -0.1]))
