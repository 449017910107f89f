"""BTF files by their suffix: raw tables (.btf.zarr) and Bonn's files (.btf), opened and read in bands alike.

Test: tests/data/test_btf_file.py
"""

from pathlib import Path

from torchmeso.data import btf, btfdbb
from torchmeso.data.btf import Bands
from torchmeso.errors import FormatError


def load(path: str | Path) -> Bands:
    """Return the BTF of a file; its values stay on disk until they are read.

    Raises:
        FormatError: the file is missing or damaged, or its suffix is not known.
    """
    name = Path(path).name.lower()
    if name.endswith(".btf"):
        return btfdbb.load(path)
    if name.endswith(".btf.zarr"):
        return btf.load(path)
    raise FormatError(f"{path}: expected a BTF: a raw table (.btf.zarr) or a Bonn file (.btf)")
