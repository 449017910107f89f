import pytest
import torch

from torchmeso.data import code_stream, store
from torchmeso.data.code_stream import packed, unpacked
from torchmeso.errors import FormatError


def test_codes_come_back(rng):
    for shape in ((3,), (1, 1, 3), (4, 5, 6, 3)):
        codes = torch.randint(0, 256, shape, generator=rng, dtype=torch.uint8)
        assert torch.equal(unpacked(packed(codes), shape), codes)


def test_what_says_little_takes_little_room(rng):
    grey = torch.randint(0, 256, (40, 40, 1), generator=rng, dtype=torch.uint8).expand(40, 40, 3)
    assert len(packed(grey)) < 1.05 * 40 * 40
    few = torch.randint(0, 4, (100, 100, 3), generator=rng, dtype=torch.uint8)
    assert len(packed(few)) < 0.4 * few.numel()  # two bits each, and three for a difference
    assert len(packed(torch.zeros(500, 500, 3, dtype=torch.uint8))) < 500


def test_maps_of_zeros_are_not_stored_but_for_the_first(tmp_path, rng):
    zeros = torch.zeros(4, 5, 3, dtype=torch.uint8)
    codes = torch.randint(0, 256, (4, 5, 3), generator=rng, dtype=torch.uint8)
    tensors = {}
    for k, x in enumerate((zeros, zeros, codes)):
        tensors |= code_stream.named(f"x.{k}", x, first=k == 0)
    assert sorted(tensors) == ["x.0", "x.2"]
    store.write_model(tmp_path / "a.meso", tensors, {})
    model = store.Model(tmp_path / "a.meso")
    back = [code_stream.read(model, f"x.{k}", (4, 5, 3), first=k == 0) for k in range(3)]
    assert torch.equal(torch.stack(back), torch.stack([zeros, zeros, codes]))


@pytest.mark.errors
def test_streams_that_are_not_whole_are_refused(tmp_path):
    stream = packed(torch.full((4, 5, 3), 7, dtype=torch.uint8))
    for shape in ((4, 5, 6), (4, 4, 3), (1 << 30, 1 << 30, 3)):
        with pytest.raises(FormatError, match=r"expected [0-9]+ bytes in a stream, got (60|49)"):
            unpacked(stream, shape)
    with pytest.raises(FormatError, match="at least one code"):
        unpacked(stream, (0, 5, 3))
    with pytest.raises(FormatError, match="a stream is damaged"):
        unpacked(torch.full((40,), 255, dtype=torch.uint8), (4, 5, 3))
    store.write_model(tmp_path / "a.meso", {"x.1": stream}, {})
    with pytest.raises(FormatError, match=r"expected a tensor 'x\.0', found none"):
        code_stream.read(store.Model(tmp_path / "a.meso"), "x.0", (4, 5, 3), first=True)
