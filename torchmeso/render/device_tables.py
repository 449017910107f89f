"""Materials as the kernels read them: BTFs, MDFs and pictures packed into one buffer of tables.

A table is uploaded once, however many materials share it and however often the scene changes around it. All stand in
one buffer, each on a block of 64 bytes, because a kernel's arguments cannot be a list.

Kernels: kernels_cl/data/*.clh          Test: tests/render/test_device_tables.py
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int, Int32, UInt8, UInt16
from torch import Tensor

from torchmeso.algebra import spherical_harmonics
from torchmeso.backends import opencl
from torchmeso.data.eigen_btf import EigenBtf
from torchmeso.data.mdf import Mdf
from torchmeso.data.quilting_map import QuiltingMap
from torchmeso.data.relief import CODES as RELIEF_CODES
from torchmeso.data.sh_btf import ShBtf
from torchmeso.data.sh_pca_btf import ShPcaBtf
from torchmeso.data.textured import Textured
from torchmeso.errors import BackendError
from torchmeso.geometry import hemisphere, triangulation
from torchmeso.geometry.hemisphere import DirectionSet
from torchmeso.render.scene import Material

BLOCK, GROUP, MOST_TERMS = 64, 4, 64
"""Bytes that tables are aligned to, components that stand in one vector, and the most harmonics of light or view."""

MOST_DISTANT = 7
"""Degree of distant light that kernels read."""

PCA_GROUP = 8
"""Components of an SH + PCA BTF that stand in one vector."""

Reflecting = EigenBtf | ShBtf | ShPcaBtf | Textured
"""What kernels read."""

REFLECTANCE = np.dtype(
    [(name, "i4") for name in ("there", "height", "width", "groups", "codes", "light_rings", "light_count")]
    + [(name, "i4") for name in ("view_rings", "view_count", "maps", "weights", "scale", "offset", "ambient")]
    + [(name, "i4") for name in ("ambient_scale", "ambient_offset", "levels", "level_count")]
    + [("last_cosine", "f4"), ("albedo", "f4", 3)]
    + [(name, "i4") for name in ("normals", "normal_levels", "normal_level_count")]
    + [(name, "i4") for name in ("light_steps", "light_degree", "view_steps", "view_degree")]
    + [("view_last_cosine", "f4"), ("view_edges", "i4"), ("quilt", "i4")]
)
EIGEN, TEXTURED, HARMONIC, HARMONIC_PCA = 1, 2, 3, 4
"""What stands in a reflectance's `there`; 0 = a plain colour."""

MDF = np.dtype(
    [(name, "i4") for name in ("there", "height", "width", "rings", "ring_count", "delta", "missing")]
    + [(name, "i4") for name in ("relief_height", "relief_width", "relief", "hole")]
    + [("h", "f4"), ("delta_max", "f4"), ("plateau", "i4"), ("quilt", "i4"), ("pad", "i4")]
)

QUILT = np.dtype(
    [(name, "i4") for name in ("height", "width", "source_height", "source_width")]
    + [("across", "f4"), ("down", "f4"), ("per_across", "f4"), ("per_down", "f4"), ("pad", "i4", 8)]
)

ADDRESSES = {
    REFLECTANCE: (
        "light_rings",
        "view_rings",
        "maps",
        "weights",
        "scale",
        "offset",
        "ambient",
        "ambient_scale",
        "ambient_offset",
        "levels",
        "normals",
        "normal_levels",
        "light_steps",
        "view_steps",
        "view_edges",
        "quilt",
    ),
    MDF: ("rings", "delta", "missing", "relief", "plateau", "hole", "quilt"),
}
"""Fields that say on which block a table begins; -1 = there is none."""


class DeviceMaterials(NamedTuple):
    """The materials of a scene on the device.

    Attributes:
        tables: everything that is looked up.
        mdfs: (surface,) see `MDF`.
        reflectances: (surface,) see `REFLECTANCE`.
        textured: whether any surface has a mesostructure.
        harmonic: whether any surface has a double-SH or SH + PCA BTF.
        quilted: whether any surface has a quilting map.
        parts: the BTFs and MDFs in `tables`, by identity.
        packed: how many of them were uploaded, not taken over.
    """

    tables: "opencl.Buffer"
    mdfs: "opencl.Buffer"
    reflectances: "opencl.Buffer"
    textured: bool
    harmonic: bool
    quilted: bool
    parts: "dict[tuple[int, bool], _Part]"
    packed: int


class _Part(NamedTuple):
    """A BTF or an MDF in the tables."""

    source: object  # kept, so that nothing else can take its identity
    first: int  # block
    blocks: int
    record: np.ndarray  # (1,), addresses counted from `first`


def upload_materials(
    materials: Sequence[Material], *, silhouettes: bool, ambient: bool, before: DeviceMaterials | None = None
) -> DeviceMaterials:
    """Return the materials of a scene's surfaces on the device.

    Args:
        materials: of each surface.
        silhouettes: whether the mesostructure has depth; without, MDFs are not read.
        ambient: whether the ambient term is needed.
        before: what stands on the device already; BTFs and MDFs that are the same objects are taken over from there.

    Raises:
        BackendError: there is no device, or a material is of a kind that kernels do not read.
    """
    wanted: dict[tuple[int, bool], Reflecting | Mdf] = {}
    for m in materials:
        if m.btf is not None:
            wanted[id(m.btf), ambient] = _readable(m.btf)
        if m.mdf is not None and silhouettes:
            wanted[id(m.mdf), False] = _readable_mdf(m.mdf)
    there = before.parts if before is not None else {}
    new = {key: source for key, source in wanted.items() if key not in there}
    if before is not None and not new:
        tables, parts = before.tables, there
    else:
        tables, parts = _join({key: there[key] for key in wanted if key in there}, new, before)

    reflectances, mdfs = np.zeros(len(materials), REFLECTANCE), np.zeros(len(materials), MDF)
    for i, m in enumerate(materials):
        if m.btf is not None:
            reflectances[i] = _placed(parts[id(m.btf), ambient])
        reflectances[i]["albedo"] = m.albedo
        if m.mdf is not None and silhouettes:
            mdfs[i] = _placed(parts[id(m.mdf), False])
    textured = bool(mdfs["there"].any())
    harmonic = bool(np.isin(reflectances["there"], (HARMONIC, HARMONIC_PCA)).any())
    quilted = any(getattr(source, "quilting", None) is not None for source in wanted.values())
    return DeviceMaterials(
        tables, opencl.upload(mdfs), opencl.upload(reflectances), textured, harmonic, quilted, parts, len(new)
    )


def _join(
    kept: "dict[tuple[int, bool], _Part]",
    new: "dict[tuple[int, bool], Reflecting | Mdf]",
    before: DeviceMaterials | None,
) -> "tuple[opencl.Buffer, dict[tuple[int, bool], _Part]]":
    """Return a buffer with the parts that are `kept`, copied on the device, and behind them the `new` ones."""
    parts, copies, blocks = {}, [], 0
    for key, part in kept.items():
        copies.append((part.first * BLOCK, blocks * BLOCK, part.blocks * BLOCK))
        parts[key] = part._replace(first=blocks)
        blocks += part.blocks
    arrays = []
    for key, source in new.items():
        pool = Pool()
        if isinstance(source, EigenBtf):
            record = _reflectance(pool, source, ambient=key[1])
        elif isinstance(source, ShBtf):
            record = _harmonics(pool, source)
        elif isinstance(source, ShPcaBtf):
            record = _harmonic_components(pool, source)
        else:
            record = _pictures(pool, source) if isinstance(source, Textured) else _mdf(pool, source)
        record["quilt"] = -1 if source.quilting is None else add_quilt(pool, source.quilting)
        arrays.append(pool.joined())
        parts[key] = _Part(source, blocks, len(arrays[-1]) // BLOCK, record)
        blocks += parts[key].blocks
    fresh = np.concatenate(arrays) if arrays else np.zeros(BLOCK, np.uint8)
    if not copies or before is None:
        return opencl.upload(fresh), parts
    tables = opencl.allocate(blocks * BLOCK)
    for source, target, size in copies:
        opencl.copy(before.tables, tables, source, target, size)
    opencl.store(fresh, tables, blocks * BLOCK - len(fresh))
    return tables, parts


def _placed(part: _Part) -> np.void:
    """Return a part's record with addresses counted from the beginning of all tables."""
    record = part.record.copy()
    for name in ADDRESSES[record.dtype]:
        record[name] += np.where(record[name] >= 0, part.first, 0)
    return record[0]


def _readable(btf: object) -> Reflecting:
    if not isinstance(btf, Reflecting):
        raise BackendError(
            f"opencl: expected an eigen, double-SH or SH + PCA BTF, got {type(btf).__name__}; use the torch backend"
        )
    most = max(btf.terms) if isinstance(btf, ShBtf) else btf.terms if isinstance(btf, ShPcaBtf) else 0
    if most > MOST_TERMS:
        raise BackendError(
            f"opencl: expected at most {MOST_TERMS} coefficients of light or view, got {most}; use the torch backend"
        )
    if isinstance(btf, ShPcaBtf) and btf.rank > 3 * MOST_TERMS:
        raise BackendError(
            f"opencl: expected at most {3 * MOST_TERMS} components, got {btf.rank}; use the torch backend"
        )
    return btf


def _readable_mdf(mdf: object) -> Mdf:
    if not isinstance(mdf, Mdf) or mdf.delta.dtype != torch.uint8:
        kind = f"{mdf.delta.dtype}" if isinstance(mdf, Mdf) else type(mdf).__name__
        raise BackendError(f"opencl: expected an MDF of 8 bits, got {kind}; use the torch backend")
    return mdf


def _reflectance(pool: "Pool", btf: EigenBtf, *, ambient: bool) -> np.ndarray:
    record = np.zeros(1, REFLECTANCE)
    groups = -(-btf.rank // GROUP)
    codes = btf.maps.dtype == torch.uint8
    height, width = btf.texels
    maps = [hemisphere.with_pole(x if codes else x.float(), btf.lights).flatten(0, 2) for x in btf.levels]
    views, fine = btf.fine_weights
    weights = hemisphere.with_pole(fine.float(), views)
    scale, offset = in_groups(btf.scale.float()[None])[0], in_groups(btf.offset.float()[None])[0]
    by_channel = in_groups(weights[:, :, None].expand(-1, -1, 3))
    by_channel[:, :, 3] = _bounds(btf, weights)
    record["there"], record["height"], record["width"], record["groups"] = EIGEN, height, width, groups
    record["codes"] = codes
    record["light_rings"], record["light_count"] = pool.add(ring_records(btf.lights)), ring_count(btf.lights)
    record["view_rings"], record["view_count"] = pool.add(ring_records(views)), ring_count(views)
    record["maps"] = pool.add(in_groups(torch.cat(maps)).numpy())
    record["levels"], record["level_count"] = pool.add(_level_records(btf, [len(x) for x in maps])), len(maps)
    record["weights"], record["scale"], record["offset"] = (pool.add(x.numpy()) for x in (by_channel, scale, offset))
    if ambient:
        values, unit, zero = _as_codes(torch.cat([x.flatten(0, 1) for x in btf.ambient_maps]).float(), codes=codes)
        record["ambient"] = pool.add(in_groups(values).numpy())
        record["ambient_scale"], record["ambient_offset"] = (pool.add(in_groups(x).numpy()) for x in (unit, zero))
    record["last_cosine"] = math.cos(btf.lights.last)
    return record


def _harmonics(pool: "Pool", btf: ShBtf) -> np.ndarray:
    record = np.zeros(1, REFLECTANCE)
    k_l, k_v = btf.terms
    groups = -(-k_v // GROUP)
    codes = btf.maps.dtype == torch.uint8

    def grouped(x: Tensor) -> Tensor:
        """Return (k_l, k_v, ..., 3) as (..., k_l, group, 16): four coefficients of the view, rgb and nothing."""
        padded = torch.nn.functional.pad(x.movedim((0, 1), (-3, -2)), (0, 1, 0, groups * GROUP - k_v))
        return padded.unflatten(-2, (groups, GROUP)).flatten(-2)

    levels = [grouped(x if codes else x.float()).flatten(0, 1) for x in btf.levels]
    first = np.cumsum([0, *(len(x) for x in levels[:-1])]) * k_l * groups
    records = np.stack([first, 0 * first, *np.array([x.shape[2:4] for x in btf.levels]).T], 1).astype(np.int32)
    record["there"], record["height"], record["width"] = HARMONIC, *btf.texels
    record["groups"], record["codes"] = groups, codes
    record["maps"] = pool.add(torch.cat(levels).numpy())
    record["levels"], record["level_count"] = pool.add(records), len(levels)
    record["scale"] = pool.add(grouped(btf.scale.float()).contiguous().numpy())
    record["offset"] = pool.add(grouped(btf.offset.float()).contiguous().numpy())
    record["ambient"] = pool.add(btf.everywhere.float().numpy())
    for side, terms in (("light", k_l), ("view", k_v)):
        degree = spherical_harmonics.degree_of(terms)
        record[f"{side}_steps"] = pool.add(spherical_harmonics.recurrence(degree))
        record[f"{side}_degree"] = degree
    record["last_cosine"], record["view_last_cosine"] = math.cos(btf.lights.last), math.cos(btf.views.last)
    record["light_rings"] = pool.add(by_order(btf.against(MOST_DISTANT)))
    return record


def _harmonic_components(pool: "Pool", btf: ShPcaBtf) -> np.ndarray:
    record = np.zeros(1, REFLECTANCE)
    codes = btf.maps.dtype == torch.uint8
    more = -btf.rank % PCA_GROUP
    levels = [hemisphere.with_pole(x if codes else x.float(), btf.views).flatten(0, 2) for x in btf.levels]
    rows = [len(x) for x in levels]
    first = np.cumsum([0, *rows[:-1]]) * ((btf.rank + more) // PCA_GROUP)
    records = np.stack([first, 0 * first, *np.array([x.shape[1:3] for x in btf.levels]).T], 1).astype(np.int32)
    scaled = btf.basis.double() * btf.scale.double()[:, None, None]
    rest = torch.einsum("k,kmc->mc", btf.offset.double(), btf.basis.double())

    def in_fours(x: Tensor) -> np.ndarray:
        """Return (..., k_l, 3) as (..., four, 16): four coefficients of rgb and nothing, float32."""
        padded = torch.nn.functional.pad(x, (0, 1, 0, -btf.terms % GROUP))
        return padded.unflatten(-2, (-1, GROUP)).flatten(-2).float().numpy()

    record["there"], record["height"], record["width"] = HARMONIC_PCA, *btf.texels
    record["groups"], record["codes"] = (btf.rank + more) // PCA_GROUP, codes
    record["maps"] = pool.add(torch.nn.functional.pad(torch.cat(levels), (0, more)).numpy())
    record["levels"], record["level_count"] = pool.add(records), len(levels)
    record["weights"] = pool.add(in_fours(torch.nn.functional.pad(scaled, (0, 0, 0, 0, 0, more))))
    record["offset"] = pool.add(in_fours(rest))
    strips, edges = _triangles(btf.views)
    record["view_rings"], record["view_count"], record["view_edges"] = pool.add(strips), len(strips), pool.add(edges)
    record["ambient"] = pool.add(btf.everywhere.float().numpy())
    degree = spherical_harmonics.degree_of(btf.terms)
    record["light_steps"], record["light_degree"] = pool.add(spherical_harmonics.recurrence(degree)), degree
    record["last_cosine"] = math.cos(btf.lights.last)
    record["light_rings"] = pool.add(by_order(btf.against(MOST_DISTANT)))
    return record


def by_order(A: Float[Tensor, "k_l n"]) -> Float32[np.ndarray, "k_l degree"]:
    """Return a matrix of harmonics over harmonics as kernels read it: of each row what has its own m, by degree."""
    degree = spherical_harmonics.degree_of(A.shape[1])
    rows = np.zeros((len(A), degree + 1), np.float32)
    for l in range(spherical_harmonics.degree_of(len(A)) + 1):
        for m in range(-l, l + 1):
            rows[l * l + l + m, abs(m) :] = [float(A[l * l + l + m, k * k + k + m]) for k in range(abs(m), degree + 1)]
    return rows


def _triangles(directions: DirectionSet) -> tuple[Float32[np.ndarray, "strip 4"], Float32[np.ndarray, "edge 4"]]:
    """Return the strips between rings, and their cross edges."""
    table = triangulation.strips(directions)
    room = torch.full_like(table.triangles, table.phi.shape[1])
    strips = torch.stack([table.theta[:-1], table.theta.diff(), table.triangles, room], -1)
    return strips.float().numpy(), torch.cat([table.phi, table.node], -1).flatten(0, 1).float().numpy()


def _as_codes(x: Float[Tensor, "n rank 3"], *, codes: bool) -> tuple[Tensor, Tensor, Tensor]:
    """Return `x` as bytes, where `codes`, and its scale and offset: an eighth of a percent of its range is enough.

    What is read four times per pixel is then a quarter as long, like the maps themselves.
    """
    if not codes:
        return x, torch.ones_like(x[0]), torch.zeros_like(x[0])
    low, high = x.amin(0), x.amax(0)
    scale = ((high - low) / 255).clamp(min=1e-30)
    return ((x - low) / scale).round().clamp(0, 255).to(torch.uint8), scale, low


def _level_records(btf: EigenBtf, rows: list[int]) -> Int32[np.ndarray, "level 4"]:
    """Return first vectors in the maps and in the ambient maps, height and width of each level."""
    groups = -(-btf.rank // GROUP)
    sizes = [tuple(x.shape[1:3]) for x in btf.levels]
    first = groups * np.cumsum([0, *rows[:-1]])
    ambient = groups * np.cumsum([0, *(h * w for h, w in sizes[:-1])])
    return np.stack([first, ambient, *np.array(sizes).T], 1).astype(np.int32)


def _pictures(pool: "Pool", looks: Textured) -> np.ndarray:
    record = np.zeros(1, REFLECTANCE)
    record["there"], record["normals"] = TEXTURED, -1
    record["maps"], record["levels"], record["level_count"] = _levels_of_four(pool, looks.albedo_levels)
    if looks.normal_levels is not None:
        found = _levels_of_four(pool, looks.normal_levels)
        record["normals"], record["normal_levels"], record["normal_level_count"] = found
    return record


def add_quilt(pool: "Pool", quilting: QuiltingMap) -> int:
    """Return where a quilting map begins: its sizes on a block of their own, then row << 16 | column of each texel."""
    record = np.zeros(1, QUILT)
    (record["height"], record["width"]), (record["source_height"], record["source_width"]) = (
        quilting.texels, quilting.source,
    )  # fmt: skip
    record["across"], record["down"] = quilting.periods
    record["per_across"], record["per_down"] = (1 / period for period in quilting.periods)
    index, columns = quilting.index.numpy(), quilting.source[1]
    first = pool.add(record)
    pool.add((index // columns << 16 | index % columns).astype(np.int32))
    return first


def _levels_of_four(pool: "Pool", levels: list[Float[Tensor, "_ _ 3"]]) -> tuple[int, int, int]:
    """Return where a pyramid's pictures begin, one behind the other, and where their sizes stand; and their number."""
    sizes = [tuple(x.shape[:2]) for x in levels]
    first = np.cumsum([0, *(h * w for h, w in sizes[:-1])])
    pixels = torch.cat([x.flatten(0, 1) for x in levels]).float()
    records = np.stack([first, first, *np.array(sizes).T], 1).astype(np.int32)
    return pool.add(torch.nn.functional.pad(pixels, (0, 1)).numpy()), pool.add(records), len(levels)


def _bounds(btf: EigenBtf, weights: Float[Tensor, "view rank"]) -> Float[Tensor, "view group"]:
    """Return the most each group of components can add to T, for the weights of a view."""
    codes = btf.maps.flatten(0, 2)
    low, high = codes.amin(0).float(), codes.amax(0).float()
    ends = torch.stack([btf.offset + btf.scale * low, btf.offset + btf.scale * high]).abs()
    each = weights.abs() * ends.amax((0, 2)).float()
    padded = torch.zeros(len(each), -(-btf.rank // GROUP) * GROUP)
    padded[:, : btf.rank] = each
    return padded.reshape(len(each), -1, GROUP).sum(-1)


def in_groups(x: Tensor) -> Tensor:
    """Return (..., rank, 3) as (..., group, 16): four components of rgb and nothing in a vector."""
    *batch, rank, _ = x.shape
    groups = -(-rank // GROUP)
    padded = torch.zeros(*batch, groups * GROUP, 4, dtype=x.dtype)
    padded[..., :rank, :3] = x
    return padded.reshape(*batch, groups, 16)


def _mdf(pool: "Pool", mdf: Mdf) -> np.ndarray:
    record = np.zeros(1, MDF)
    delta = hemisphere.with_pole(mdf.delta, mdf.directions)
    paired = torch.stack([delta, delta[_next_in_ring(mdf.directions)]], -1)
    relief = mdf.relief
    record["there"], record["height"], record["width"] = 1, *mdf.texels
    record["rings"], record["ring_count"] = pool.add(ring_records(mdf.directions)), ring_count(mdf.directions)
    record["delta"] = pool.add(paired.numpy())
    missing = None if mdf.no_hit is None else hemisphere.with_pole(mdf.no_hit.float(), mdf.directions)
    record["missing"] = -1 if missing is None else pool.add(missing.numpy())
    record["relief_height"], record["relief_width"] = relief.drop.shape
    codes = (relief.drop / relief.h * RELIEF_CODES).round().numpy().astype(np.uint16)
    record["relief"] = pool.add(np.concatenate([codes, codes[:, :1]], 1))
    record["plateau"] = pool.add(_plateaus(codes, (mdf.delta == 0).all(0).numpy()))
    record["hole"] = -1 if relief.hole is None else pool.add(relief.hole.float().numpy())
    record["h"], record["delta_max"] = mdf.h, mdf.delta_max
    return record


def _plateaus(codes: UInt16[np.ndarray, "H4 W4"], top: Bool[np.ndarray, "H W"]) -> UInt8[np.ndarray, "H W"]:
    """Return whether a texel and two all around it lie at the reference plane, in the relief and in every view."""
    height, width = top.shape
    flat = top & (codes.reshape(height, codes.shape[0] // height, width, -1) == 0).all((1, 3))
    for axis in (0, 1):
        flat = np.logical_and.reduce([np.roll(flat, k, axis) for k in range(-2, 3)])
    return flat.astype(np.uint8)


def ring_records(directions: DirectionSet) -> Float[np.ndarray, "ring 8"]:
    """Return theta, size, phi0, first node, and whether all rings but the pole are alike."""
    rings = hemisphere.rings(directions)
    table = np.zeros((len(rings.theta), 8), np.float32)
    table[:, :4] = torch.stack([x.float() for x in rings], -1).numpy()
    outer = table[1:]
    steps = np.arange(len(outer)) * outer[:1, 1]
    table[:, 4] = bool((outer[:, 1:3] == outer[:1, 1:3]).all() and (outer[:, 3] == outer[:1, 3] + steps).all())
    return table


def _next_in_ring(directions: DirectionSet) -> Int[Tensor, "node"]:
    """Return, for each node, the next one of its ring."""
    rings = hemisphere.rings(directions)
    following = torch.zeros(directions.n_nodes, dtype=torch.long)
    for size, offset in zip(rings.size.tolist(), rings.offset.tolist(), strict=True):
        following[offset : offset + size] = offset + (torch.arange(size) + 1) % size
    return following


def ring_count(directions: DirectionSet) -> int:
    """Return the number of rings, a pole that a table needs among them."""
    return len(hemisphere.rings(directions).theta)


class Pool:
    """Arrays one behind the other, each on a block of its own."""

    def __init__(self) -> None:
        self._arrays: list[np.ndarray] = []
        self._blocks = 0

    def add(self, x: np.ndarray) -> int:
        """Return the block `x` will begin on."""
        first = self._blocks
        self._arrays.append(x)
        self._blocks += -(-x.nbytes // BLOCK)
        return first

    def joined(self) -> np.ndarray:
        """Return all arrays as bytes."""
        whole, at = np.zeros(max(self._blocks, 1) * BLOCK, np.uint8), 0
        for x in self._arrays:
            whole[at : at + x.nbytes] = np.ascontiguousarray(x).reshape(-1).view(np.uint8)
            at += -(-x.nbytes // BLOCK) * BLOCK
        self._arrays.clear()
        return whole
