from dataclasses import replace

import torch

from tests.data.test_gdm import layered
from torchmeso.bench import gdm_tables
from torchmeso.data.gdm_coded import codes_of


def test_all_forms_are_of_the_same_table():
    exact = layered(-0.27)
    direct = replace(exact, distance=codes_of(exact))
    half = replace(exact, distance=exact.distance.half())
    found = list(gdm_tables.forms(direct, half, (2,), (0.5,), lambda what, share: None))
    assert [form.name for form in found] == [
        "uint8", "half", "coded.0", "coded.0.5", "svd.boundary.2", "svd.hits.2",
    ]  # fmt: skip
    assert all(torch.equal(form.gdm.left, direct.left) for form in found)
    assert torch.equal(found[2].gdm.distance, direct.distance)
    assert found[1].held > found[0].held > found[-1].held
    assert [form.stored is None for form in found] == [True, True, False, False, False, False]
