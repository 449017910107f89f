import pytest
import torch

from torchmeso.bench import limits
from torchmeso.render.film import Picture


def half_dark():
    """A picture whose left half lies in a shadow; one pixel shows the background."""
    owner = torch.zeros(20, 20, dtype=torch.long)
    owner[0, 0] = -1
    shadowed = torch.zeros(1, 20, 20, dtype=torch.bool)
    shadowed[:, :, :10] = True
    return Picture(
        rgb=torch.ones(20, 20, 3), depth=torch.ones(20, 20), owner=owner, shadowed=shadowed, counts={}, seconds={}
    )


def test_regions_share_out_what_both_pictures_show():
    picture = half_dark()
    both = picture.owner >= 0
    found = limits.regions(picture, both)
    assert torch.equal(sum(r.pixels.long() for r in found.values()), both.long())
    assert found["border"].pixels[5].nonzero()[:, 0].tolist() == [7, 8, 9, 10, 11, 12]
    assert found["shadow"].pixels[5].nonzero()[:, 0].tolist() == list(range(7))


def test_brightness_is_a_ratio_of_means():
    a, b = torch.full((4, 4, 3), 0.2), torch.full((4, 4, 3), 0.5)
    pixels = torch.zeros(4, 4, dtype=torch.bool)
    pixels[1] = True
    assert limits.brightness(a, b, pixels) == pytest.approx(0.4)
