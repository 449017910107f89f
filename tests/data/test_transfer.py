import pytest
import torch

from torchmeso.data import store, transfer
from torchmeso.data.transfer import Transfer
from torchmeso.errors import FormatError, ShapeError


@pytest.mark.parametrize("colours", [1, 3])
def test_light_arrives_colour_by_colour(colours, rng):
    M = torch.rand(5, colours, 4, 4, generator=rng)
    e = torch.rand(4, 3, generator=rng)
    light = Transfer(matrices=M).arriving(e)
    assert torch.equal(light.coefficients, e)
    for c in range(3):
        torch.testing.assert_close(light.at_vertices[..., c], M[:, c % colours] @ e[:, c])


def test_round_trip(rng, tmp_path):
    made = Transfer(matrices=torch.rand(2, 1, 9, 9, generator=rng))
    transfer.save(made, tmp_path / "a.meso")
    assert torch.equal(transfer.load(tmp_path / "a.meso").matrices, made.matrices)


@pytest.mark.errors
def test_what_is_no_transfer_is_refused(tmp_path):
    with pytest.raises(ShapeError, match="expected 1 or 3 colours"):
        Transfer(matrices=torch.ones(2, 2, 4, 4))
    store.write_model(tmp_path / "b.meso", {"x": torch.ones(1)}, {"kind": "other"})
    with pytest.raises(FormatError, match="expected a transfer, found x"):
        transfer.load(tmp_path / "b.meso")
    with pytest.raises(ShapeError, match="distant light: expected shape"):
        Transfer(matrices=torch.ones(2, 1, 4, 4)).arriving(torch.ones(9, 3))
