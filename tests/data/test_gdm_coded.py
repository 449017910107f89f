from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.data.test_gdm import layered
from torchmeso.data import gdm_coded, gdm_streams, store
from torchmeso.errors import ConfigError, FormatError


def in_bytes(level=-0.27):
    table = layered(level)
    return replace(table, distance=gdm_coded.codes_of(table))


def test_a_coded_file_opens_as_the_same_bytes(tmp_path):
    table = in_bytes()
    gdm_coded.save(table, tmp_path / "a.gdm.meso")
    again = gdm_coded.load(tmp_path / "a.gdm.meso")
    for name in ("distance", "left", "occupancy"):
        assert torch.equal(getattr(again, name), getattr(table, name))
    torch.testing.assert_close(again.matter, table.matter, rtol=1e-3, atol=0)
    assert (again.h, again.cap) == (table.h, table.cap)


def test_distances_stay_within_what_is_allowed(tmp_path):
    table = in_bytes()
    gdm_coded.save(table, tmp_path / "a.gdm.meso", within=0.2)
    step = store.Model(tmp_path / "a.gdm.meso").meta["coded"]["step"]
    off = (gdm_coded.load(tmp_path / "a.gdm.meso").distance.double() - table.distance).abs() * table.cap / 255
    assert step > 1
    assert 0 < off.max() <= 0.2 * table.voxel


@pytest.mark.parametrize("level", [-5.0, 0.1])
def test_empty_and_solid_volumes_have_no_distances(tmp_path, level):
    table = in_bytes(level)
    gdm_coded.save(table, tmp_path / "a.gdm.meso")
    again = gdm_coded.load(tmp_path / "a.gdm.meso")
    assert torch.equal(again.left, table.left)
    assert torch.equal(again.distance, table.distance)


def test_streams_hold_values_of_any_width(tmp_path, rng):
    values = {"a.u8": torch.uint8, "a.f16": torch.float16, "a.f32": torch.float32}
    parts = {name: (40 * torch.rand(3, 7, generator=rng)).to(dtype) for name, dtype in values.items()}
    store.write_model(tmp_path / "a.meso", {k: gdm_streams.packed(v) for k, v in parts.items()}, {})
    model = store.Model(tmp_path / "a.meso")
    for name, part in parts.items():
        assert torch.equal(gdm_streams.read(model, name, (3, 7), part.dtype), part)
    with pytest.raises(FormatError, match="expected 88 bytes in a stream"):
        gdm_streams.read(model, "a.f32", (2, 11), torch.float32)
    with pytest.raises(FormatError, match="expected sizes of 0 or more"):
        gdm_streams.read(model, "a.f32", (-2, 11), torch.float32)


def test_codes_of_other_storage_are_rounded():
    table = layered(-0.27)
    expected = np.rint(table.distance.numpy() / table.cap * 255)
    assert np.abs(gdm_coded.codes_of(table).numpy() - expected).max() <= 1


@pytest.mark.errors
def test_other_files_and_negative_errors_are_refused(tmp_path):
    store.write_model(tmp_path / "a.gdm.meso", {"x": torch.zeros(1)}, {"kind": "eigen"})
    with pytest.raises(FormatError, match="expected a coded GDM, found x"):
        gdm_coded.load(tmp_path / "a.gdm.meso")
    with pytest.raises(ConfigError, match=r"compress\.error: expected"):
        gdm_coded.save(in_bytes(), tmp_path / "b.gdm.meso", within=-1.0)
