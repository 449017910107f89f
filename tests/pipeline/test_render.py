import torch

from tests.pipeline.small import small
from torchmeso.pipeline import truth
from torchmeso.pipeline.render import render


def test_picture_looks_like_the_truth():
    """The same scene twice: objects in the same pixels, brightness alike."""
    settings = small()
    made = render(settings)
    found = truth.render(settings)
    assert (made.picture.owner == found.owner).float().mean() > 0.97
    both = (made.picture.owner == 0) & (found.owner == 0)
    assert torch.isclose(
        made.picture.rgb[both].mean(), found.rgb[both].mean(), rtol=0.3
    )  # two rings of four directions
    assert torch.isfinite(made.picture.rgb).all()


def test_same_bits_from_the_cache():
    assert torch.equal(render(small()).picture.rgb, render(small()).picture.rgb)
