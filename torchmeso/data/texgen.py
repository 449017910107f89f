"""TexGen's .tg3 files: textiles in XML, as yarns with nodes and sections or as a pattern that is built first.

    TexGenModel / Textile (the first one is read)
        Domain / Plane Normal="x, y, z" d="..."            what is shown: Normal . p >= d
        Yarn / Interpolation type, Periodic;  YarnSection type / Section ...;  Repeat value;
             / MasterNode index, Position, Tangent, Up
        type="CTextileWeave2D": PatternCell x, y / PatternElement value (0 = the yarn along x, 1 = the one along y, the
             lowest first), XYarnData and YYarnData Width, Height, Spacing; FabricThickness

Only what is in the file is used: slave nodes and meshed sections are not read, and sections are not bent around
crossing yarns (`Refine`). A file without yarns holds a weave that has to be built (`data.weave_pattern`).

Test: tests/data/test_texgen.py
"""

import math
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.data import weave_pattern, xml_tree
from torchmeso.data.textile import FAR, Textile, Yarn
from torchmeso.data.weave_pattern import WeavePattern
from torchmeso.data.xml_tree import Element
from torchmeso.data.yarn_section import Ellipse, Hybrid, Lenticular, Polygon, Rectangle, Section, Turned
from torchmeso.errors import FormatError, MesoError

PATHS: dict[str, Literal["linear", "cubic", "bezier"]] = {
    "CInterpolationLinear": "linear",
    "CInterpolationCubic": "cubic",
    "CInterpolationBezier": "bezier",
}
CONSTANT, AT_NODES, AT_PLACES = "CYarnSectionConstant", "CYarnSectionInterpNode", "CYarnSectionInterpPosition"


def read(path: str | Path) -> Textile:
    """Return the first textile of a .tg3 file.

    Raises:
        FormatError: the file is missing, damaged, of another kind, or holds what is not read.
    """
    top = xml_tree.read(path)
    try:
        return _textile(top)
    except MesoError as error:
        raise FormatError(f"{path}: {' '.join(str(error).split())}") from error


def _textile(top: Element) -> Textile:
    if top.tag != "TexGenModel":
        raise FormatError(f"expected a TexGenModel, got <{top.tag[:40]}>")
    found = top.first("Textile")
    if found is None:
        raise FormatError("expected a Textile, found none")
    yarns = tuple(_yarn(x) for x in found.all("Yarn"))
    if yarns:
        return Textile(yarns=yarns, domain=_domain(found.first("Domain")))
    kind = found.values.get("type", "")
    if kind != "CTextileWeave2D":
        raise FormatError(f"expected yarns or a CTextileWeave2D, got a textile without yarns of the type '{kind[:40]}'")
    return weave_pattern.yarns(_pattern(found))


def _domain(found: Element | None) -> Float[Tensor, "2 2"] | None:
    """Return the box that planes across x and y enclose; None where they do not."""
    low, high = [-math.inf] * 2, [math.inf] * 2
    for plane in found.all("Plane") if found is not None else ():
        normal, d = _vector(plane, "Normal"), _number(plane, "d")
        for k in (0, 1):
            if abs(normal[k]) > 1e-9 and abs(normal[1 - k]) + abs(normal[2]) < 1e-9 * abs(normal[k]):
                if normal[k] > 0:
                    low[k] = max(low[k], d / normal[k])
                else:
                    high[k] = min(high[k], d / normal[k])
    box = torch.tensor([low, high], dtype=torch.float64)
    return box if bool(box.isfinite().all()) else None


def _yarn(x: Element) -> Yarn:
    path = x.first("Interpolation")
    section = x.first("YarnSection")
    nodes = sorted(x.all("MasterNode"), key=lambda n: _number(n, "index", 0))
    if path is None or section is None or not nodes:
        raise FormatError(f"yarn in line {x.line}: expected Interpolation, YarnSection and MasterNodes")
    kind = path.values.get("type", "")
    if kind not in PATHS:
        raise FormatError(f"yarn in line {x.line}: expected a path of {', '.join(PATHS)}, got '{kind[:40]}'")
    sections, places = _sections(section)
    try:
        return Yarn(
            nodes=_stack([_vector(n, "Position") for n in nodes]),
            tangents=_stack([_vector(n, "Tangent", (0.0, 0.0, 0.0)) for n in nodes]),
            ups=_stack([_vector(n, "Up", (0.0, 0.0, 1.0)) for n in nodes]),
            path=PATHS[kind],
            periodic=_number(path, "Periodic", 1) != 0,
            sections=sections,
            places=places,
            ramped=_number(section, "Ramped", 1) != 0,
            repeats=_stack([_vector(r, "value") for r in x.all("Repeat")]),
        )
    except FormatError as error:
        raise FormatError(f"line {x.line}: {error}") from error


def _sections(x: Element) -> tuple[tuple[Section, ...], tuple[float, ...] | None]:
    """Return the sections of a yarn, and the shares of its length they hold at where they are given."""
    kind = x.values.get("type", "")
    if kind not in (CONSTANT, AT_NODES, AT_PLACES):
        raise FormatError(
            f"sections in line {x.line}: expected {CONSTANT}, {AT_NODES} or {AT_PLACES}, got '{kind[:40]}'"
        )
    if _number(x, "Polar", 0):
        raise FormatError(f"sections in line {x.line}: sections that go over into each other by angle are not read")
    # A section stands alone or in an element that tells its place.
    holders = [c for c in x.children if c.tag == "Section" or c.first("Section") is not None]
    sections = tuple(_section(h if h.tag == "Section" else _child(h)) for h in holders)
    if kind == CONSTANT and len(sections) != 1:
        raise FormatError(f"sections in line {x.line}: expected one constant section, got {len(sections)}")
    if kind != AT_PLACES:
        return sections, None
    return sections, tuple(_number(h, "t" if "t" in h.values else "Position") for h in holders)


def _child(x: Element) -> Element:
    found = x.first("Section")
    if found is None:
        raise FormatError(f"line {x.line}: expected a Section in <{x.tag[:40]}>")
    return found


def _section(x: Element) -> Section:
    kind = x.values.get("type", "")
    try:
        if kind in ("CSectionEllipse", "CSectionPowerEllipse"):
            power = _number(x, "Power") if kind == "CSectionPowerEllipse" else 1.0
            return Ellipse(width=_number(x, "Width"), height=_number(x, "Height"), power=power)
        if kind == "CSectionLenticular":
            width, height = _number(x, "Width"), _number(x, "Height")
            return Lenticular(width=width, height=height, distortion=_number(x, "Distortion", 0))
        if kind == "CSectionRectangle":
            return Rectangle(width=_number(x, "Width"), height=_number(x, "Height"))
        if kind == "CSectionPolygon":
            return Polygon(points=_stack([_vector(p, "value", size=2) for p in x.all("PolygonPoint")], 2))
        if kind == "CSectionHybrid":
            ends = tuple(_number(d, "value") for d in x.all("Division"))
            return Hybrid(ends=ends, sections=tuple(_section(s) for s in x.all("Section")))
        if kind == "CSectionRotated":
            return Turned(section=_section(_child(x)), angle=_number(x, "Angle"))
        if kind == "CSectionScaled":
            sx, sy = _vector(x, "Scale", size=2)
            return Turned(section=_section(_child(x)), scale=(sx, sy))
    except FormatError as error:
        raise FormatError(f"section in line {x.line}: {error}") from error
    raise FormatError(
        f"section in line {x.line}: expected CSectionEllipse, PowerEllipse, Lenticular, Rectangle, Polygon, Hybrid, "
        f"Rotated or Scaled, got '{kind[:40]}'"
    )


def _pattern(x: Element) -> WeavePattern:
    """Return the weave of a CTextileWeave2D; every cell has to be there."""
    sizes = {tag: sorted(x.all(tag), key=lambda y: _number(y, "index", 0)) for tag in ("XYarnData", "YYarnData")}
    along, across = (
        _stack([(_number(y, "Width"), _number(y, "Height"), _number(y, "Spacing")) for y in sizes[tag]])
        for tag in ("XYarnData", "YYarnData")
    )
    for name, found in (("NumXYarns", along), ("NumYYarns", across)):
        if _number(x, name) != len(found):
            raise FormatError(f"weave: {name} says {x.values[name][:20]} yarns, the file has data of {len(found)}")
    over = {}
    for cell in x.all("PatternCell"):
        stack = [_number(e, "value") for e in cell.all("PatternElement")]
        if stack not in ([0, 1], [1, 0]):
            raise FormatError(
                f"line {cell.line}: expected a crossing of one yarn along x (0) and one along y (1), got {stack[:4]}"
            )
        over[_number(cell, "y"), _number(cell, "x")] = stack == [1, 0]
    fits = len(over) == len(along) * len(across)
    if not fits or not all((j, i) in over for j in range(len(along)) for i in range(len(across))):
        raise FormatError(f"weave: expected a cell for each of {len(along)} x {len(across)} crossings, got {len(over)}")
    return WeavePattern(
        x_over=torch.tensor([[over[j, i] for i in range(len(across))] for j in range(len(along))]).bool(),
        x_yarns=along,
        y_yarns=across,
        thickness=_number(x, "FabricThickness"),
    )


def _number(x: Element, name: str, default: float | None = None) -> float:
    """Return an attribute as a finite number within `FAR`."""
    numbers = _numbers(x, name, 1) if default is None or name in x.values else [default]
    return numbers[0]


def _vector(x: Element, name: str, default: tuple[float, ...] | None = None, size: int = 3) -> tuple[float, ...]:
    return tuple(_numbers(x, name, size)) if default is None or name in x.values else default


def _numbers(x: Element, name: str, size: int) -> list[float]:
    text = x.values.get(name)
    if text is None:
        raise FormatError(f"line {x.line}: <{x.tag[:40]}> lacks {name}")
    try:
        found = [float(part) for part in text.split(",", size)]
    except ValueError:
        found = []
    if len(found) != size or not all(abs(value) <= FAR for value in found):
        raise FormatError(f"line {x.line}: {name}: expected {size} numbers within {FAR:g}, got '{text[:40]}'")
    return found


def _stack(rows: list, size: int = 3) -> Float[Tensor, "n _"]:
    return torch.tensor(rows, dtype=torch.float64).reshape(-1, size)
