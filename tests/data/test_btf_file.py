import pytest
import torch

from torchmeso.compress import eigen
from torchmeso.compress.eigen import EigenOptions
from torchmeso.data import btf, btf_file, btfdbb_write
from torchmeso.data.btf import Btf
from torchmeso.errors import FormatError
from torchmeso.geometry import hemisphere


def test_one_door_for_every_kind(tmp_path, rng):
    directions = hemisphere.grid(4, 2, 80)
    table = Btf(images=torch.rand(8, 8, 4, 6, 3, generator=rng), lights=directions, views=directions)
    btf.save(table, tmp_path / "a.btf.zarr")
    btfdbb_write.write_bdi(tmp_path / "A.BTF", table)
    ours, bonn = btf_file.load(tmp_path / "a.btf.zarr"), btf_file.load(tmp_path / "A.BTF")
    assert bonn.texels == ours.texels
    assert torch.equal(bonn.rows(1, 3), ours.rows(1, 3))
    first, second = (eigen.fit(x, EigenOptions(rank=3, storage="float32")) for x in (ours, bonn))
    torch.testing.assert_close(first.maps, second.maps, rtol=1e-4, atol=1e-4)


@pytest.mark.errors
def test_other_files_are_refused(tmp_path):
    with pytest.raises(FormatError, match=r"a\.png: expected a BTF: a raw table \(\.btf\.zarr\) or a Bonn file"):
        btf_file.load(tmp_path / "a.png")
