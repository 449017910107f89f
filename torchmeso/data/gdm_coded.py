"""A generalised displacement map as a small file that opens as the table it was made from.

Codes of distances are stored where there is a hit and nowhere else: what leaves and what is solid is told by bits that
the table has anyhow, so neither the jump at a silhouette nor an arbitrary value on its far side is in the stream. LZMA
over them is exact; where an error is allowed, codes are rounded first to multiples of a step that is at most twice as
long. Opened it is a direct table.

Test: tests/data/test_gdm_coded.py
"""

from pathlib import Path

import torch
from jaxtyping import UInt8
from torch import Tensor

from torchmeso.data import gdm_streams, store
from torchmeso.data.gdm import Gdm
from torchmeso.data.gdm_svd import packed_bits, unpacked_bits
from torchmeso.errors import FormatError, check_range

ORDER = (3, 4, 0, 1, 2)
"""Streams run over voxels inside of layers, ring by ring and azimuth by azimuth: layers repeat most."""


MOST_STEP = 64
"""Codes that become one at most."""


def codes_of(table: Gdm) -> UInt8[Tensor, "Z H W theta phi"]:
    """Return the distances of a table as codes of cap / 255."""
    if table.distance.dtype == torch.uint8:
        return table.distance
    return (table.distance.float() * (255 / table.cap)).round().clamp(0, 255).to(torch.uint8)


def save(table: Gdm, path: str | Path, *, within: float = 0.0, **meta: object) -> None:
    """Write a run-time model (.gdm.meso): codes of hits, bits and material.

    Args:
        table: of any storage; eight bits are kept.
        path: the model.
        within: voxels that distances may be off by; less than half a code is exact.
        meta: what the model says besides.

    Raises:
        ConfigError: `within` is out of range.
    """
    check_range("compress.error", within, 0, 1e3)
    step = min(max(int(2 * within * table.voxel * 255 / table.cap), 1), MOST_STEP)
    hits = (~table.left & ~(table.occupancy > 0.5)[..., None, None]).permute(ORDER)
    codes = codes_of(table).permute(ORDER)[hits]
    rounded = ((codes.short() + step // 2) // step).to(torch.uint8)
    tensors = {"coded.distance": gdm_streams.packed(rounded)}
    tensors |= gdm_streams.to_tensors(packed_bits(table.left), table.occupancy, table.matter)
    n_theta, n_phi = table.distance.shape[3:]
    about = {"voxels": list(table.voxels), "n_theta": n_theta, "n_phi": n_phi, "h": table.h, "cap": table.cap}
    store.write_model(path, tensors, {"kind": "gdm coded", "coded": {**about, "step": step}, **meta})


def load(path: str | Path) -> Gdm:
    """Return the direct table of a run-time model.

    Raises:
        FormatError: the file is missing, damaged, or holds no coded GDM.
    """
    model = store.Model(path)
    about = model.meta.get("coded")
    if about is None:
        raise FormatError(f"{path}: expected a coded GDM, found {', '.join(model.names()) or 'nothing'}")
    with store.reading(path):
        layers, height, width = about["voxels"]
        n_theta, n_phi, step = about["n_theta"], about["n_phi"], about["step"]
        bits = (layers, height, width, n_theta, -(-n_phi // 8))
        packed, occupancy, matter = gdm_streams.from_model(model, bits)
        left = unpacked_bits(packed, n_phi)
        hits = (~left & ~(occupancy > 0.5)[..., None, None]).permute(ORDER)
        codes = gdm_streams.read(model, "coded.distance", (int(hits.sum()),), torch.uint8)
        distance = torch.zeros(hits.shape, dtype=torch.uint8)
        distance[hits] = (codes.short() * step).clamp(max=255).to(torch.uint8)
        back = [ORDER.index(k) for k in range(5)]
        return Gdm(
            distance=distance.permute(back).contiguous(), left=left, occupancy=occupancy, matter=matter,
            h=about["h"], cap=about["cap"],
        )  # fmt: skip
