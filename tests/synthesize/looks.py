"""Small models with known coefficients, and pictures of noise, for the tests of synthesis."""

import torch

from torchmeso.data.eigen_btf import EigenBtf
from torchmeso.data.sh_btf import ShBtf
from torchmeso.data.sh_pca_btf import ShPcaBtf
from torchmeso.geometry import hemisphere

LIGHTS, VIEWS = hemisphere.grid(6, 3, 80), hemisphere.grid(5, 2, 75)


def eigen(rng, size=(4, 6), rank=3):
    maps = torch.rand(len(LIGHTS), *size, rank, 3, generator=rng)
    ones = torch.ones(rank, 3)
    weights = torch.randn(len(VIEWS), rank, generator=rng)
    return EigenBtf(maps=maps, weights=weights, scale=ones, offset=0.1 * ones, lights=LIGHTS, views=VIEWS)


def sh_pca(rng, size=(4, 6), rank=4, terms=9):
    return ShPcaBtf(
        maps=torch.rand(len(VIEWS), *size, rank, generator=rng),
        scale=torch.rand(rank, generator=rng),
        offset=torch.rand(rank, generator=rng),
        basis=torch.rand(rank, terms, 3, generator=rng) - 0.3,
        lights=LIGHTS,
        views=VIEWS,
    )


def double_sh(rng, size=(4, 6), terms=(9, 4)):
    maps = torch.rand(*terms, *size, 3, generator=rng)
    scale = torch.rand(*terms, 3, generator=rng)
    return ShBtf(maps=maps, scale=scale, offset=scale - 0.5, lights=LIGHTS, views=VIEWS)


def noise(height, width, rng, smooth=2):
    """Return a tiling picture of smooth noise in [0, 1]."""
    x = torch.rand(height, width, 3, generator=rng)
    for axis in (0, 1):
        x = sum(x.roll(k, axis) for k in range(-smooth, smooth + 1)) / (2 * smooth + 1)
    return (x - x.amin()) / (x.amax() - x.amin())
