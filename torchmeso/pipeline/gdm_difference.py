"""How far a GDM model is from the table it was made from, entry by entry.

Test: tests/pipeline/test_gdm_difference.py
"""

from dataclasses import dataclass
from pathlib import Path

import torch

from torchmeso.data.gdm_coded import codes_of
from torchmeso.errors import ShapeError
from torchmeso.pipeline.bake import open_gdm

ENDINGS = (".gdm.zarr", ".gdm.meso")


@dataclass(frozen=True, slots=True, kw_only=True)
class GdmDifference:
    """What differs between two tables of one size.

    Attributes:
        wrong: share of entries in [0, 1] that meet something in one table and nothing in the other.
        rms: root of the mean squared difference of distances where both meet something, in voxels; 0 where none do.
        p95: 95 % of these differ by no more, in voxels.
        max_error: the largest of them, in voxels.
    """

    wrong: float
    rms: float
    p95: float
    max_error: float


def is_gdm(path: str | Path) -> bool:
    """Return whether a name is that of a GDM."""
    return str(path).rstrip("/").endswith(ENDINGS)


def compare(a: str | Path, b: str | Path) -> GdmDifference:
    """Return how GDM `b` differs from its reference `a`.

    Raises:
        ShapeError: their voxels, directions, depth or longest distance differ.
        FormatError: a file is missing, damaged, or holds no GDM.
    """
    reference, model = open_gdm(a), open_gdm(b)
    if reference.distance.shape != model.distance.shape or (reference.h, reference.cap) != (model.h, model.cap):
        wanted, got = (f"{tuple(x.distance.shape)}, h {x.h:g}, cap {x.cap:g}" for x in (reference, model))
        raise ShapeError(f"{b}: expected {wanted} as in {a}, got {got}")
    solid = (reference.occupancy > 0.5)[..., None, None]
    both = ~reference.left & ~model.left & ~solid
    # Differences are whole numbers of codes: counts of each are all there is to know.
    off = (codes_of(reference)[both].short() - codes_of(model)[both].short()).abs()
    if not len(off):
        off = torch.zeros(1, dtype=torch.int16)
    counts = torch.bincount(off).double()
    size = torch.arange(len(counts), dtype=torch.float64) * reference.cap / 255 / reference.voxel
    return GdmDifference(
        wrong=float((reference.left != model.left).double().mean()),
        rms=float((counts * size.square()).sum() / counts.sum()) ** 0.5,
        p95=float(size[int((counts.cumsum(0) < 0.95 * counts.sum()).sum())]),
        max_error=float(size[-1]),
    )
