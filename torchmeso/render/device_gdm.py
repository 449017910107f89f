"""Generalised displacement maps as the kernels read them: codes of distances, and the material of voxels.

Kernels: kernels_cl/data/gdm.clh          Test: tests/render/test_device_gdm.py
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int32, UInt8, UInt16
from torch import Tensor

from torchmeso.backends import opencl
from torchmeso.data.gdm import Gdm
from torchmeso.geometry import sphere

GDM = np.dtype(
    [(name, "i4") for name in ("there", "layers", "height", "width", "n_theta", "n_phi", "table", "columns", "which")]
    + [(name, "i4") for name in ("per_phi", "per_row", "matter", "queries", "floor")]
    + [("h", "f4"), ("cap", "f4"), ("unit", "f4"), ("albedo", "f4", 3), ("bend", "f4")]
    + [("one_coat", "i4"), ("coat", "f4", 4)]
)
"""See `Gdm` in kernels_cl/data/gdm.clh."""

LEFT, SOLID = 255, 254
"""Codes of a table that are no distance."""

BEND = 1.0
"""Voxels that a way through a shell may turn from a straight one, in frames, before its table is asked again."""

MOST_COLUMNS = 65535
"""As many as 16 bits can tell apart."""

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


class Form(NamedTuple):
    """Where a table stands and how it is packed.

    Attributes:
        table: block of the codes.
        columns: how many different columns of voxels there are; 0: all of them stand in bricks.
        which: block of which column stands where.
        matter: block of the material.
    """

    table: int
    columns: int
    which: int
    matter: int


class DeviceGdms(NamedTuple):
    """GDMs on the device.

    Attributes:
        tables: codes and materials of all.
        gdms: (surface,) see `GDM`.
        sources: whose tables they are, so that they can be kept.
        forms: of each source.
    """

    tables: "opencl.Buffer"
    gdms: "opencl.Buffer"
    sources: tuple[Gdm, ...]
    forms: tuple[Form, ...]


def upload_gdms(dressings: Sequence[Dressing | None], before: DeviceGdms | None = None) -> DeviceGdms:
    """Return the GDMs of a scene's surfaces on the device; None for surfaces of another kind.

    Tables that `before` has, in the same order, stay.

    Raises:
        BackendError: there is no device, or no room on it.
    """
    sources = tuple({id(d.gdm): d.gdm for d in dressings if d is not None and d.gdm is not None}.values())
    keep = (
        before is not None
        and len(before.sources) == len(sources)
        and all(a is b for a, b in zip(before.sources, sources, strict=True))
    )
    tables, forms = (before.tables, before.forms) if before is not None and keep else _upload_tables(sources)
    form_of = dict(zip(map(id, sources), forms, strict=True))
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
        for name, value in form_of[id(d.gdm)]._asdict().items():
            record[name] = value
        record["per_row"] = _voxels(d.gdm)
        record["per_phi"] = record["per_row"] * (d.gdm.directions.n_theta + 1)
        record["one_coat"], record["coat"] = one_coat(d.gdm)
        record["cap"], record["unit"] = d.gdm.cap, d.gdm.cap / 255
    return DeviceGdms(tables, opencl.upload(records), sources, forms)


def _upload_tables(sources: Sequence[Gdm]) -> tuple["opencl.Buffer", tuple[Form, ...]]:
    parts: list[np.ndarray] = []
    starts = [0]

    def place(part: np.ndarray) -> int:
        parts.append(part)
        starts.append(starts[-1] + -(-part.nbytes // BLOCK))
        return starts[-2]

    forms = []
    for gdm in sources:
        codes = sample_codes(gdm)
        packed = columns(codes)
        if packed is None:
            forms.append(Form(place(in_bricks(codes)), 0, 0, place(matter_codes(gdm))))
        else:
            forms.append(Form(place(packed.codes), len(packed.codes), place(packed.which), place(matter_codes(gdm))))
    tables = opencl.allocate(max(starts[-1], 1) * BLOCK)
    for part, at in zip(parts, starts, strict=False):
        opencl.store(part, tables, at * BLOCK)
    return tables, tuple(forms)


def table_bytes(gdm: Gdm) -> int:
    """Return how many bytes `in_bricks` takes."""
    return 4 * gdm.directions.n_phi * (gdm.directions.n_theta + 1) * _voxels(gdm)


def held_bytes(gdm: Gdm) -> int:
    """Return how many bytes kernels keep of a table: codes, and where which is; without the material."""
    packed = columns(sample_codes(gdm))
    return table_bytes(gdm) if packed is None else packed.codes.nbytes + packed.which.nbytes


def _voxels(gdm: Gdm) -> int:
    """Return the voxels of all bricks."""
    return math.prod(-(-n // side) * side for n, side in zip(gdm.voxels, BRICK, strict=True))


def sample_codes(gdm: Gdm) -> UInt8[Tensor, "Z H W row phi"]:
    """Return codes of distance, LEFT or SOLID; rows are the rings and a pole before and behind them."""
    distance, left = gdm.distance, gdm.left
    if distance.dtype != torch.uint8:
        distance = (distance.float() * (255 / gdm.cap)).round().clamp(0, 255).to(torch.uint8)
    solid = gdm.occupancy > 0.5
    met = (~left).float()
    total, known = sphere.with_poles(distance.float() * met), sphere.with_poles(met)
    codes = (total / known.clamp(min=1e-6)).round().clamp(0, SOLID - 1)
    codes = torch.where(known > 0.5, codes, LEFT)
    return torch.where(solid[..., None, None], SOLID, codes).to(torch.uint8)


def in_bricks(codes: UInt8[Tensor, "Z H W row phi"]) -> UInt8[np.ndarray, "byte"]:
    """Return a table as kernels read it, (phi, row, brick, voxel, 4): four codes at each voxel.

    They are of a row of directions and the next, at an azimuth and at the next one. Bricks are of 4 x 4 x 2 voxels: a
    ray's eight lie in few lines of the cache.
    """
    short = [-n % side for n, side in zip(codes.shape, BRICK, strict=False)]
    codes = torch.nn.functional.pad(codes, (0, 0, 0, 0, 0, short[2], 0, short[1], 0, short[0]))
    layers, height, width = codes.shape[:3]
    bricks = codes.reshape(layers // 2, 2, height // 4, 4, width // 4, 4, *codes.shape[3:])
    by_direction = bricks.permute(7, 6, 0, 2, 4, 1, 3, 5)
    pairs = torch.stack([by_direction[:, :-1], by_direction[:, 1:]], -1)
    return torch.cat([pairs, pairs.roll(-1, 0)], -1).flatten().numpy()


class Columns(NamedTuple):
    """A table whose columns of voxels repeat.

    Attributes:
        codes: (column, row, layer, 2) of each different one, at a row of directions and the next.
        which: (H, W, phi + 1) the column that stands there; behind the last azimuth the first again.
    """

    codes: UInt8[np.ndarray, "column row layer 2"]
    which: UInt16[np.ndarray, "H W phi"]


def columns(codes: UInt8[Tensor, "Z H W row phi"]) -> Columns | None:
    """Return a table with equal columns, as seen at one azimuth, kept once; None where that is no eighth of it.

    Threads, tiles and pebbles repeat, and what is solid at the bottom is the same everywhere. Nothing is lost.
    """
    layers, height, width, rows, n_phi = codes.shape
    flat = codes.permute(1, 2, 4, 3, 0).reshape(height * width * n_phi, rows * layers).contiguous().numpy()
    padded = np.pad(flat, ((0, 0), (0, -flat.shape[1] % 8))).view(np.uint64)
    factors = np.random.default_rng(1).integers(1 << 63, size=padded.shape[1], dtype=np.uint64) | np.uint64(1)
    keys = (padded * factors).sum(1)
    _, first, own = np.unique(keys, return_index=True, return_inverse=True)
    held = 2 * len(first) * (rows - 1) * layers + 2 * height * width * (n_phi + 1)
    if len(first) > MOST_COLUMNS or 8 * held > 4 * (rows - 1) * flat.size // rows:
        return None
    if not all(np.array_equal(flat[part], flat[first[own[part]]]) for part in _parts(len(flat))):
        return None  # two that differ have one key
    each = flat[first].reshape(-1, rows, layers)
    which = own.reshape(height, width, n_phi).astype(np.uint16)
    return Columns(np.stack([each[:, :-1], each[:, 1:]], -1), np.concatenate([which, which[..., :1]], -1))


def _parts(n: int) -> list[slice]:
    return [slice(k, k + 8192) for k in range(0, n, 8192)]


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
