from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.data.test_gdm import layered
from torchmeso.meso import bake_gdm, generators
from torchmeso.meso.bake_gdm import GdmOptions
from torchmeso.render import device_gdm
from torchmeso.render.device_gdm import BRICK, LEFT, SOLID, Dressing


@pytest.fixture(scope="module")
def weave():
    return bake_gdm.in_memory(generators.weave(), GdmOptions(texels=10, layers=5, n_theta=4, n_phi=6))


def at(gdm, codes, phi, row, z, y, x):
    """The four codes at a place, as kernels find them."""
    layers, height, width = (-(-n // side) for n, side in zip(gdm.voxels, BRICK, strict=True))
    brick = ((z // 2) * height + y // 4) * width + x // 4
    voxel = ((z % 2) * 4 + y % 4) * 4 + x % 4
    word = ((phi * (gdm.directions.n_theta + 1) + row) * layers * height * width + brick) * 32 + voxel
    return codes[4 * word :][:4]


def test_codes_are_those_of_the_table(weave):
    codes = device_gdm.in_bricks(device_gdm.sample_codes(weave))
    assert len(codes) == device_gdm.table_bytes(weave)
    rng = np.random.default_rng(1)
    kinds = set()
    for _ in range(400):
        z, y, x = (int(rng.integers(n)) for n in weave.voxels)
        row, phi = int(rng.integers(1, 4)), int(rng.integers(6))
        got = at(weave, codes, phi, row, z, y, x)
        for k in range(4):
            ring, azimuth = row + k % 2 - 1, (phi + k // 2) % 6
            expected = int(weave.distance[z, y, x, ring, azimuth])
            if weave.occupancy[z, y, x] > 0.5:
                expected = SOLID
            elif weave.left[z, y, x, ring, azimuth]:
                expected = LEFT
            assert got[k] == min(expected, LEFT if expected >= SOLID else SOLID - 1)
            kinds.add(min(expected, SOLID - 1) if expected < SOLID else expected)
    assert {LEFT, SOLID} < kinds


def test_matter_keeps_its_values():
    gdm = layered(-0.2)
    gdm.matter[4:] = 0
    words = device_gdm.matter_codes(gdm).astype(np.uint32)
    rows = gdm.matter.reshape(-1, 10).numpy()
    near = rows[:, 6] > 0
    normal = np.stack([words[near, 0] >> shift & 1023 for shift in (0, 10, 20)], -1)
    np.testing.assert_allclose(normal / 1023 * 2 - 1, rows[near, :3], atol=1e-3)
    halves = np.stack([words[near, 1 + c // 2] >> 16 * (c % 2) & 0xFFFF for c in range(4)], -1)
    np.testing.assert_allclose(halves / 65535, rows[near, 3:7], atol=1e-5)
    roots = np.stack([words[near, 3] >> shift & 1023 for shift in (0, 10, 20)], -1)
    np.testing.assert_allclose((roots / 1023) ** 2, rows[near, 7:], atol=5e-4)
    assert (words[near, 0] >> 30 == 1).all()
    assert not words[~near].any()


def test_columns_that_repeat_are_kept_once(weave):
    codes = device_gdm.sample_codes(weave).repeat(1, 3, 4, 1, 1)
    packed = device_gdm.columns(codes)
    assert packed is not None
    rng = np.random.default_rng(2)
    assert device_gdm.columns(device_gdm.sample_codes(weave)) is None or len(packed.codes) <= 600
    _, height, width, rows, n_phi = codes.shape
    assert (packed.which[..., -1] == packed.which[..., 0]).all()
    for _ in range(300):
        y, x, phi, row = (int(rng.integers(n)) for n in (height, width, n_phi, rows - 1))
        got = packed.codes[packed.which[y, x, phi], row]
        np.testing.assert_array_equal(got, codes[:, y, x, row : row + 2, phi].numpy())


def test_columns_that_do_not_repeat_stay(rng):
    codes = torch.randint(0, 254, (5, 10, 10, 6, 6), generator=rng).to(torch.uint8)
    assert device_gdm.columns(codes) is None


@pytest.mark.parametrize(("varied", "same"), [(3, True), (6, False), (9, False)])
def test_a_coat_that_all_material_shares_is_told(weave, varied, same):
    """Voxels without material do not count, and colours do not."""
    matter = torch.full_like(weave.matter, 0.5)
    matter[0] = 0
    assert device_gdm.one_coat(replace(weave, matter=matter))[0]
    matter[..., varied] *= torch.linspace(0.5, 1, matter.shape[2])
    assert device_gdm.one_coat(replace(weave, matter=matter))[0] is same


def test_tables_stay_while_they_are_the_same(weave):
    first = device_gdm.upload_gdms([Dressing(weave, weave.h), None])
    again = device_gdm.upload_gdms([None, Dressing(weave, weave.h, queries=3)], first)
    assert again.tables is first.tables
    other = device_gdm.upload_gdms([Dressing(layered(-0.2), 0.4)], first)
    assert other.tables is not first.tables
    assert torch.is_tensor(other.sources[0].distance)
