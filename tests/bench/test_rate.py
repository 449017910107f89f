import pytest
import torch

from torchmeso.bench import rate
from torchmeso.data.btf import Btf
from torchmeso.geometry import hemisphere


@pytest.mark.slow
def test_the_smallest_file_meets_its_rows(rng):
    directions = hemisphere.ubo81()
    light, view = (torch.rand(81, 6, generator=rng) for _ in range(2))
    texture = torch.rand(6, 12, 12, 3, generator=rng)
    images = torch.einsum("lk,vk,khwc->lvhwc", light, view, texture) / 3
    rows = list(rate._at_all_sizes("made", Btf(images=images, lights=directions, views=directions), images))
    assert len(rows) == 21
    goals = [row for row in rows if row.goal is not None]
    assert [row.id for row in goals] == ["compress.budget.made.10.transform", "compress.budget.made.200.transform"]
    assert goals[0].met
    found = {row.id: row.value for row in rows}
    assert found["compress.budget.made.50.transform"] > found["compress.budget.made.50.double-sh"]
