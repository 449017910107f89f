"""BTFs as a folder of OpenEXR pictures with a table of their directions: what any program can read and write.

`directions.csv` has one line per picture, after a line of names: file, theta_i_deg, phi_i_deg (towards the light),
theta_o_deg, phi_o_deg (towards the viewer), in degrees; columns may stand in any order, further ones are not read.
Files lie below the folder. Pictures hold T as linear RGB, row 0 on top. Directions have to stand on rings
(`geometry.gaps.meant`); the slab depth of a mesostructure has no place here.

Test: tests/data/test_exr_stack.py
"""

import csv
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from torchmeso.data import image, store
from torchmeso.data.btf import Btf
from torchmeso.data.picture_set import PictureSet, Reader, by_place
from torchmeso.errors import FormatError
from torchmeso.geometry import gaps

TABLE = "directions.csv"
COLUMNS = ("file", "theta_i_deg", "phi_i_deg", "theta_o_deg", "phi_o_deg")


def write(btf: Btf, folder: str | Path, *, progress: Callable[[float], None] = lambda share: None) -> None:
    """Write `btf` as the folder `folder`, a view at a time; a folder that stood there is replaced when all is written.

    Raises:
        FormatError: the table on disk is damaged.
        StorageError: the disk is full, or the place cannot be written to.
    """
    folder = Path(folder)
    beside = folder.with_name(folder.name + ".part")
    lights, views = gaps.angles_deg(btf.lights), gaps.angles_deg(btf.views)
    lines: list[tuple[str, ...]] = [COLUMNS]
    with store.writing(folder):
        if beside.exists():  # of a run that was stopped
            shutil.rmtree(beside)
        beside.mkdir(parents=True)
        for v, view in enumerate(views):
            for l, picture in enumerate(btf.seen_from(v)):
                name = f"v{v:03d}_l{l:03d}.exr"
                image.write_exr(beside / name, picture)
                lines.append((name, *(f"{angle:.10g}" for angle in (*lights[l], *view))))
            progress((v + 1) / len(views))
        with (beside / TABLE).open("w", newline="") as file:
            csv.writer(file).writerows(lines)
        store.replace_directory(beside, folder)


def survey(folder: str | Path) -> PictureSet:
    """Return which pictures there are; none is read.

    Raises:
        FormatError: the table is missing or damaged, names a picture that is not there or outside of the folder, or
            its directions are no rings.
    """
    folder = Path(folder)
    angles = _read_table(folder / TABLE)
    sizes = {}
    for name in angles:
        path = folder / name
        with store.reading(folder / TABLE):  # names may hold what no path can
            if not path.resolve().is_relative_to(folder.resolve()) or not path.is_file():
                raise FormatError(f"{folder / TABLE}: names the picture '{name}', of which there is none in the folder")
            sizes[name] = [path.stat().st_size, path.stat().st_mtime_ns]
    lights = gaps.meant({light for light, _ in angles.values()}, f"{folder}: lights")
    views = gaps.meant({view for _, view in angles.values()}, f"{folder}: views")

    @contextmanager
    def opened() -> Iterator[Reader]:
        yield lambda name: image.read(folder / name)

    return PictureSet(
        name=str(folder),
        lights=lights,
        views=views,
        files=by_place(str(folder), angles, lights, views),
        encoding="linear",
        key=store.content_hash(str(folder.resolve()), sorted((*x, angles[name]) for name, x in sizes.items())),
        opened=opened,
    )


def _read_table(path: Path) -> dict[str, tuple[gaps.Angles, gaps.Angles]]:
    """Return (theta, phi) of light and view in degrees by file name."""
    if not path.is_file():
        raise FormatError(f"{path}: expected a table of directions, found none; its columns are {', '.join(COLUMNS)}")
    angles = {}
    with store.reading(path), path.open(newline="") as file:
        for row in csv.DictReader(file, strict=True):
            lacking = [column for column in COLUMNS if not row.get(column)]
            if lacking:
                raise FormatError(f"{path}: expected the columns {', '.join(COLUMNS)}, found no '{lacking[0]}'")
            light, view = ((float(row[f"theta_{x}_deg"]), float(row[f"phi_{x}_deg"])) for x in "io")
            angles[row["file"]] = gaps.turned(light), gaps.turned(view)
    if not angles:
        raise FormatError(f"{path}: expected a line for each picture, found none")
    return angles
