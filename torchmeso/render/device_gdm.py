"""Generalised displacement maps as the kernels read them: codes of distances, and the material of voxels.

Kernels: kernels_cl/data/gdm.clh          Test: tests/render/test_device_gdm.py
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int32, UInt8
from torch import Tensor

from torchmeso.backends import opencl
from torchmeso.data.gdm import Gdm
from torchmeso.geometry import sphere

GDM = np.dtype(
    [(name, "i4") for name in ("there", "layers", "height", "width", "n_theta", "n_phi", "table")]
    + [(name, "i4") for name in ("per_phi", "per_row", "matter", "queries", "floor")]
    + [("h", "f4"), ("cap", "f4"), ("unit", "f4"), ("albedo", "f4", 3), ("bend", "f4")]
    + [("one_coat", "i4"), ("coat", "f4", 4)]
)
"""See `Gdm` in kernels_cl/data/gdm.clh."""

LEFT, SOLID = 255, 254
"""Codes of a table that are no distance."""

BEND = 1.0
"""Voxels that a way through a shell may turn from a straight one, in frames, before its table is asked again."""

BLOCK, BRICK = 64, (2, 4, 4)
"""Bytes that tables are aligned to; layers, rows and columns of voxels that stand together."""


class Dressing(NamedTuple):
    """How a surface is dressed.

    Attributes:
        gdm: the table; None: rays walk through to the end.
        h: depth of the slab, tile units.
        queries: look-ups per prism.
        floor: whether the bottom is solid.
        albedo: of the bottom.
        bend: how far, tile units, a way may turn from a straight one before a table is asked again; 0: in every prism.
    """

    gdm: Gdm | None
    h: float
    queries: int = 1
    floor: bool = True
    albedo: tuple[float, float, float] = (0.6, 0.6, 0.6)
    bend: float = 0.0


class DeviceGdms(NamedTuple):
    """GDMs on the device.

    Attributes:
        tables: codes and materials of all.
        gdms: (surface,) see `GDM`.
        sources: whose tables they are, so that they can be kept.
    """

    tables: "opencl.Buffer"
    gdms: "opencl.Buffer"
    sources: tuple[Gdm, ...]


def upload_gdms(dressings: Sequence[Dressing | None], before: DeviceGdms | None = None) -> DeviceGdms:
    """Return the GDMs of a scene's surfaces on the device; None for surfaces of another kind.

    Tables that `before` has, in the same order, stay.

    Raises:
        BackendError: there is no device, or no room on it.
    """
    sources = tuple({id(d.gdm): d.gdm for d in dressings if d is not None and d.gdm is not None}.values())
    places, parts, blocks = {}, [], 0
    keep = (
        before is not None
        and len(before.sources) == len(sources)
        and all(a is b for a, b in zip(before.sources, sources, strict=True))
    )
    for gdm in sources:
        at = []
        for size in (table_bytes(gdm), 16 * gdm.occupancy.numel()):
            at.append(blocks)
            blocks += -(-size // BLOCK)
        places[id(gdm)] = at
        if not keep:
            parts += [table_codes(gdm), matter_codes(gdm)]
    if keep and before is not None:
        tables = before.tables
    else:
        tables = opencl.allocate(max(blocks, 1) * BLOCK)
        for part, at in zip(parts, [x for gdm in sources for x in places[id(gdm)]], strict=True):
            opencl.store(part, tables, at * BLOCK)
    records = np.zeros(max(len(dressings), 1), GDM)
    for record, d in zip(records, dressings, strict=False):
        if d is None:
            continue
        record["h"], record["queries"], record["floor"], record["albedo"] = d.h, d.queries, d.floor, d.albedo
        record["bend"] = d.bend
        record["layers"], record["height"], record["width"] = 2, 1, 1
        if d.gdm is None:
            continue
        layers, height, width = d.gdm.voxels
        record["there"], record["layers"], record["height"], record["width"] = 1, layers, height, width
        record["n_theta"], record["n_phi"] = d.gdm.directions.n_theta, d.gdm.directions.n_phi
        record["table"], record["matter"] = places[id(d.gdm)]
        record["per_row"] = _voxels(d.gdm)
        record["per_phi"] = record["per_row"] * (d.gdm.directions.n_theta + 1)
        record["one_coat"], record["coat"] = one_coat(d.gdm)
        record["cap"], record["unit"] = d.gdm.cap, d.gdm.cap / 255
    return DeviceGdms(tables, opencl.upload(records), sources)


def table_bytes(gdm: Gdm) -> int:
    """Return how many bytes `table_codes` takes."""
    return 4 * gdm.directions.n_phi * (gdm.directions.n_theta + 1) * _voxels(gdm)


def _voxels(gdm: Gdm) -> int:
    """Return the voxels of all bricks."""
    return math.prod(-(-n // side) * side for n, side in zip(gdm.voxels, BRICK, strict=True))


def table_codes(gdm: Gdm) -> UInt8[np.ndarray, "byte"]:
    """Return a table as kernels read it, (phi, row, brick, voxel, 4): codes of distance, LEFT or SOLID.

    Rows are the rings and a pole before and behind them; the four codes are of a row and the next, at an azimuth and
    at the next one.
    """
    distance, left = gdm.distance, gdm.left
    if distance.dtype != torch.uint8:
        distance = (distance.float() * (255 / gdm.cap)).round().clamp(0, 255).to(torch.uint8)
    solid = gdm.occupancy > 0.5
    met = (~left).float()
    total, known = sphere.with_poles(distance.float() * met), sphere.with_poles(met)
    codes = (total / known.clamp(min=1e-6)).round().clamp(0, SOLID - 1)
    codes = torch.where(known > 0.5, codes, LEFT)
    codes = torch.where(solid[..., None, None], SOLID, codes).to(torch.uint8)
    # Bricks of 4 x 4 x 2 voxels: a ray's eight lie in few lines of the cache.
    short = [-n % side for n, side in zip(gdm.voxels, BRICK, strict=True)]
    codes = torch.nn.functional.pad(codes, (0, 0, 0, 0, 0, short[2], 0, short[1], 0, short[0]))
    layers, height, width = codes.shape[:3]
    bricks = codes.reshape(layers // 2, 2, height // 4, 4, width // 4, 4, *codes.shape[3:])
    by_direction = bricks.permute(7, 6, 0, 2, 4, 1, 3, 5)
    pairs = torch.stack([by_direction[:, :-1], by_direction[:, 1:]], -1)
    return torch.cat([pairs, pairs.roll(-1, 0)], -1).flatten().numpy()


def matter_codes(gdm: Gdm) -> Int32[np.ndarray, "voxel 4"]:
    """Return the material of voxels as kernels read it; see `matter` in kernels_cl/data/gdm.clh.

    Normals have 10 bits a channel, albedo and alpha 16, the square root of f0 10.
    """
    rows = gdm.matter.reshape(-1, 10).float()
    known = rows[:, 6] > 0
    normal = _codes(0.5 + 0.5 * rows[:, :3], 1023)
    r, g, b, alpha = _codes(rows[:, 3:7], 65535)
    words = [
        _packed(normal) | 1 << 30,
        r | g << 16,
        b | alpha << 16,
        _packed(_codes(rows[:, 7:].clamp(min=0).sqrt(), 1023)),
    ]
    return torch.where(known[:, None], torch.stack(words, 1), 0).numpy().astype(np.uint32).view(np.int32)


def one_coat(gdm: Gdm) -> tuple[bool, Float[Tensor, "4"]]:
    """Return whether all material has the same alpha and f0, and these of one voxel."""
    rows = gdm.matter.reshape(-1, 10)[:, 6:].float()
    rows = rows[rows[:, 0] > 0]
    if not len(rows):
        return True, torch.zeros(4)
    return bool(((rows.amax(0) - rows.amin(0)) < 1 / 65535).all()), rows[0].clamp(0, 1)


def _codes(values: Float[Tensor, "n channel"], most: int) -> tuple[Tensor, ...]:
    return (values.clamp(0, 1) * most).round().long().unbind(1)


def _packed(channels: tuple[Tensor, ...]) -> Tensor:
    return channels[0] | channels[1] << 10 | channels[2] << 20
