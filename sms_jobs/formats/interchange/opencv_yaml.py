"""The YAML that OpenCV's FileStorage writes, and no more of YAML than that.

Tables by indentation, lists by dashes or in brackets, tables in braces, words bare or in quotes, comments.
Tags such as !!opencv-matrix are passed over: they never make anything but what is written.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

from sms_jobs.errors import ConfigurationError
from sms_jobs.formats.interchange.text_files import DEEPEST

_NUMBER = re.compile(r"[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?")
_WHOLE = re.compile(r"[-+]?\d{1,18}")
_SPECIAL = {".nan": "nan", ".inf": "inf", "-.inf": "-inf", "+.inf": "inf"}
# A quote opens a word only where a word begins. One that does not close is matched to the end of its line, so
# that no text makes the search go over the same letters again and again.
_OPEN = r"(?<![^\s\[{,:])"
_QUOTED = rf'{_OPEN}"(?:[^"\\]|\\.)*(?:"|$)|{_OPEN}\'(?:[^\']|\'\')*(?:\'|$)'
_KEY = re.compile(rf"(?P<key>{_QUOTED}|[^\s\[\]{{}},:\"'#!&*-][^\[\]{{}},:\"'#]{{0,200}}?)\s{{0,8}}:(?=\s|$)")
_TAG = re.compile(r"!\S*(?:\s+|$)")
_COMMENT = re.compile(rf"({_QUOTED})|(?:^|(?<=\s))#.*")
_MARK = re.compile(rf"{_QUOTED}|[\[\]{{}}]")
_FLOW_TOKEN = re.compile(rf"\s*({_QUOTED}|[\[\]{{}},:]|[^\[\]{{}},:\"']+)")
_ESCAPE = re.compile(r"\\(x[0-9a-fA-F]{2}|.)", re.DOTALL)
_ESCAPED = {"n": "\n", "r": "\r", "t": "\t", "0": "\0"}


@dataclass(frozen=True)
class _Line:
    number: int
    indent: int
    text: str


def scalar(word: str) -> int | float | str:
    """Return the number that a word is, or the word itself, without its quotes."""
    word = word.strip()
    if word[:1] == '"':
        return _ESCAPE.sub(_unescaped, word[1:-1])
    if word[:1] == "'":
        return word[1:-1].replace("''", "'")
    if _WHOLE.fullmatch(word):
        return int(word)
    if _NUMBER.fullmatch(word):
        return float(word)
    return float(_SPECIAL[word.lower()]) if word.lower() in _SPECIAL else word


def parse_yaml(text: str, source: str) -> dict[str, Any]:
    """Return the table that a text holds; `source` names it in messages.

    Raises
    ------
    ConfigurationError
        It is malformed, or YAML that OpenCV does not write; the message names the line.
    """
    return _Reader(_logical_lines(text, source), source).document()


def _unescaped(found: re.Match[str]) -> str:
    escape = found[1]
    return chr(int(escape[1:], 16)) if escape[0] == "x" and len(escape) == 3 else _ESCAPED.get(escape, escape)


def _logical_lines(text: str, source: str) -> list[_Line]:
    """Return the lines that say something; what stands in brackets is brought into one line."""
    lines: list[_Line] = []
    begun, parts, depth = 0, [""], 0
    for number, raw in enumerate(text.splitlines(), start=1):
        content = _COMMENT.sub(lambda m: m[1] or "", raw).rstrip()
        if not content.strip() or content.startswith(("%", "---", "...")):
            continue
        if depth == 0:
            begun, parts = number, []
            if "\t" in content[: len(content) - len(content.lstrip())]:
                raise ConfigurationError(f"{source}, line {number}: indent with spaces, not with tabs")
        parts.append(content)
        for mark in _MARK.findall(content):
            if mark[0] in "\"'" and (len(mark) < 2 or mark[-1] != mark[0]):
                raise ConfigurationError(f"{source}, line {number}: the quote {mark[:40]} does not close")
            depth += (mark in "[{") - (mark in "]}")
        if depth > DEEPEST:
            raise ConfigurationError(f"{source}, line {number}: there are more than {DEEPEST} levels")
        if depth <= 0:
            whole = " ".join(parts)
            depth = 0
            lines.append(_Line(begun, len(whole) - len(whole.lstrip()), whole.strip()))
    if depth > 0:
        raise ConfigurationError(f"{source}: the brackets that are opened in line {begun} do not close")
    return lines


class _Reader:
    """Reads lines one after the other."""

    def __init__(self, lines: list[_Line], source: str) -> None:
        self._lines = lines
        self._source = source
        self._next = 0

    def document(self) -> dict[str, Any]:
        if not self._lines:
            return {}
        found = self._block(self._lines[0].indent, 0)
        if self._next < len(self._lines):
            raise self._refused("this line is indented differently from those before it")
        if not isinstance(found, dict):
            raise ConfigurationError(f"{self._source} holds a list where names with values are expected")
        return found

    def _refused(self, why: str, line: int | None = None) -> ConfigurationError:
        number = self._lines[min(self._next, len(self._lines) - 1)].number if line is None else line
        return ConfigurationError(f"{self._source}, line {number}: {why}")

    def _block(self, indent: int, depth: int) -> Any:
        if depth > DEEPEST:
            raise self._refused(f"there are more than {DEEPEST} levels")
        first = self._lines[self._next].text
        return (
            self._list(indent, depth)
            if first == "-" or first.startswith("- ")
            else self._table(indent, depth)
        )

    def _list(self, indent: int, depth: int) -> list[Any]:
        found = []
        while self._next < len(self._lines):
            line = self._lines[self._next]
            if line.indent != indent or not (line.text == "-" or line.text.startswith("- ")):
                break
            rest = line.text[1:].lstrip()
            if _KEY.match(rest) or rest.startswith("- "):
                # The item begins in the line of its dash: read it as if the dash were a space.
                inner = line.indent + len(line.text) - len(rest)
                self._lines[self._next] = _Line(line.number, inner, rest)
                found.append(self._block(inner, depth + 1))
            else:
                self._next += 1
                found.append(self._value(rest, line, depth))
        return found

    def _table(self, indent: int, depth: int) -> dict[str, Any]:
        found: dict[str, Any] = {}
        while self._next < len(self._lines):
            line = self._lines[self._next]
            if line.indent != indent:
                break
            key = _KEY.match(line.text)
            if key is None:
                raise self._refused(f"'{line.text[:40]}' is not a name with a colon")
            name = str(scalar(key["key"])) if key["key"][0] in "\"'" else key["key"]
            if name in found:
                raise self._refused(f"'{name}' stands twice in one table")
            self._next += 1
            found[name] = self._value(line.text[key.end() :].lstrip(), line, depth)
        return found

    def _value(self, rest: str, line: _Line, depth: int) -> Any:
        """Return the value that begins with `rest`, or stands in the lines below if nothing follows."""
        rest = _TAG.sub("", rest, count=1) if rest.startswith("!") else rest
        if not rest:
            if self._next < len(self._lines) and self._lines[self._next].indent > line.indent:
                return self._block(self._lines[self._next].indent, depth + 1)
            below = self._lines[self._next] if self._next < len(self._lines) else None
            if below is not None and below.indent == line.indent and below.text.startswith("- "):
                return self._list(below.indent, depth + 1)
            return ""
        if rest[0] in "[{":
            return self._flow(rest, line, depth)
        if rest[0] in "&*|>@`":
            raise self._refused(f"'{rest[:40]}' is YAML that OpenCV does not write", line.number)
        return scalar(rest)

    def _flow(self, text: str, line: _Line, depth: int) -> Any:
        """Return what stands in brackets or braces."""
        tokens = []
        place = 0
        while place < len(text.rstrip()):
            token = _FLOW_TOKEN.match(text, place)
            if token is None:
                raise self._refused(f"'{text[place : place + 40]}' cannot be read here", line.number)
            tokens.append(token[1])
            place = token.end()
        tokens.reverse()
        found = self._flow_value(tokens, line, depth)
        if tokens:
            raise self._refused(f"'{tokens[-1][:40]}' follows the end of a list or table", line.number)
        return found

    def _flow_value(self, tokens: list[str], line: _Line, depth: int) -> Any:
        if depth > DEEPEST:
            raise self._refused(f"there are more than {DEEPEST} levels", line.number)
        if not tokens or tokens[-1] in ("]", "}", ",", ":"):
            raise self._refused("a value is missing in a list or table", line.number)
        opened = tokens.pop()
        if opened not in ("[", "{"):
            return scalar(opened)
        items: list[Any] = []
        table: dict[str, Any] = {}
        closed = "]" if opened == "[" else "}"
        while tokens and tokens[-1] != closed:
            value = self._flow_value(tokens, line, depth + 1)
            if opened == "{":
                if not tokens or tokens.pop() != ":":
                    raise self._refused(f"'{value}' has no colon after it", line.number)
                table[str(value)] = self._flow_value(tokens, line, depth + 1)
            else:
                items.append(value)
            if tokens and tokens[-1] == ",":
                tokens.pop()
            elif tokens and tokens[-1] != closed:
                raise self._refused(f"'{tokens[-1][:40]}' should be a comma or {closed}", line.number)
        if not tokens:
            raise self._refused(f"{closed} is missing", line.number)
        tokens.pop()
        return items if opened == "[" else table
