"""XML as foreign files have it, into plain elements: tags, attributes, children.

Text between tags is dropped. Document type declarations are refused, because entities expand without bound; so are
deep nesting and encodings other than UTF-8, and nothing outside of the file is read.

Test: tests/data/test_xml_tree.py
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

from torchmeso.errors import FormatError

MOST_BYTES = 64 << 20
"""Elements in memory take some ten times the size of their file."""

DEEPEST = 64


@dataclass(frozen=True, slots=True, kw_only=True)
class Element:
    """An element of an XML file.

    Attributes:
        tag: its name.
        values: its attributes.
        children: the elements in it, in order.
        line: where it begins, from 1.
    """

    tag: str
    values: dict[str, str]
    line: int
    children: list["Element"] = field(default_factory=list)

    def all(self, tag: str) -> Iterator["Element"]:
        """Yield the children of the name `tag`."""
        return (child for child in self.children if child.tag == tag)

    def first(self, tag: str) -> "Element | None":
        """Return the first child of the name `tag`, None where there is none."""
        return next(self.all(tag), None)


def read(path: str | Path) -> Element:
    """Return the outermost element of an XML file.

    Raises:
        FormatError: the file is missing, too large, no XML, or declares a document type.
    """
    path = Path(path)
    if not path.is_file():
        raise FormatError(f"{path}: expected a file, found none; check the path")
    if path.stat().st_size > MOST_BYTES:
        raise FormatError(
            f"{path}: expected at most {MOST_BYTES >> 20} MiB of XML, got {path.stat().st_size >> 20} MiB"
        )
    return parse(path.read_bytes(), str(path))


def parse(content: bytes, name: str) -> Element:
    """Return the outermost element of XML text; `name` stands in errors.

    Raises:
        FormatError: it is no XML, or declares a document type.
    """
    parser = expat.ParserCreate("utf-8")
    top = Element(tag="", values={}, line=0)
    open_elements = [top]

    def start(tag: str, values: dict[str, str]) -> None:
        if len(open_elements) > DEEPEST:
            raise FormatError(
                f"{name}: expected elements at most {DEEPEST} deep, got more in line {parser.CurrentLineNumber}"
            )
        element = Element(tag=tag, values=values, line=parser.CurrentLineNumber)
        open_elements[-1].children.append(element)
        open_elements.append(element)

    def refuse(*_: object) -> None:
        raise FormatError(f"{name}: expected XML without a document type declaration (DOCTYPE), got one; remove it")

    parser.StartElementHandler = start
    parser.EndElementHandler = lambda tag: open_elements.pop()
    parser.StartDoctypeDeclHandler = refuse
    try:
        parser.Parse(content, True)
    except expat.ExpatError as error:
        raise FormatError(f"{name}: expected XML in UTF-8 ({error})") from error
    return top.children[0]
