"""Distant light as the kernels read it, and eigen BTFs over harmonics of the light.

Eigen maps stand for single directions of light. Under light from all around each map is summed once, over directions,
into one map per harmonic (`data.eigen_btf.hats_against`): frames then read them as those of a double-SH BTF whose views
are weighted. Where maps are codes, these are too.

Kernels: kernels_cl/render/environment.clh          Test: tests/render/test_environment.py
"""

import math
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from torchmeso.algebra import spherical_harmonics
from torchmeso.backends import opencl
from torchmeso.data.distant_light import DistantLight
from torchmeso.data.eigen_btf import EigenBtf
from torchmeso.errors import BackendError
from torchmeso.geometry import hemisphere
from torchmeso.render.device_tables import (
    BLOCK,
    GROUP,
    HARMONIC,
    MOST_DISTANT,
    MOST_TERMS,
    REFLECTANCE,
    Pool,
    add_quilt,
    by_order,
    in_groups,
    ring_count,
    ring_records,
)
from torchmeso.render.scene import Scene, World


class DeviceDistant(NamedTuple):
    """Distant light on the device.

    Attributes:
        light: what it was made from.
        degree: of the light.
        field: whether light was followed to the vertices.
        sources: the BTFs of all surfaces.
        arguments: of a frame's kernel.
    """

    light: DistantLight
    degree: int
    field: bool
    sources: list[object]
    arguments: "tuple[opencl.Buffer, ...]"


def upload_distant(scene: Scene, world: World, before: DeviceDistant | None = None) -> DeviceDistant | None:
    """Return a scene's distant light on the device; the BTFs' side stays where it was before.

    Raises:
        BackendError: the degree of the light or the rank of an eigen BTF is too high for the kernels.
    """
    light = scene.distant
    if light is None:
        return None
    if light.degree > MOST_DISTANT:
        raise BackendError(
            f"opencl: expected distant light up to degree {MOST_DISTANT}, got {light.degree}; use the torch backend"
        )
    sources: list[object] = [m.btf for m in scene.surfaces]
    if before is not None and len(sources) == len(before.sources) and all(map(_same, sources, before.sources)):
        tables = before.arguments[2:]
    else:
        tables = _tables(sources)
    field = np.zeros(16, np.float32)
    if light.at_vertices is not None:
        field = torch.nn.functional.pad(light.at(len(world.vertices)).float(), (0, 1)).contiguous().numpy()
    arguments = opencl.upload(light_table(light)), opencl.upload(field), *tables
    return DeviceDistant(light, light.degree, light.at_vertices is not None, sources, arguments)


def _same(a: object, b: object) -> bool:
    return a is b


def light_table(light: DistantLight) -> Float32[np.ndarray, "number"]:
    """Return the cosine's harmonics, the recurrence, the light's coefficients and J; see environment.clh."""
    n = len(light.coefficients)
    table = np.zeros(384 + 680, np.float32)
    table[:n] = spherical_harmonics.cosine_lobe(light.degree).numpy()
    steps = spherical_harmonics.recurrence(light.degree)
    table[64 : 64 + len(steps)] = steps
    table[128 : 128 + 4 * n] = torch.nn.functional.pad(light.coefficients.float(), (0, 1)).flatten().numpy()
    blocks = spherical_harmonics.quarter_turn_blocks(light.degree)
    table[384 : 384 + len(blocks)] = blocks
    return table


def _tables(sources: list[object]) -> "tuple[opencl.Buffer, opencl.Buffer]":
    records, pool = np.zeros(max(len(sources), 1), REFLECTANCE), Pool()
    made: dict[int, np.ndarray] = {}
    for i, btf in enumerate(sources):
        if isinstance(btf, EigenBtf):
            if id(btf) not in made:
                made[id(btf)] = _over_light(pool, btf)
            records[i] = made[id(btf)][0]
    whole = pool.joined()
    return opencl.upload(whole if len(whole) else np.zeros(BLOCK, np.uint8)), opencl.upload(records)


def _over_light(pool: Pool, btf: EigenBtf) -> np.ndarray:
    """Return an eigen BTF as sums over harmonics of the light, components in place of harmonics of the view."""
    if btf.rank > MOST_TERMS:
        raise BackendError(f"opencl: expected at most {MOST_TERMS} components, got {btf.rank}; use the torch backend")
    record = np.zeros(1, REFLECTANCE)
    groups, codes = -(-btf.rank // GROUP), btf.maps.dtype == torch.uint8
    H = btf.against(MOST_DISTANT).float()

    def summed(maps: Tensor) -> Tensor:
        E = btf.offset.float() + btf.scale.float() * maps.float()
        return torch.einsum("lj,lhwkc->hwjkc", H, E)

    levels = [summed(x) for x in btf.levels]
    scale, offset = torch.ones_like(levels[0][0, 0]), torch.zeros_like(levels[0][0, 0])
    if codes:
        low, high = levels[0].amin((0, 1)), levels[0].amax((0, 1))
        scale, offset = ((high - low) / 255).clamp(min=1e-30), low
        levels = [((x - offset) / scale).round().clamp(0, 255).to(torch.uint8) for x in levels]
    views, fine = btf.fine_weights
    weights = hemisphere.with_pole(fine.float(), views)
    texels = [int(math.prod(x.shape[:2])) for x in levels]
    first = np.cumsum([0, *texels[:-1]]) * (len(H[0]) * groups)
    rows = np.stack([first, 0 * first, *np.array([x.shape[:2] for x in levels]).T], 1).astype(np.int32)
    record["there"], record["height"], record["width"] = HARMONIC, *btf.texels
    record["groups"], record["codes"], record["light_degree"] = groups, codes, MOST_DISTANT
    record["view_rings"], record["view_count"] = pool.add(ring_records(views)), ring_count(views)
    record["weights"] = pool.add(in_groups(weights[:, :, None].expand(-1, -1, 3)).contiguous().numpy())
    record["maps"] = pool.add(in_groups(torch.cat([x.flatten(0, 1) for x in levels])).numpy())
    record["levels"], record["level_count"] = pool.add(rows), len(levels)
    record["scale"], record["offset"] = (pool.add(in_groups(x).contiguous().numpy()) for x in (scale, offset))
    record["light_rings"] = pool.add(by_order(torch.eye(H.shape[1])))
    record["quilt"] = -1 if btf.quilting is None else add_quilt(pool, btf.quilting)
    return record
