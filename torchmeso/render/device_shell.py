"""Shells as the kernels read them: tetrahedra, each in one line of the cache, and prisms.

Kernels: kernels_cl/render/gdm_trace.clh          Test: tests/render/test_device_shell.py
"""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from torchmeso.backends import opencl
from torchmeso.errors import BackendError
from torchmeso.geometry.mesh import Mesh
from torchmeso.geometry.prisms import is_thin
from torchmeso.geometry.shell import OUTWARD, Shell

CORNER = np.dtype([("uv", "f4", 2), ("vertex", "i4"), ("ahead", "i4")])
"""A corner of a tetrahedron, four of them in one line of the cache; what stands in `ahead` says the kernel."""

PRISM = np.dtype(
    [("corner", "i4", 3), ("pad", "i4")]
    + [(name, "f4", 2) for name in ("at", "first", "second")]
    + [("base", "f4"), ("rest", "f4", 5)]
)

MOST_TETS = (1 << 22) - 1
"""As many as a code can name that is not one of the boundary's."""


class DeviceShells(NamedTuple):
    """Shells on the device, one behind the other.

    Attributes:
        tets: four of each, see `CORNER`.
        vertices: float4: position, and 0 at the bottom of the shell and 1 at its top.
        prisms: see `PRISM`.
    """

    tets: "opencl.Buffer"
    vertices: "opencl.Buffer"
    prisms: "opencl.Buffer"


def upload_shells(shells: list[tuple[Shell, Mesh, int]]) -> DeviceShells:
    """Return shells on the device.

    Args:
        shells: each with the mesh it stands on, and the first of that mesh's vertices among all vertex records.

    Raises:
        BackendError: there is no device, or the shells have more tetrahedra than kernels can count.
    """
    count = sum(len(s.tets) for s, _, _ in shells)
    if count > MOST_TETS:
        raise BackendError(f"opencl: expected at most {MOST_TETS // 3} prisms, got {count // 3}; use the torch backend")
    tets, vertices, prisms = [np.zeros((0, 4), CORNER)], [np.zeros((0, 4), np.float32)], [np.zeros(0, PRISM)]
    first_tet = first_vertex = 0
    for shell, mesh, first_record in shells:
        tets.append(tet_records(shell, first_tet, first_vertex))
        level = (torch.arange(len(shell.vertices)) % 2)[:, None]
        vertices.append(torch.cat([shell.vertices.float(), level], 1).numpy())
        prisms.append(prism_records(shell, mesh, first_record))
        first_tet += len(shell.tets)
        first_vertex += len(shell.vertices)
    return DeviceShells(*(opencl.upload(np.concatenate(x)) for x in (tets, vertices, prisms)))


def tet_records(shell: Shell, first_tet: int = 0, first_vertex: int = 0) -> np.ndarray:
    """Return the tetrahedra of a shell that stands behind others, (T, 4); see `CORNER`."""
    records = np.zeros((len(shell.tets), 4), CORNER)
    records["vertex"] = (shell.tets + first_vertex).numpy()
    records["uv"] = shell.uvz[..., :2].float().numpy()
    records["ahead"] = _ahead(shell, first_tet).numpy()
    return records


def _ahead(shell: Shell, first_tet: int) -> Int[Tensor, "T 4"]:
    inner = shell.neighbour >= 0
    tet, corner = inner.nonzero().unbind(1)
    other = shell.neighbour[tet, corner]
    face = OUTWARD[corner]
    shared = shell.tets[tet].gather(1, face)
    there = (shell.tets[other][:, None] == shared[..., None]).int().argmax(-1)  # (n, 3) corners of the other
    behind = 6 - there.sum(1)
    corners = (there << (2 * face)).sum(1) | (behind << (2 * corner))
    crossing = (other // 3 != tet // 3).long() << 8
    places = shell.uvz[tet[:, None], face], shell.uvz[other[:, None], there]
    seam = (places[0] != places[1]).any(-1).any(-1).long() << 9
    codes = shell.neighbour.clone()
    code = (other + first_tet) << 10 | seam | crossing | corners
    codes[tet, corner] = torch.where(code >= 1 << 31, code - (1 << 32), code)  # all 32 bits are used
    return codes


def prism_records(shell: Shell, mesh: Mesh, first_record: int = 0) -> np.ndarray:
    """Return how hits in each prism are shaded; see `PRISM`."""
    corner = mesh.faces[shell.face]
    uv = mesh.uv.double()[corner]
    e1, e2 = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    area = e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0]
    flat = is_thin(uv)
    inverse = torch.where(flat, 0, 1 / torch.where(flat, 1, area))[:, None]
    records = np.zeros(len(shell.face), PRISM)
    records["corner"] = (corner + first_record).numpy()
    records["at"] = uv[:, 0].numpy()
    records["first"] = (torch.stack([e2[:, 1], -e2[:, 0]], 1) * inverse).numpy()
    records["second"] = (torch.stack([-e1[:, 1], e1[:, 0]], 1) * inverse).numpy()
    records["base"] = torch.where(flat, 1 / 3, 0).numpy()
    return records
