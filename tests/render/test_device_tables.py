import math

import numpy as np
import torch

from torchmeso.compress import eigen
from torchmeso.compress.eigen import EigenOptions
from torchmeso.data import eigen_btf
from torchmeso.geometry import hemisphere
from torchmeso.meso import bake_btf, generators
from torchmeso.meso.bake_btf import BtfOptions
from torchmeso.render import device_tables


def test_structures_have_the_kernels_sizes():
    assert [x.itemsize for x in (device_tables.REFLECTANCE, device_tables.MDF)] == [128, 64]


def test_tables_stand_on_blocks_of_64_bytes():
    pool = device_tables.Pool()
    arrays = [np.arange(n, dtype=np.float32) for n in (3, 16, 17, 1)]
    blocks = [pool.add(x) for x in arrays]
    whole = pool.joined()
    assert blocks == [0, 1, 2, 4]
    for block, x in zip(blocks, arrays, strict=True):
        np.testing.assert_array_equal(whole[64 * block : 64 * block + x.nbytes].view(np.float32), x)


def test_components_stand_in_vectors_of_four():
    x = torch.arange(6 * 3, dtype=torch.float32).reshape(1, 6, 3)
    grouped = device_tables.in_groups(x)
    assert grouped.shape == (1, 2, 16)
    torch.testing.assert_close(grouped.reshape(1, 8, 4)[:, :6, :3], x)
    assert grouped.reshape(1, 8, 4)[:, 6:].abs().sum() == 0


def test_bounds_of_component_groups_hold():
    """No group of components adds more to T than its bound says."""
    table = bake_btf.in_memory(
        generators.brick(), BtfOptions(texels=8, lights="grid(6, 3, 80)", views="grid(6, 3, 80)", samples=1, bounces=0)
    )
    model = eigen.fit(table, EigenOptions(rank=8))
    weights = hemisphere.with_pole(model.weights, model.views)
    bounds = device_tables._bounds(model, weights)
    E = eigen_btf.EigenBtf.decoded(model).flatten(0, 2)
    for g in range(2):
        part = torch.einsum("nkc,vk->vnc", E[:, 4 * g : 4 * g + 4], weights[:, 4 * g : 4 * g + 4])
        assert (part.abs().amax((1, 2)) <= bounds[:, g] * (1 + 1e-5)).all()
    assert math.isfinite(float(bounds.max()))
