"""XML as data: elements with the line they begin in, and nothing else.

Expat does the parsing. A document type declaration that is more than a name is refused as soon as it begins,
so there are no entities to expand (the "billion laughs") and none to fetch from a disk or a network; nesting
and size are bounded.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from xml.parsers import expat

from sms_jobs.errors import ConfigurationError
from sms_jobs.formats.interchange.text_files import DEEPEST

_MOST_ELEMENTS = 100_000


@dataclass
class Element:
    """An element: its name, attributes, text outside of its children, children, and line."""

    name: str
    line: int
    attributes: dict[str, str] = field(default_factory=dict)
    text: str = ""
    children: list[Element] = field(default_factory=list)


def parse_xml(text: str, source: str) -> Element:
    """Return the root element of a document; `source` names it in messages.

    Raises
    ------
    ConfigurationError
        It is not well-formed, declares more of its type than a name, or is nested or filled beyond measure.
    """
    parser = expat.ParserCreate()
    parser.buffer_text = True
    open_elements: list[Element] = []
    roots: list[Element] = []
    count = 0

    def refuse(why: str) -> ConfigurationError:
        return ConfigurationError(f"{source}, line {parser.CurrentLineNumber}: {why}")

    def start(name: str, attributes: dict[str, str]) -> None:
        nonlocal count
        count += 1
        if len(open_elements) >= DEEPEST or count > _MOST_ELEMENTS:
            raise refuse(f"there are more than {DEEPEST} levels or {_MOST_ELEMENTS} elements of XML")
        element = Element(name, parser.CurrentLineNumber, dict(attributes))
        (open_elements[-1].children if open_elements else roots).append(element)
        open_elements.append(element)

    def end(_name: str) -> None:
        open_elements.pop()

    def characters(data: str) -> None:
        open_elements[-1].text += data

    def doctype(_name: str, system: str | None, public: str | None, more: int) -> None:
        if system is not None or public is not None or more:
            raise refuse("a document type declaration (<!DOCTYPE ...>) is not read; remove it")

    parser.StartElementHandler = start
    parser.EndElementHandler = end
    parser.CharacterDataHandler = characters
    parser.StartDoctypeDeclHandler = doctype
    try:
        parser.Parse(text, True)
    except expat.ExpatError as error:
        raise ConfigurationError(
            f"{source}, line {error.lineno}: this is not well-formed XML ({expat.ErrorString(error.code)})"
        ) from None
    return roots[0]
