"""A small BTF in pictures as the University of Bonn names them."""

import numpy as np
import torch
from PIL import Image

from torchmeso.geometry import gaps, hemisphere

LIGHTS = hemisphere.from_rings((0, 40), (1, 6), (0, 0))
VIEWS = hemisphere.from_rings((0, 50), (1, 3), (0, 20))


def codes(lights=LIGHTS, views=VIEWS, height=5, width=4):
    """(light, view, H, W, 3) random uint8."""
    rng = torch.Generator().manual_seed(1)
    return torch.randint(0, 256, (len(lights), len(views), height, width, 3), generator=rng, dtype=torch.uint8)


def names(lights=LIGHTS, views=VIEWS, suffix=".png"):
    """{(light, view): name}, each view in a folder."""
    found = {}
    for v, (tv, pv) in enumerate(gaps.angles_deg(views)):
        for l, (tl, pl) in enumerate(gaps.angles_deg(lights)):
            number = len(views) * l + v
            found[l, v] = f"TOY/tv{tv:03g}_pv{pv:03g}/{number:05d} tl{tl:03g} pl{pl:03g} tv{tv:03g} pv{pv:03g}{suffix}"
    return found


def write(folder, images, lights=LIGHTS, views=VIEWS, suffix=".png"):
    """Write the pictures; return their names."""
    found = names(lights, views, suffix)
    for (l, v), name in found.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.asarray(images[l, v])).save(folder / name)
    return found
