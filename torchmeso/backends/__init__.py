"""Where an operation runs: `torch` (the formula: any dtype, gradients) or `opencl` (float32, fast)."""

from typing import Literal

Backend = Literal["torch", "opencl"]
BackendChoice = Literal["auto", "torch", "opencl"]
