"""The three texts of OpenCV's FileStorage - YAML, XML and JSON - as tables, lists, numbers and words.

OpenCV's own reader is not used for files of strangers: it is native code that ends the whole process on some
malformed texts. A matrix is an ordinary table with rows, cols, dt and data; `opencv_calibration` makes an
array of it where it needs one.
"""

from __future__ import annotations

import json
import re
from pathlib import PurePath
from typing import Any, TypeAlias

from sms_jobs.errors import ConfigurationError
from sms_jobs.formats.interchange.opencv_yaml import parse_yaml, scalar
from sms_jobs.formats.interchange.xml_elements import Element, parse_xml

Table: TypeAlias = dict[str, Any]
"""Names to tables, lists, integers, floats or words."""

# What does not close is matched to the end, so that no text is searched again and again.
_JSON_TOKEN = re.compile(r'"(?:[^"\\]|\\.)*(?:"|\Z)|//[^\n]*|/\*.*?(?:\*/|\Z)', re.DOTALL)
_XML_WORD = re.compile(r'"[^"]*"(?=\s|\Z)|[^\s"]++(?=\s|\Z)')
_XML_WORDS = re.compile(rf"(?:(?:{_XML_WORD.pattern})\s*+)*+")


def parse_storage(text: str, source: str) -> Table:
    """Return what a text of OpenCV's FileStorage holds; its first sign tells the dialect.

    Raises
    ------
    ConfigurationError
        It is none of the three dialects, or malformed; the message names `source` and, where known, the line.
    """
    start = text.lstrip()[:1]
    if start == "<":
        return _xml(text, source)
    if start == "{":
        return _json(text, source)
    if start == "%" or PurePath(source).suffix.lower() in (".yml", ".yaml"):
        return parse_yaml(text, source)
    raise ConfigurationError(
        f"{source} is no file of OpenCV: YAML begins with %YAML, XML with <?xml and JSON with a brace"
    )


def _json(text: str, source: str) -> Table:
    """Read JSON, with the comments and the escaped apostrophes that OpenCV writes."""

    def plain(token: re.Match[str]) -> str:
        if token[0][0] == "/":
            return "\n" * token[0].count("\n")
        return re.sub(r"\\(.)", lambda e: "'" if e[1] == "'" else e[0], token[0], flags=re.DOTALL)

    def table(pairs: list[tuple[str, Any]]) -> Table:
        found = dict(pairs)
        if len(found) < len(pairs):
            names = [name for name, _ in pairs]
            twice = next(name for name in names if names.count(name) > 1)
            raise ConfigurationError(f"{source}: '{twice}' stands twice in one table")
        return found

    try:
        found: Table = json.loads(
            _JSON_TOKEN.sub(plain, text),
            object_pairs_hook=table,
            parse_int=lambda digits: int(digits) if len(digits) <= 18 else float(digits),
            strict=False,
        )
    except json.JSONDecodeError as error:
        raise ConfigurationError(f"{source}, line {error.lineno}: this is not JSON ({error.msg})") from None
    except RecursionError:
        raise ConfigurationError(f"{source} is nested too deeply to be read") from None
    return found  # the text begins with a brace


def _xml(text: str, source: str) -> Table:
    root = parse_xml(text, source)
    if root.name != "opencv_storage":
        raise ConfigurationError(
            f"{source} is no XML file of OpenCV: its outermost element is <{root.name}>, not <opencv_storage>"
        )
    return _xml_table(root.children, source)


def _xml_table(children: list[Element], source: str) -> Table:
    found: Table = {}
    for child in children:
        if child.name in found:
            raise ConfigurationError(f"{source}, line {child.line}: '{child.name}' stands twice in one table")
        found[child.name] = _xml_value(child, source)
    return found


def _xml_value(element: Element, source: str) -> Any:
    if element.children and all(child.name == "_" for child in element.children):
        return [_xml_value(child, source) for child in element.children]
    if element.children:
        return _xml_table(element.children, source)
    text = element.text.strip()
    if not _XML_WORDS.fullmatch(text):
        return text.strip('"')  # one word with quotes in it, which OpenCV does not mark
    words = _XML_WORD.findall(text)
    values = [word[1:-1] if word[0] == '"' else scalar(word) for word in words]
    return values[0] if element.name != "data" and len(values) == 1 else values
