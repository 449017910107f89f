"""Distant light in spherical harmonics: what frames in the frequency domain are lit by.

L(w) = sum_j e_j y_j(w), world. Where a scene's own bodies shadow each other, what arrives differs from place to place:
then e_j stands at every vertex, and is interpolated between them.

Test: tests/data/test_distant_light.py
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.algebra import spherical_harmonics
from torchmeso.errors import ShapeError, check_finite, check_shape


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class DistantLight:
    """Radiance that arrives from all directions.

    Attributes:
        coefficients: (n, 3) linear RGB, far from everything.
        at_vertices: (V, n, 3) at the vertices of a scene's objects, one object behind the other; None = everywhere the
            same.
    """

    coefficients: Float[Tensor, "n 3"]
    at_vertices: Float[Tensor, "V n 3"] | None = None

    def __post_init__(self) -> None:
        """Raise ShapeError unless these are coefficients up to some degree."""
        n = len(self.coefficients)
        check_shape("distant light", self.coefficients, (-1, 3))
        check_finite("distant light", self.coefficients)
        spherical_harmonics.degree_of(n)
        if self.at_vertices is not None:
            check_shape("distant light at vertices", self.at_vertices, (-1, n, 3))
            check_finite("distant light at vertices", self.at_vertices)

    @property
    def degree(self) -> int:
        """Highest l."""
        return spherical_harmonics.degree_of(len(self.coefficients))

    def at(self, vertices: int) -> Float[Tensor, "V n 3"]:
        """Return what arrives at each of `vertices`; further ones than are known see all the light.

        Raises:
            ShapeError: light is known at more vertices than there are.
        """
        known = (
            self.coefficients.new_zeros(0, *self.coefficients.shape) if self.at_vertices is None else self.at_vertices
        )
        if len(known) > vertices:
            raise ShapeError(
                f"distant light at vertices: expected at most {vertices} of this scene, got {len(known)}; make it anew"
            )
        rest = self.coefficients.expand(vertices - len(known), -1, -1)
        return torch.cat([known, rest])
