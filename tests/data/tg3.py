"""A writer of TexGen's .tg3 files that shares nothing with the reader."""

import xml.etree.ElementTree as ET

ELLIPSE = {"type": "CSectionEllipse", "Width": "0.3", "Height": "0.1"}


def triple(values):
    return ", ".join(repr(float(x)) for x in values)


def section(attributes, children=()):
    """An element of a section; children are sections or (tag, attributes)."""
    found = ET.Element("Section", {k: str(v) for k, v in attributes.items()})
    for child in children:
        found.append(child if isinstance(child, ET.Element) else ET.Element(*child))
    return found


def yarn(nodes, *, kind="CInterpolationCubic", periodic=1, sections=None, repeats=(), tangents=None, ups=None):
    """A yarn through `nodes`; `sections` is the YarnSection element."""
    found = ET.Element("Yarn", {"index": "0", "NumSlaveNodes": "25", "NumSectionPoints": "20", "NeedsBuilding": "7"})
    ET.SubElement(found, "Interpolation", {"Periodic": str(periodic), "type": kind})
    found.append(constant(section(ELLIPSE)) if sections is None else sections)
    for repeat in repeats:
        ET.SubElement(found, "Repeat", {"value": triple(repeat)})
    for k, node in enumerate(nodes):
        about = {"index": str(k), "Position": triple(node)}
        about["Tangent"] = triple((0, 0, 0) if tangents is None else tangents[k])
        about["Up"] = triple((0, 0, 1) if ups is None else ups[k])
        ET.SubElement(found, "MasterNode", about)
    return found


def constant(one):
    found = ET.Element("YarnSection", {"type": "CYarnSectionConstant"})
    found.append(one)
    return found


def several(kind, sections, places=None, **more):
    """Sections at nodes, or at shares of the length, each in an element that tells its place."""
    found = ET.Element("YarnSection", {"type": kind, **{k: str(v) for k, v in more.items()}})
    for k, one in enumerate(sections):
        if places is None:
            found.append(one)
        else:
            ET.SubElement(found, "PositionSection", {"t": repr(places[k])}).append(one)
    return found


def textile(yarns, box=None):
    """The content of a file; `box` is ((x, y) low, (x, y) high)."""
    top = ET.Element("TexGenModel", {"version": "3.0.3"})
    found = ET.SubElement(top, "Textile", {"name": "a", "type": "CTextile", "NeedsBuilding": "0"})
    if box is not None:
        domain = ET.SubElement(found, "Domain", {"type": "CDomainPlanes"})
        for k in (0, 1):
            normal = [0.0, 0.0, 0.0]
            normal[k] = 1.0
            ET.SubElement(domain, "Plane", {"Normal": triple(normal), "d": repr(float(box[0][k]))})
            normal[k] = -1.0
            ET.SubElement(domain, "Plane", {"Normal": triple(normal), "d": repr(-float(box[1][k]))})
        ET.SubElement(domain, "Plane", {"Normal": "0, 0, 1", "d": "-9"})
    for one in yarns:
        found.append(one)
    return b'<?xml version="1.0" ?>\n' + ET.tostring(top)


def weave(over, *, width=0.8, height=0.1, spacing=1.0, thickness=0.3, kind="CTextileWeave2D"):
    """The content of a file with a pattern: over[j][i] whether yarn j along x lies over yarn i along y."""
    top = ET.Element("TexGenModel", {"version": "3.0.3"})
    about = {"name": "w", "type": kind, "NeedsBuilding": "1", "GapSize": "0", "FabricThickness": repr(thickness)}
    about |= {"NumXYarns": str(len(over)), "NumYYarns": str(len(over[0]))}
    found = ET.SubElement(top, "Textile", about)
    for j, row in enumerate(over):
        for i, above in enumerate(row):
            cell = ET.SubElement(found, "PatternCell", {"x": str(i), "y": str(j)})
            for value in ("1", "0") if above else ("0", "1"):
                ET.SubElement(cell, "PatternElement", {"value": value})
    sizes = {"Width": repr(width), "Height": repr(height), "Spacing": repr(spacing)}
    for tag, n in (("XYarnData", len(over)), ("YYarnData", len(over[0]))):
        for k in range(n):
            ET.SubElement(found, tag, {"index": str(k), **sizes})
    return ET.tostring(top)


def straight(axis=0, *, period=1.0, z=0.0, **more):
    """A straight yarn through the middle of a tile of side `period`, that repeats by it."""
    end = [period / 2] * 3
    end[2] = z
    first, last = list(end), list(end)
    first[axis], last[axis] = 0.0, period
    return yarn([first, end, last], repeats=((period, 0, 0), (0, period, 0)), **more)
