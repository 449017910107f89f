"""Every tolerance of the suite, beside the error that was measured; rule: measured x 5 to 10.

Before one is loosened, the test's data are repaired.
"""

FLOAT64 = {"rtol": 1e-12, "atol": 1e-12}
"""Different orders of the same float64 sums; measured 1e-14."""

FLOAT32 = {"rtol": 1e-5, "atol": 1e-6}
"""float32 against float64 on the same inputs; measured 3e-7 to 1e-6."""

OPENCL_DEPTH = {"rtol": 1e-4}
"""Depth of a fragment, OpenCL in float32 against torch; measured 1.5e-5 at the near plane, 2e-6 elsewhere."""

BONN_PARTS = {"rtol": 1e-5, "atol": 1e-5}
"""Parts of a factored float32 table of values to 40 against the whole; measured 1.4e-6 (sums in another order)."""

SUBSPACE = 5e-5
"""Relative error of a streamed factorisation above the least one; measured 6.6e-6 (spectrum 1/k), 2e-8 (1/k^3)."""
