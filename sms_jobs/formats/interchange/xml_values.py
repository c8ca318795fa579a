"""Values of XML elements, and where in the document each of them stands.

An element with children is a table; one with the attribute type="list" is a list of its children, or of its
words; any other holds one value. What kind of value it is can be said by the attribute `type` (int, float,
bool, text, time), as the thesis's files do (section 4.5.2), and is seen from its text where it is not:
several numbers are a list, then.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any, TypeAlias

from sms_jobs.errors import ConfigurationError
from sms_jobs.formats.interchange.xml_elements import Element

Path: TypeAlias = tuple[str | int, ...]

TYPES = ("int", "float", "bool", "text", "time", "list", "table")
_INT = re.compile(r"[-+]?\d{1,18}")
_FLOAT = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_TIME = re.compile(r"\d{4}-\d\d-\d\dT\S+")
_BOOLS = {"true": True, "false": False}


@dataclass
class Places:
    """Where in a document the values of a nested table stand: element and line by path."""

    source: str
    _found: dict[Path, tuple[str, int]] = field(default_factory=dict)
    _known: set[Path] = field(default_factory=set)

    def add(self, path: Path, element: str, line: int) -> None:
        """Say that the value at a path is that of an element, or, with no element, that of a line."""
        self._found[path] = (element, line)
        self._known |= {path[:length] for length in range(len(path) + 1)}

    def at(self, path: Path) -> str:
        """Return file, line and element of the value at a path, or of the nearest that surrounds it."""
        place: Path = ()
        for part in path:
            # A field without an element is the tag of a union, or a missing key.
            place = (*place, part) if (*place, part) in self._known else place
        while place and place not in self._found:
            place = place[:-1]
        if place not in self._found:
            return self.source
        element, line = self._found[place]
        return f"{self.source}, line {line}" + (f", element {element}" if element else "")

    def refused(self, element: Element, name: str, why: str) -> ConfigurationError:
        """Return the error that names an element and its line."""
        return ConfigurationError(f"{self.source}, line {element.line}, element {name}: {why}")


def value_of(element: Element, places: Places, name: str, path: Path) -> Any:
    """Return what an element holds; note in `places` where it and all below it stand.

    Parameters
    ----------
    element
        To be read.
    places
        Takes the places of what is found.
    name
        Of the element and those around it, as in sms/acquisition/states.
    path
        Where the value goes in the nested table.

    Raises
    ------
    ConfigurationError
        The element holds text beside elements, says one name twice, or is not of the type that it names.
    """
    places.add(path, name, element.line)
    kind = element.attributes.get("type")
    unknown = [key for key in element.attributes if key != "type"]
    if unknown:
        raise places.refused(element, name, f"has no attribute '{unknown[0]}'; its only attribute is type")
    if kind is not None and kind not in TYPES:
        raise places.refused(element, name, f"type should be one of {', '.join(TYPES)}, not '{kind}'")
    text = element.text.strip()
    if element.children and text:
        raise places.refused(element, name, f"holds '{text[:40]}' beside other elements")
    if element.children and kind in (None, "table"):
        return table_of(element, places, name, path)
    if element.children and kind == "list":
        return [
            value_of(child, places, f"{name}/{child.name}[{i + 1}]", (*path, i))
            for i, child in enumerate(element.children)
        ]
    if element.children:
        raise places.refused(element, name, f"is of type {kind}, so it cannot hold other elements")
    if kind == "table":
        return {}
    words = text.replace(",", " ").split()
    if kind == "list":
        return [_seen(word) for word in words]
    if kind is None:
        several = len(words) > 1 and all(_FLOAT.fullmatch(word) for word in words)
        return [_seen(word) for word in words] if several else _seen(text)
    try:
        return _READ[kind](text)
    except (ValueError, KeyError):
        raise places.refused(element, name, f"should be of type {kind}, not '{text[:40]}'") from None


def table_of(element: Element, places: Places, name: str, path: Path) -> dict[str, Any]:
    """Return the children of an element by name."""
    found: dict[str, Any] = {}
    for child in element.children:
        if child.name in found:
            why = 'stands here twice; a list needs type="list" at the element around it'
            raise places.refused(child, f"{name}/{child.name}", why)
        found[child.name] = value_of(child, places, f"{name}/{child.name}", (*path, child.name))
    return found


def _seen(text: str) -> Any:
    """Return the value that a text looks like."""
    if _INT.fullmatch(text):
        return int(text)
    if _FLOAT.fullmatch(text):
        return float(text)
    if text in _BOOLS:
        return _BOOLS[text]
    if _TIME.fullmatch(text):
        try:
            return datetime.fromisoformat(text)
        except ValueError:
            return text
    return text


_READ: dict[str, Callable[[str], Any]] = {
    "int": int,
    "float": float,
    "bool": _BOOLS.__getitem__,
    "text": str,
    "time": datetime.fromisoformat,
}
