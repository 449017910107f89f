"""Every configuration that ships runs from start to picture, reduced."""

import os
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from torchmeso import config
from torchmeso.pipeline import truth
from torchmeso.pipeline.render import render

CONFIGS = sorted((Path(__file__).parents[2] / "configs").glob("*.yaml"))


def reduced(settings):
    """The same scene with small pictures and coarse tables."""
    materials = {
        name: m.model_copy(
            update={
                "btf": replace(m.btf, texels=16, lights="grid(6, 3, 80)", views="grid(6, 3, 80)", samples=1, bounces=0),
                "mdf": replace(m.mdf, texels=64),
                "eigen": replace(m.eigen, rank=min(m.eigen.rank, 4)),
            }
        )
        for name, m in settings.materials.items()
    }
    camera = settings.camera.model_copy(update={"width": 80, "height": 60})
    few = settings.truth.model_copy(update={"samples": 1, "bounces": 0, "max_edge": 0.5})
    return settings.model_copy(update={"materials": materials, "camera": camera, "truth": few})


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*unwrapped into")
@pytest.mark.filterwarnings("ignore:truth. a normal map has no geometry")
@pytest.mark.parametrize("path", CONFIGS, ids=lambda p: p.stem)
def test_start_to_picture(path):
    if "data:" in path.read_text() and not config.data_dir().is_dir():
        pytest.skip(f"real inputs are absent: set TORCHMESO_DATA (it is {os.environ.get('TORCHMESO_DATA')})")
    settings = reduced(config.load(path))
    picture = render(settings).picture
    assert torch.isfinite(picture.rgb).all()
    assert picture.coverage > 0.1
    in_depth = any(m.meso is not None for m in settings.materials.values())
    assert (picture.counts["intervals carved"] > 0) == in_depth
    found = truth.render(settings)
    assert (picture.owner == found.owner).float().mean() > 0.95
