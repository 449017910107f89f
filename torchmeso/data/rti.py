r"""RTI picture sets: one view of a flat object, one picture per light, and a file of light positions (.lp).

The first line of an .lp file is the number of lights; each further one is "file x y z", the direction towards the
light with x right, y up and z to the camera, of any length. File names may hold spaces and may come from Windows
("C:\dome\a 1.jpg"): a path that is not there from the .lp file's own folder is looked for by its last part.
Lights need not stand on rings, so these sets are no `Btf`; `compress.rti` fits PTM (`data.ptm`) and HSH (`data.hsh`).

Test: tests/data/test_rti.py
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from torchmeso.data import image, store
from torchmeso.errors import FormatError, ShapeError, check_shape
from torchmeso.geometry.directions import normalize

FADE_DEG = 2.0
"""Above the horizon: no dome has lights so low, and T is 0 at the horizon itself."""


@dataclass(frozen=True, eq=False, kw_only=True)
class LightSet:
    """Pictures of one view under several lights.

    Attributes:
        files: a picture per light: JPEG, PNG or TIFF.
        directions: (light, 3) unit, towards the light.
    """

    files: tuple[Path, ...]
    directions: Float[Tensor, "light 3"]

    def __post_init__(self) -> None:
        """Raise ShapeError unless there is a direction per picture."""
        check_shape("lights.directions", self.directions, (len(self.files), 3))
        if not self.files:
            raise ShapeError("lights.files: expected at least one picture, got none")

    def pictures(self) -> Iterator[UInt8[Tensor, "H W 3"]]:
        """Yield the sRGB codes of each picture, in order; one is in memory at a time.

        Raises:
            FormatError: a picture is damaged, or of another size than the first one.
        """
        size = None
        for file in self.files:
            with store.reading(file):
                picture = image.read_codes(file.read_bytes(), str(file))
            size = size or picture.shape
            if picture.shape != size:
                raise FormatError(
                    f"{file}: expected {size[1]} x {size[0]} pixels as in the first picture, "
                    f"got {picture.shape[1]} x {picture.shape[0]}"
                )
            yield picture


def fade(wi: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 1"]:
    """Return the factor of a fitted map near the horizon, where its polynomials do not end at 0: C0, 0 below it."""
    return (wi[..., 2:] / math.sin(math.radians(FADE_DEG))).clamp(0, 1)


def read(path: str | Path) -> LightSet:
    """Return the set that an .lp file names; no picture is read.

    Raises:
        FormatError: the file is missing or damaged, or a picture is not there.
    """
    path = Path(path)
    if not path.is_file():
        raise FormatError(f"{path}: expected a file of light positions (.lp), found none; check the path")
    with store.reading(path):
        lines = path.read_bytes().decode("utf-8-sig", errors="surrogateescape").splitlines()
        lines = [line for line in map(str.strip, lines) if line]
        count = int(lines[0]) if lines and lines[0].isascii() and lines[0].isdecimal() else 0
        if count < 1 or count != len(lines) - 1:
            raise FormatError(
                f"{path}: expected the number of lights in the first line and as many lines after it, "
                f"got '{lines[0][:20] if lines else ''}' and {max(len(lines) - 1, 0)} lines; the copy may be incomplete"
            )
        names, positions = [], torch.empty(count, 3, dtype=torch.float64)
        for k, line in enumerate(lines[1:]):
            name, x, y, z = line.rsplit(maxsplit=3)
            names.append(name.strip("\"'"))
            positions[k] = torch.tensor([float(x), float(y), float(z)])
    length = positions.norm(dim=1)
    if not bool((length.isfinite() & (length > 0)).all()):
        raise FormatError(f"{path}: expected directions other than 0 0 0, got one without a length")
    return LightSet(
        files=tuple(_find(path.parent, name) for name in names),
        directions=normalize(positions).float(),
    )


def write(lights: LightSet, path: str | Path) -> None:
    """Write an .lp file; pictures in or below its folder are named from there, others by their whole path.

    Raises:
        StorageError: the place cannot be written to.
    """
    folder = Path(path).resolve().parent
    lines = [str(len(lights.files))]
    for file, direction in zip(lights.files, lights.directions.tolist(), strict=True):
        whole = file.resolve()
        name = whole.relative_to(folder) if whole.is_relative_to(folder) else whole
        lines.append(f"{name} {' '.join(f'{x:.9g}' for x in direction)}")
    with store.replacing(path) as beside:
        beside.write_text("\n".join(lines) + "\n", encoding="utf-8", errors="surrogateescape")


def _find(folder: Path, name: str) -> Path:
    parts = name.replace("\\", "/")
    for path in (folder / parts, folder / parts.rpartition("/")[2]):
        with store.reading(folder):
            if path.is_file():
                return path
    raise FormatError(f"{folder}: expected the picture '{name}' of the .lp file, found none")
