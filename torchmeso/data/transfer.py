"""Macro-scale transfer: which distant light arrives at the vertices of bodies that shadow and light each other.

At a vertex p, light from far away with coefficients e arrives with coefficients M(p) e, both in the world and of the
same degree (precomputed radiance transfer; sloan2002precomputed, section 5). Below the horizon of the vertex M is as if
nothing stood there: no surface reflects light from there, and a field without that edge has less to lose in few
harmonics.

Test: tests/data/test_transfer.py
"""

from dataclasses import dataclass
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from torchmeso.algebra import spherical_harmonics
from torchmeso.data import store
from torchmeso.data.distant_light import DistantLight
from torchmeso.errors import FormatError, ShapeError, check_finite, check_shape


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Transfer:
    """A matrix for every vertex of a scene's objects, one object behind the other.

    Attributes:
        matrices: (V, C, n, n) M; C = 1 where all colours fare alike, else 3.
    """

    matrices: Float[Tensor, "V C n n"]

    def __post_init__(self) -> None:
        """Raise ShapeError unless these are square matrices over harmonics."""
        n = self.matrices.shape[-1]
        check_shape("transfer", self.matrices, (-1, -1, n, n))
        if self.matrices.shape[1] not in (1, 3):
            raise ShapeError(f"transfer: expected 1 or 3 colours, got {self.matrices.shape[1]}")
        spherical_harmonics.degree_of(n)
        check_finite("transfer", self.matrices)

    def arriving(self, coefficients: Float[Tensor, "n 3"]) -> DistantLight:
        """Return the light of `coefficients`, followed to the vertices.

        Raises:
            ShapeError: it has another degree.
        """
        check_shape("distant light", coefficients, (self.matrices.shape[-1], 3))
        e = coefficients.to(self.matrices.dtype)
        each = e.mT.expand(self.matrices.shape[0], 3, -1)
        at = (self.matrices @ each.unsqueeze(-1)).squeeze(-1).mT
        return DistantLight(coefficients=coefficients, at_vertices=at.contiguous())


def save(transfer: Transfer, path: str | Path) -> None:
    """Write a transfer, whole or not at all."""
    store.write_model(path, {"transfer.matrices": transfer.matrices.contiguous()}, {"kind": "transfer"})


def load(path: str | Path) -> Transfer:
    """Return the transfer in a file.

    Raises:
        FormatError: the file is missing, damaged, or holds no transfer.
    """
    model = store.Model(path)
    if model.meta.get("kind") != "transfer":
        raise FormatError(f"{path}: expected a transfer, found {', '.join(model.names()) or 'nothing'}")
    with store.reading(path):
        return Transfer(matrices=model.read("transfer.matrices"))
