import pytest

from torchmeso.data import xml_tree
from torchmeso.errors import FormatError


def test_elements_attributes_and_lines(tmp_path):
    (tmp_path / "a.xml").write_text(
        '<?xml version="1.0" ?>\n<a n="1">text\n <b v="&lt;x&gt;"/><c/><b v="2"><d/></b>\n</a>'
    )
    top = xml_tree.read(tmp_path / "a.xml")
    assert (top.tag, top.values, top.line) == ("a", {"n": "1"}, 2)
    assert [b.values["v"] for b in top.all("b")] == ["<x>", "2"]
    assert [b.line for b in top.all("b")] == [3, 3]
    assert top.first("c") is not None
    assert top.first("d") is None


BOMB = '<?xml version="1.0"?><!DOCTYPE a [<!ENTITY x "xxxxxxxx"><!ENTITY y "&x;&x;&x;&x;">]><a>&y;</a>'


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (BOMB, "expected XML without a document type declaration"),
        ('<!DOCTYPE a SYSTEM "file:///etc/hostname"><a/>', "expected XML without a document type declaration"),
        ("<a>" * 65 + "</a>" * 65, "expected elements at most 64 deep, got more in line 1"),
        ("<a>&x;</a>", r"expected XML in UTF-8 \(undefined entity"),
        ("<a><b></a>", r"expected XML in UTF-8 \(mismatched tag: line 1, column 8\)"),
        ("", r"expected XML in UTF-8 \(no element found"),
        ("<a/><a/>", "expected XML in UTF-8"),
        ('<a b="1" b="2"/>', "duplicate attribute"),
    ],
)
@pytest.mark.errors
def test_bad_xml_is_one_sentence(content, text):
    with pytest.raises(FormatError, match=f"^x: {text}" if text[0] == "e" else text):
        xml_tree.parse(content.encode(), "x")


@pytest.mark.parametrize("encoding", ["utf-16", "latin-1", "cp037", "idna", "unicode_escape", "no such"])
@pytest.mark.errors
def test_the_declared_encoding_is_not_followed(encoding):
    with pytest.raises(FormatError, match="expected XML in UTF-8"):
        xml_tree.parse(f'<?xml version="1.0" encoding="{encoding}"?><a b="'.encode() + b'\xe9"/>', "x")


@pytest.mark.errors
def test_missing_and_large_files(tmp_path, monkeypatch):
    with pytest.raises(FormatError, match="expected a file, found none"):
        xml_tree.read(tmp_path / "no.xml")
    (tmp_path / "a.xml").write_text("<a/>" + " " * 100)
    monkeypatch.setattr(xml_tree, "MOST_BYTES", 99)
    with pytest.raises(FormatError, match="expected at most 0 MiB of XML, got 0 MiB"):
        xml_tree.read(tmp_path / "a.xml")
