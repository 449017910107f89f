"""Maps that relight a flat object, from a set of pictures under known lights (.lp): PTM and HSH.

Test: tests/pipeline/test_relight.py
"""

from pathlib import Path
from typing import Literal

from torchmeso.compress import rti as fits
from torchmeso.data import hsh, ptm, rti
from torchmeso.errors import ConfigError

SUFFIX = {"ptm": ".ptm", "hsh": ".rti"}


def fit(
    path: str | Path,
    out: str | Path,
    *,
    method: Literal["ptm", "hsh"],
    terms: int | None = None,
    per_channel: bool = False,
) -> None:
    """Write the map of the pictures that `path` (.lp) names.

    Args:
        path: the .lp file; its pictures are JPEG, PNG or TIFF.
        out: .ptm of ptm, .rti of hsh.
        method: six polynomials, or hemispherical harmonics.
        terms: of hsh: 4, 9 or 16; none = 9.
        per_channel: of ptm: a polynomial for each channel (RGB) instead of one and a colour (LRGB).

    Raises:
        ConfigError: the names do not fit the method, it has no such dial, or the lights cannot tell its terms apart.
        FormatError: the set is missing or damaged.
        StorageError: the place cannot be written to.
    """
    if Path(path).suffix.lower() != ".lp":
        raise ConfigError(f"{path}: expected a set of pictures under known lights (.lp) for --method {method}")
    if Path(out).suffix.lower() != SUFFIX[method]:
        raise ConfigError(f"{out}: expected a name that ends in {SUFFIX[method]} for --method {method}")
    if method == "ptm":
        if terms is not None:
            raise ConfigError("compress: --method ptm has no --terms: there are always six")
        ptm.write(fits.fit_ptm(rti.read(path), per_channel=per_channel), out)
        return
    if per_channel:
        raise ConfigError("compress: --method hsh has no --per-channel: channels are always apart")
    hsh.write(fits.fit_hsh(rti.read(path), 9 if terms is None else terms), out)
