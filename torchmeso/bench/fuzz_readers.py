"""Damaged files of every family of BTF and picture readers: only our own errors may leave, and memory stays small.

Every family gets as many cases as `bench.fuzz` has in all; bits are turned and pieces moved as there, in the first
bytes (headers) more often than elsewhere. `cut` goes through every length of a file instead of drawing.

Test: tests/bench/test_fuzz_readers.py
"""

import io
import tempfile
import warnings
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from random import Random

import numpy as np
import torch

from torchmeso.bench import fuzz
from torchmeso.bench.fuzz import Kind, damaged_bytes
from torchmeso.bench.suite import Context, Measurement, Row, resident_peak
from torchmeso.compress import dfmf, double_sh, eigen, factored, transform
from torchmeso.compress import rti as rti_fit
from torchmeso.compress.budget import Budget
from torchmeso.compress.dfmf import DfmfOptions
from torchmeso.compress.double_sh import DoubleShOptions
from torchmeso.compress.eigen import EigenOptions
from torchmeso.compress.factored import FactoredOptions
from torchmeso.data import (
    btf_file,
    btfdbb_write,
    eigen_btf,
    exr_stack,
    factored_btf,
    hsh,
    image,
    picture_set,
    ptm,
    rgbe,
    rti,
    sh_btf,
    transform_btf,
    ubo2003,
)
from torchmeso.data.btf import Btf
from torchmeso.data.rti import LightSet
from torchmeso.errors import MesoError
from torchmeso.geometry import hemisphere
from torchmeso.meso import textile
from torchmeso.pipeline import describe
from torchmeso.pipeline.bake import open_model

SET = hemisphere.grid(5, 2, 70)

HEAD = 256
"""Bytes that count as header."""

MEGABYTES = 256
"""That reading damaged files of some kilobytes may take beyond what the process had: libraries and their caches."""

Files = dict[str, tuple[bytes, Callable[[Path], object]]]
"""Name -> content, and what reads it."""


def bonn(folder: Path) -> Files:
    """DFMF and BDI."""
    table = _table()
    options = DfmfOptions(rank=3)
    btfdbb_write.write_dfmf(
        folder / "f.btf", btfdbb_write.header_of(table, "!DFMF08FCR"), options.colour, dfmf.fit(table, options)
    )
    btfdbb_write.write_bdi(folder / "b.btf", table)

    def read(path: Path) -> None:
        found = btf_file.load(path)
        found.rows(0, found.texels[0])

    return {name: ((folder / name).read_bytes(), read) for name in ("f.btf", "b.btf")}


def pictures(folder: Path) -> Files:
    """PNG, JPEG, TIFF, Radiance and OpenEXR."""
    from PIL import Image

    rgb = torch.rand(12, 16, 3, generator=torch.Generator().manual_seed(0))
    codes = image.to_bytes(rgb)
    files: Files = {}
    for name, options in {
        "a.png": {}, "a.jpg": {}, "raw.tif": {}, "lzw.tif": {"compression": "tiff_lzw"},
        "deflate.tif": {"compression": "tiff_deflate"}, "packed.tif": {"compression": "packbits"},
    }.items():  # fmt: skip
        stream = io.BytesIO()
        Image.fromarray(codes).save(stream, {"png": "PNG", "jpg": "JPEG", "tif": "TIFF"}[name[-3:]], **options)
        files[name] = stream.getvalue(), _read_both
    image.write_exr(folder / "a.exr", rgb)
    files["a.exr"] = (folder / "a.exr").read_bytes(), image.read
    files["a.hdr"] = _radiance(codes), rgbe.read
    return files


def _read_both(path: Path) -> None:
    """Read a picture by its content and by its name: two doors."""
    try:
        image.read_codes(path.read_bytes(), path.name)
    finally:
        image.read(path)


def _radiance(codes: np.ndarray) -> bytes:
    """Return a flat Radiance picture of these mantissas."""
    height, width, _ = codes.shape
    pixels = np.concatenate([codes, np.full((height, width, 1), 129, np.uint8)], -1)
    return b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y %d +X %d\n" % (height, width) + pixels.tobytes()


def sets(folder: Path) -> Files:
    """A zip of UBO2003, and the table of an EXR stack beside its pictures."""
    from PIL import Image

    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for k, (tl, pl) in enumerate(((0, 0), (40, 0), (40, 180))):
            png = io.BytesIO()
            Image.new("RGB", (6, 5), (k, 9, 200)).save(png, "PNG")
            archive.writestr(f"T/tv000_pv000/{k:05d} tl{tl:03d} pl{pl:03d} tv000 pv000.png", png.getvalue())
    exr_stack.write(Btf(images=torch.rand(2, 1, 3, 4, 3), lights=hemisphere.from_rings((40,), (2,), (0,)),
                        views=hemisphere.from_rings((0,), (1,), (0,))), folder)  # fmt: skip
    name = exr_stack.TABLE
    return {
        "a.zip": (stream.getvalue(), lambda path: _read_set(ubo2003.survey(path))),
        name: ((folder / name).read_bytes(), lambda path: _read_set(exr_stack.survey(path.parent))),
    }


def _read_set(found: picture_set.PictureSet) -> None:
    picture_set.size(found)
    with found.opened() as read:
        for name in list(found.files.values())[:4]:
            read(name)


def relighting(folder: Path) -> Files:
    """An .lp file, LRGB and RGB polynomials, harmonics."""
    from PIL import Image

    lights = LightSet(files=tuple(folder / f"{k}.png" for k in range(10)), directions=SET.directions())
    for k, file in enumerate(lights.files):
        Image.new("RGB", (5, 4), (20 * k, 90, 7 * k)).save(file)
    rti.write(lights, folder / "a.lp")
    ptm.write(rti_fit.fit_ptm(lights, per_channel=True), folder / "rgb.ptm")
    ptm.write(rti_fit.fit_ptm(lights), folder / "lrgb.ptm")
    hsh.write(rti_fit.fit_hsh(lights, 4), folder / "a.rti")
    readers: dict[str, Callable[[Path], object]] = {
        "a.lp": rti.read,
        "rgb.ptm": ptm.read,
        "lrgb.ptm": ptm.read,
        "a.rti": hsh.read,
    }
    return {name: ((folder / name).read_bytes(), read) for name, read in readers.items()}


def harmonics(folder: Path) -> Files:
    """A run-time model of double SH."""
    path = folder / "a.meso"
    sh_btf.save(double_sh.fit(_table(), DoubleShOptions(light_terms=4, view_terms=4)), path)
    return {"a.meso": (path.read_bytes(), open_model)}


def streams(folder: Path) -> Files:
    """Run-time models that are decoded when opened: transform-coded, adaptive eigen and double SH, factored."""
    table = _table()
    transform_btf.save(transform.fit(table, Budget(psnr=30.0))[0], folder / "transform.meso")
    options = EigenOptions(rank=4, storage="adaptive")
    eigen_btf.save(eigen.fit(table, options), folder / "eigen.meso", coded=True)
    harmonic = double_sh.fit(table, DoubleShOptions(light_terms=4, view_terms=4, storage="adaptive"))
    sh_btf.save(harmonic, folder / "sh.meso", coded=True)

    factored_btf.save(factored.fit(table, FactoredOptions(rank=3, colour="log-y")), folder / "factored.meso")

    def read(path: Path) -> None:
        open_model(path)
        describe.file(path)

    names = "transform.meso", "eigen.meso", "sh.meso", "factored.meso"
    return {name: ((folder / name).read_bytes(), read) for name in names}


def _table() -> Btf:
    return Btf(images=torch.rand(10, 10, 3, 4, 3, generator=torch.Generator().manual_seed(0)), lights=SET, views=SET)


WEAVE_HEAD = '<TexGenModel version="3.0.3"><Textile type="'

YARN = (
    WEAVE_HEAD + 'CTextile"><Domain type="CDomainPlanes"><Plane Normal="1, 0, 0" d="0" />'
    '<Plane Normal="-1, 0, 0" d="-2" />'
    '<Plane Normal="0, 1, 0" d="0" /><Plane Normal="0, -1, 0" d="-2" /></Domain><Yarn index="0">'
    '<Interpolation Periodic="1" type="CInterpolationBezier" /><YarnSection type="CYarnSectionInterpNode" Ramped="0">'
    '<Section type="CSectionPowerEllipse" Width="0.4" Height="0.2" Power="0.5" /><Section type="CSectionRotated" '
    'Angle="0.2"><Section type="CSectionLenticular" Width="0.4" Height="0.2" Distortion="0.01" /></Section>'
    "</YarnSection>"
    '<Repeat value="2, 0, 0" /><Repeat value="0, 1, 0" /><MasterNode index="0" Position="0, 0.5, 0" Up="0, 0, 1" />'
    '<MasterNode index="1" Position="2, 0.5, 0" Tangent="1, 0, 0" Up="0, 0, 1" /></Yarn></Textile></TexGenModel>'
)
PATTERN = (
    WEAVE_HEAD + 'CTextileWeave2D" NumXYarns="1" NumYYarns="1" FabricThickness="0.4"><PatternCell x="0" y="0">'
    '<PatternElement value="1" /><PatternElement value="0" /></PatternCell>'
    '<XYarnData index="0" Width="0.8" Height="0.2" Spacing="1" /><YYarnData index="0" Width="0.8" Height="0.2" '
    'Spacing="1" /></Textile></TexGenModel>'
)


def weaves(folder: Path) -> Files:
    """A yarn through nodes, and a pattern."""

    def read(path: Path) -> None:
        textile.from_tg3(path=str(path), along=4, segments=4)

    return {"yarn.tg3": (YARN.encode(), read), "pattern.tg3": (PATTERN.encode(), read)}


FAMILIES: dict[str, Callable[[Path], Files]] = {
    "bonn": bonn, "pictures": pictures, "sets": sets, "relighting": relighting, "harmonics": harmonics,
    "weaves": weaves,
    "streams": streams,
}  # fmt: skip


def kind(name: str) -> Kind:
    """Return a family as `bench.fuzz` takes it."""

    def prepare(folder: Path) -> Callable[[Random], None]:
        files = FAMILIES[name](folder)

        def case(random: Random) -> None:
            place = random.choice(sorted(files))
            whole, read = files[place]
            if random.random() < 0.6:
                damaged = damaged_bytes(whole[:HEAD], random) + whole[HEAD:]
            else:
                damaged = damaged_bytes(whole, random)
            (folder / place).write_bytes(damaged)
            read(folder / place)

        return case

    return Kind(name, 1.0, prepare)


def cut(name: str, step: int) -> list[str]:
    """Return what left the readers of a family's files, cut off at every `step` bytes, and was none of our errors."""
    found = []
    with tempfile.TemporaryDirectory() as text, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        folder = Path(text)
        for place, (whole, read) in FAMILIES[name](folder).items():
            for length in range(0, len(whole), step):
                (folder / place).write_bytes(whole[:length])
                try:
                    read(folder / place)
                except MesoError:
                    continue
                except Exception as error:
                    found.append(f"{place} of {length} bytes: {type(error).__name__}: {error}")
    return found


def families(context: Context) -> Iterator[Row]:
    """Every family: damaged at random, and cut off at every length."""
    count = fuzz.CASES // 50 if context.quick else fuzz.CASES
    for name in FAMILIES:
        before = resident_peak()
        found = fuzz.strangers(kind(name), count)
        yield Row(
            id=f"reader.{name}.damaged", what=f"of {count} damaged files ({name}), those that another error left",
            value=len(found), unit="cases", better="lower", goal=0, n=count, peer=found[0][:200] if found else None,
        )  # fmt: skip
        yield Row(
            id=f"reader.{name}.memory", what=f"memory that reading them took beyond what the process had ({name})",
            value=max(resident_peak() - before, 0), unit="MB", better="lower", goal=MEGABYTES,
        )  # fmt: skip
        found = cut(name, 1024 if context.quick else 16)
        yield Row(
            id=f"reader.{name}.cut", what=f"files cut off at every {1024 if context.quick else 16} bytes ({name}), "
            "those that another error left",
            value=len(found), unit="cases", better="lower", goal=0, peer=found[0][:200] if found else None,
        )  # fmt: skip


MEASUREMENTS = (Measurement("reader", families),)
