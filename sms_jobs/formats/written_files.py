"""Files that people write: their tables, and words for what is wrong in them and where."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from sms_jobs.errors import ConfigurationError, InvalidInput
from sms_jobs.formats.interchange.text_files import DEEPEST
from sms_jobs.formats.interchange.xml_values import Places
from sms_jobs.records.numbers import is_excessive

T = TypeVar("T", bound=BaseModel)
R = TypeVar("R")


def read_toml(text: str, source: str) -> tuple[dict[str, Any], Places]:
    """Return the nested table of a TOML text, and on which lines its values stand.

    Raises `ConfigurationError` for what is no TOML; `source` names the text in messages.
    """
    if _TOO_DEEP.search(text):
        # Its parser takes a time that grows with the square of a key's parts.
        raise ConfigurationError(
            f"{source} has a key with more than {DEEPEST} parts: name fewer tables in it"
        )
    try:
        content = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        # Of TOML itself, or a number with thousands of digits.
        raise ConfigurationError(f"{source} is not valid TOML: {error or 'nested too deeply'}") from None
    return content, _toml_places(text, source)


def validated(
    model: type[T], content: dict[str, Any], places: Places, hint: str, record: Callable[[T], R]
) -> R:
    """Return the record that a file's content describes, through the table `model`.

    Raises `ConfigurationError`, one sentence that names the file, the line, the key and `hint`, the command
    that helps, where the content cannot be used.
    """
    _refuse_excess(content, (), content, places)
    try:
        return record(model.model_validate(_tuples(content)))
    except ValidationError as error:
        first, *more = error.errors(include_url=False)
        rest = f" (and {len(more)} more)" if more else ""
        raise ConfigurationError(
            f"{places.at(first['loc'])}: {_explained(first, content)}{rest}; {hint}"
        ) from None
    except InvalidInput as error:
        raise ConfigurationError(f"{places.source}: {error}") from error


def _refuse_excess(value: Any, where: tuple[int | str, ...], content: Any, places: Places) -> None:
    """Raise `ConfigurationError` for a number with which nothing can be computed."""
    if isinstance(value, dict):
        for key, inner in value.items():
            _refuse_excess(inner, (*where, key), content, places)
    elif isinstance(value, list):
        for number, inner in enumerate(value):
            _refuse_excess(inner, (*where, number), content, places)
    elif is_excessive(value):
        name, _ = _place(where, content)
        raise ConfigurationError(
            f"{places.at(where)}: {name} should be a finite number of usual size, not {value}"
        )


_PART = r"(?:[A-Za-z0-9_-]++|\"[^\"\n]*+\"|'[^'\n]*+')"
_TOO_DEEP = re.compile(
    rf"(?:^[ \t]*+\[{{0,2}}|[{{,])[ \t]*+{_PART}(?:[ \t]*+\.[ \t]*+{_PART}){{{DEEPEST},}}", re.MULTILINE
)
_HEADER = re.compile(r"\s*(\[\[?)\s*([^\[\]#]+?)\s*\]\]?\s*(?:#.*)?$")
_KEY = re.compile(r"\s*((?:[A-Za-z0-9_-]+|\"[^\"]*\")(?:\s*\.\s*(?:[A-Za-z0-9_-]+|\"[^\"]*\"))*)\s*=")


def _toml_places(text: str, source: str) -> Places:
    """Find the lines of tables and keys; of what stands within a value, that of its key."""
    places = Places(source)
    counts: dict[tuple[str | int, ...], int] = {}
    table: tuple[str | int, ...] = ()
    for number, line in enumerate(text.splitlines(), start=1):
        header, key = _HEADER.match(line), _KEY.match(line)
        if header is not None:
            table = ()
            names = _key_parts(header[2])
            for depth, name in enumerate(names):
                table = (*table, name)
                if table in counts and not (header[1] == "[[" and depth == len(names) - 1):
                    table = (*table, counts[table])
            if header[1] == "[[":
                counts[table] = counts.get(table, -1) + 1
                table = (*table, counts[table])
            places.add(table, "", number)
        elif key is not None:
            places.add((*table, *_key_parts(key[1])), "", number)
    return places


def _key_parts(text: str) -> tuple[str, ...]:
    return tuple(part.strip().strip('"') for part in text.split("."))


def _tuples(value: Any) -> Any:
    """Return parsed TOML with tuples for lists, as strict validation of tuples wants them."""
    if isinstance(value, dict):
        return {key: _tuples(v) for key, v in value.items()}
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


def _explained(error: ErrorDetails, content: Any) -> str:
    """Say in words where in the file a value is wrong and what is expected there."""
    where, value = _place(error["loc"], content)
    kind, message = error["type"], error["msg"]
    if kind == "missing":
        return f"{where} is missing"
    if kind == "timezone_aware":
        return f"{where} needs a time zone, as in 2026-05-04T10:00:00+02:00"
    if kind.startswith("union_tag"):
        key = error["ctx"]["discriminator"].strip("'")
        if kind == "union_tag_not_found":
            return f"{where}.{key} is missing"
        return f"{where}.{key} should be one of {error['ctx']['expected_tags']}, not '{error['ctx']['tag']}'"
    for technical, plain in _PLAIN.items():
        message = message.replace(technical, plain)
    message = re.sub(" or instance of .*", "", message)
    shown = (
        f", not {value!r}" if message.startswith("should") and isinstance(value, str | int | float) else ""
    )
    return f"{where} {message}{shown if ', not ' not in message else ''}"


_PLAIN = {
    "Input should": "should",
    "Tuple should": "should",
    " after validation": "",
    "a valid integer": "a whole number",
    "a valid number": "a number",
    "a valid tuple": "a list",
    "a valid dictionary": "a table",
    "a valid string": "text in quotes",
    "a valid datetime": "a date and time, as in 2026-05-04T10:00:00+02:00",
}


def _place(location: tuple[int | str, ...], content: Any) -> tuple[str, Any]:
    """Return the name of a place in the file, as in `states[S02].load_n`, and the value there."""
    value, where = content, ""
    for part in location:
        if isinstance(part, int):
            value = value[part] if isinstance(value, list) and part < len(value) else None
            entry = value if isinstance(value, dict) else {}
            where += f"[{entry.get('label') or entry.get('name') or part + 1}]"
        elif isinstance(value, dict) and part not in value and part in value.values():
            continue  # the tag of a union, which is no key of the file
        else:
            value = value.get(part) if isinstance(value, dict) else None
            where += f".{part}" if where else part
    return where or "the file", value
