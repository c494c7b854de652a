"""Read XML as a tree of elements with line numbers, so that error messages can name the line."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

from imitarm.errors import FileFormatError


@dataclass(frozen=True, eq=False)
class XmlElement:
    """One element of an XML file.

    Attributes:
        tag: tag as written, with its prefix, for example ``"joint"`` or ``"xacro:macro"``.
        attributes: attributes by name, in the order of the file.
        line: line in which the element begins, counted from 1.
        children: elements directly inside this element.
    """

    tag: str
    attributes: dict[str, str]
    line: int
    children: list[XmlElement] = field(default_factory=list)

    def get(self, name: str, default: str = "") -> str:
        """Return an attribute, or ``default`` when the element does not have it."""
        return self.attributes.get(name, default)

    def find(self, tag: str) -> XmlElement | None:
        """Return the first child with this tag, or None."""
        return next((child for child in self.children if child.tag == tag), None)

    def all(self, tag: str) -> list[XmlElement]:
        """Return the children with this tag."""
        return [child for child in self.children if child.tag == tag]

    def walk(self) -> Iterator[XmlElement]:
        """Yield this element and all elements inside this element, in the order of the file."""
        pending = [self]
        while pending:  # not recursive, so that no depth of nesting is too deep
            element = pending.pop()
            yield element
            pending += reversed(element.children)


def read_xml(path: Path, expected: str = "") -> XmlElement:
    """Read an XML file and return its root element.

    Args:
        path: path of the file.
        expected: expected type of the file, for example ``"an MJCF or URDF file"``; used in error messages.

    Raises:
        FileFormatError: when the file is not well-formed XML; the message names the line.
    """
    parser = expat.ParserCreate()
    parser.SetParamEntityParsing(expat.XML_PARAM_ENTITY_PARSING_NEVER)
    open_elements: list[XmlElement] = []
    roots: list[XmlElement] = []

    def start(tag: str, attributes: dict[str, str]) -> None:
        element = XmlElement(tag, attributes, parser.CurrentLineNumber)
        (open_elements[-1].children if open_elements else roots).append(element)
        open_elements.append(element)

    parser.StartElementHandler = start
    parser.EndElementHandler = lambda tag: open_elements.pop()
    try:
        parser.Parse(path.read_bytes(), True)
    except (expat.ExpatError, ValueError, LookupError) as error:
        remedy = f"; {expected} was expected" if expected else ""
        raise FileFormatError(f"{path}: not an XML file ({error}){remedy}") from error
    return roots[0]
