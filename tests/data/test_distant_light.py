import pytest
import torch

from torchmeso.data.distant_light import DistantLight
from torchmeso.errors import ConfigError, ShapeError


def test_vertices_that_are_not_known_see_all_the_light():
    light = DistantLight(coefficients=torch.ones(4, 3), at_vertices=torch.zeros(2, 4, 3))
    assert light.degree == 1
    assert light.at(3).sum((1, 2)).tolist() == [0, 0, 12]
    assert DistantLight(coefficients=torch.ones(4, 3)).at(2).shape == (2, 4, 3)


@pytest.mark.errors
def test_what_is_no_light_is_refused():
    with pytest.raises(ConfigError, match="square number"):
        DistantLight(coefficients=torch.ones(5, 3))
    with pytest.raises(ShapeError, match="at vertices: expected shape"):
        DistantLight(coefficients=torch.ones(4, 3), at_vertices=torch.zeros(2, 9, 3))
    with pytest.raises(ShapeError, match="nan"):
        DistantLight(coefficients=torch.full((1, 3), torch.nan))
    with pytest.raises(ShapeError, match="at most 1 of this scene, got 2"):
        DistantLight(coefficients=torch.ones(1, 3), at_vertices=torch.zeros(2, 1, 3)).at(1)
