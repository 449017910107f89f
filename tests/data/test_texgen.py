"""Weaves written by another writer, real ones, and what is no weave."""

import random

import pytest
import torch

from tests.data import tg3
from torchmeso.data import texgen
from torchmeso.data.yarn_section import Ellipse, Hybrid, Lenticular, Polygon, Rectangle, Turned
from torchmeso.errors import FormatError

NODES = [(0, 0.5, 0), (0.5, 0.5, 0.2), (1, 0.5, 0)]


def read(tmp_path, content):
    (tmp_path / "a.tg3").write_bytes(content)
    return texgen.read(tmp_path / "a.tg3")


def test_a_yarn_comes_back(tmp_path):
    written = tg3.yarn(
        NODES, kind="CInterpolationBezier", periodic=0, repeats=[(1, 0, 0), (0, 2, 0)],
        tangents=[(1, 0, 0)] * 3, ups=[(0, 1, 1)] * 3,
    )  # fmt: skip
    found = read(tmp_path, tg3.textile([written], ((0, -1), (1, 1))))
    assert found.domain.tolist() == [[0, -1], [1, 1]]
    yarn = found.yarns[0]
    assert torch.equal(yarn.nodes, torch.tensor(NODES, dtype=torch.float64))
    assert yarn.tangents.tolist() == [[1, 0, 0]] * 3
    assert yarn.ups.tolist() == [[0, 1, 1]] * 3
    assert (yarn.path, yarn.periodic) == ("bezier", False)
    assert yarn.repeats.tolist() == [[1, 0, 0], [0, 2, 0]]
    assert yarn.sections == (Ellipse(width=0.3, height=0.1),)


def test_nodes_go_by_their_index_and_defaults_fill_in(tmp_path):
    written = tg3.yarn(NODES, kind="CInterpolationLinear")
    nodes = written.findall("MasterNode")
    for node in nodes:
        written.remove(node)
        del node.attrib["Tangent"], node.attrib["Up"]
    for node in reversed(nodes):
        written.append(node)
    del written.find("Interpolation").attrib["Periodic"]
    yarn = read(tmp_path, tg3.textile([written])).yarns[0]
    assert torch.equal(yarn.nodes, torch.tensor(NODES, dtype=torch.float64))
    assert yarn.ups.tolist() == [[0, 0, 1]] * 3
    assert yarn.periodic
    assert yarn.repeats.shape == (0, 3)


SIZE = {"Width": 0.3, "Height": 0.1}
SECTIONS = [
    (tg3.section({"type": "CSectionPowerEllipse", "Power": 0.4, **SIZE}), Ellipse(width=0.3, height=0.1, power=0.4)),
    (
        tg3.section({"type": "CSectionLenticular", "Distortion": 0.02, **SIZE}),
        Lenticular(width=0.3, height=0.1, distortion=0.02),
    ),
    (tg3.section({"type": "CSectionRectangle", **SIZE}), Rectangle(width=0.3, height=0.1)),
    (
        tg3.section({"type": "CSectionRotated", "Angle": 0.5}, [tg3.section({"type": "CSectionRectangle", **SIZE})]),
        Turned(section=Rectangle(width=0.3, height=0.1), angle=0.5),
    ),
    (
        tg3.section({"type": "CSectionScaled", "Scale": "2, 0.5"}, [tg3.section(tg3.ELLIPSE)]),
        Turned(section=Ellipse(width=0.3, height=0.1), scale=(2.0, 0.5)),
    ),
    (
        tg3.section(
            {"type": "CSectionHybrid"},
            [("Division", {"value": "0.5"}), ("Division", {"value": "1"}), tg3.section(tg3.ELLIPSE),
             tg3.section({"type": "CSectionRectangle", **SIZE})],
        ),
        Hybrid(ends=(0.5, 1.0), sections=(Ellipse(width=0.3, height=0.1), Rectangle(width=0.3, height=0.1))),
    ),
]  # fmt: skip


@pytest.mark.parametrize(("written", "expected"), SECTIONS, ids=lambda x: type(x).__name__)
def test_kinds_of_sections(tmp_path, written, expected):
    found = read(tmp_path, tg3.textile([tg3.yarn(NODES, sections=tg3.constant(written))]))
    assert found.yarns[0].sections == (expected,)


def test_polygons(tmp_path):
    corners = [("PolygonPoint", {"value": v}) for v in ("0, 0", "1, 0", "0, 1")]
    written = tg3.constant(tg3.section({"type": "CSectionPolygon"}, corners))
    section = read(tmp_path, tg3.textile([tg3.yarn(NODES, sections=written)])).yarns[0].sections[0]
    assert isinstance(section, Polygon)
    assert section.points.tolist() == [[0, 0], [1, 0], [0, 1]]


def test_several_sections_at_nodes_and_at_places(tmp_path):
    kinds = [tg3.section({**tg3.ELLIPSE, "Width": w}) for w in (0.1, 0.2, 0.3)]
    at_nodes = tg3.yarn(NODES, sections=tg3.several("CYarnSectionInterpNode", kinds, Ramped=0))
    placed = tg3.yarn(NODES, sections=tg3.several("CYarnSectionInterpPosition", kinds[:2], [0.25, 0.75], Ramped=1))
    a, b = read(tmp_path, tg3.textile([at_nodes, placed])).yarns
    assert [s.width for s in a.sections] == [0.1, 0.2, 0.3]
    assert (a.places, a.ramped) == (None, False)
    assert (b.places, b.ramped) == ((0.25, 0.75), True)


def test_a_pattern_is_built(tmp_path):
    found = read(tmp_path, tg3.weave([[1, 0, 0], [0, 1, 1]]))
    assert len(found.yarns) == 5
    assert found.domain.tolist() == [[0, 0], [3, 2]]
    first, across = found.yarns[0].nodes[:, 2], found.yarns[2].nodes[:, 2]
    assert (first > 0).tolist() == [True, False, False, True]
    assert (across > 0).tolist() == [False, True, False]


def test_real_yarns(data_dir):
    found = texgen.read(data_dir / "volume" / "polyester.tg3")
    assert len(found.yarns) == 4
    assert found.domain.tolist() == [[0, 0], [0.44, 0.44]]
    assert {y.path for y in found.yarns} == {"cubic"}
    assert found.yarns[0].nodes[1].tolist() == [0.22, 0, 0.05]


def test_a_real_pattern(data_dir):
    found = texgen.read(data_dir / "volume" / "2dweave.tg3")
    assert len(found.yarns) == 8
    over = torch.stack([y.nodes[:-1, 2] > 0 for y in found.yarns[:4]])
    assert torch.equal(over, torch.eye(4).bool().flip(0))
    assert torch.equal(torch.stack([y.nodes[:-1, 2] > 0 for y in found.yarns[4:]]), ~over.T)


def swap(content, *pairs):
    for old, new in pairs:
        assert old.encode() in content, old
        content = content.replace(old.encode(), new.encode(), 1)
    return content


YARN, WEAVE = tg3.textile([tg3.yarn(NODES)]), tg3.weave([[1, 0], [0, 1]])
POLAR = tg3.textile(
    [tg3.yarn(NODES, sections=tg3.several("CYarnSectionInterpNode", [tg3.section(tg3.ELLIPSE)], Polar=1))]
)
PLACED = tg3.yarn(NODES, sections=tg3.several("CYarnSectionInterpPosition", [tg3.section(tg3.ELLIPSE)] * 2, [0.5, 0.2]))
ROTATED = tg3.textile([tg3.yarn(NODES, sections=tg3.constant(tg3.section({"type": "CSectionRotated", "Angle": 1})))])


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (b"<a/>", "expected a TexGenModel, got <a>"),
        (b"<TexGenModel/>", "expected a Textile, found none"),
        (b"<!DOCTYPE x><TexGenModel/>", "without a document type"),
        (b'<TexGenModel><Textile type="CTextile"/></TexGenModel>', "textile without yarns of the type 'CTextile'"),
        (
            swap(YARN, ("CInterpolationCubic", "CInterpolationAdjust")),
            "expected a path of .*, got 'CInterpolationAdjust'",
        ),
        (swap(YARN, ("<Interpolation", "<Interpol")), "expected Interpolation, YarnSection and MasterNodes"),
        (
            swap(YARN, ("CYarnSectionConstant", "CYarnSectionOdd")),
            "expected CYarnSectionConstant, .*, got 'CYarnSectionOdd'",
        ),
        (
            swap(YARN, ("CSectionEllipse", "CSectionBezier")),
            "section in line 2: expected CSectionEllipse, .* got 'CSectionBez",
        ),
        (swap(YARN, ('Width="0.3"', 'Width="0"')), "line 2: ellipse: expected a width above 0"),
        (swap(YARN, ('Width="0.3"', "")), "<Section> lacks Width"),
        (swap(YARN, ("0.5, 0.2", "0.5, nan")), "Position: expected 3 numbers within 1e.06, got '0.5, 0.5, nan'"),
        (swap(YARN, ("0.5, 0.5, 0.2", "0.5, 0.2")), "Position: expected 3 numbers"),
        (swap(YARN, ("0.5, 0.5, 0.2", "0.5, 0.5, 0.2, 1")), "Position: expected 3 numbers"),
        (swap(YARN, ("0.0, 0.5, 0.0", "0.5, 0.5, 0.2")), "no two in a row at one place, got 3"),
        (swap(YARN, ("CInterpolationCubic", "a&#10;b")), "got 'a b'"),
        (POLAR, "sections that go over into each other by angle are not read"),
        (tg3.textile([PLACED]), "expected rising places"),
        (ROTATED, "expected a Section in <Section>"),
        (swap(YARN, ("<Section", "<Sect")), "expected one constant section, got 0"),
        (swap(WEAVE, ('NumXYarns="2"', 'NumXYarns="999999"')), "NumXYarns says 999999 yarns, the file has data of 2"),
        (swap(WEAVE, ('value="1"', 'value="0"')), r"expected a crossing of one yarn along x .*, got \[0.0, 0.0\]"),
        (swap(WEAVE, ('x="0" y="0"', 'x="5" y="0"')), "expected a cell for each of 2 x 2 crossings, got 4"),
        (swap(WEAVE, ('x="0" y="0"', 'x="1" y="0"')), "expected a cell for each of 2 x 2 crossings, got 3"),
        (swap(WEAVE, ('FabricThickness="0.3"', 'FabricThickness="0.1"')), "a thickness of at least two yarns"),
        (tg3.weave([[1]], kind="CTextileWeave3D"), "expected yarns or a CTextileWeave2D"),
    ],
)
@pytest.mark.errors
def test_other_files_are_refused_in_one_sentence(tmp_path, content, text):
    with pytest.raises(FormatError, match=text) as caught:
        read(tmp_path, content).yarns[0].rings(0.01, 8)
    assert "\n" not in str(caught.value)


@pytest.mark.errors
def test_damaged_files_give_only_our_errors(tmp_path):
    """Bytes changed, left out, doubled and cut off: read, or refused in one sentence."""
    chance = random.Random(0)
    kinds = [tg3.yarn(NODES, sections=tg3.constant(written)) for written, _ in SECTIONS]
    whole = [YARN, WEAVE, tg3.textile([*kinds, PLACED], ((0, 0), (1, 1)))]
    words = [b"-", b"1e9", b"nan", b'"', b"<", b"0", b"Section", b"\xff", b"&x;", b"9" * 30, b", "]
    refused = 0
    for k in range(600):
        content = bytearray(whole[k % 3])
        for _ in range(chance.choice((1, 1, 3))):
            at = chance.randrange(len(content))
            end = at + chance.choice((0, 1, 4, 60))
            content[at:end] = chance.choice(
                (b"", chance.choice(words), bytes([chance.randrange(256)]), content[at:end] * 2)
            )
        try:
            for yarn in read(tmp_path, bytes(content)).yarns:
                yarn.rings(0.05, 8)
        except FormatError as error:
            refused += 1
            assert "\n" not in str(error)
    assert 100 < refused < 600
