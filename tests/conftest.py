"""Fixtures shared by every test."""

import os
from pathlib import Path

import pytest
import torch

from torchmeso.backends import opencl


@pytest.fixture
def rng() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Folder of real inputs; tests that use it skip where it is absent and have a sibling on generated data."""
    folder = Path(os.environ.get("TORCHMESO_DATA", Path(__file__).parents[2] / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip("real inputs are absent: set TORCHMESO_DATA")
    return folder


@pytest.fixture(scope="session")
def device() -> str:
    """Name of the OpenCL device, for tests that need one."""
    chosen = [d.device for d in opencl.list_devices() if d.chosen]
    if not chosen:
        pytest.skip("no OpenCL platform")
    return chosen[0]
