"""Campaign definitions that people write: TOML or XML text in, records out.

Nothing is taken from a file that cannot be used as a whole: unknown keys, impossible values and
contradictions are refused, in one sentence that names the file and the key.
"""

from __future__ import annotations

import re
import tomllib
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from sms_jobs.errors import ConfigurationError, InvalidInput, NotFound
from sms_jobs.formats.campaign_tables import CampaignPlan, CampaignTable
from sms_jobs.formats.interchange.xml_values import Places
from sms_jobs.formats.measurement_configuration import parse_measurement_configuration

LARGEST_FILE_BYTES = 1 << 20


def load_campaign(path: Path) -> CampaignPlan:
    """Read a campaign file: XML where its name ends in .xml, TOML otherwise.

    Raises
    ------
    NotFound
        There is no such file.
    ConfigurationError
        It is too large, no TOML or XML, or does not describe a campaign; the message names file and key.
    """
    try:
        with path.open("rb") as file:
            content = file.read(LARGEST_FILE_BYTES + 1)
    except FileNotFoundError:
        raise NotFound(f"there is no campaign file {path}") from None
    except OSError as error:
        raise ConfigurationError(f"{path} cannot be read: {error.strerror}") from error
    if len(content) > LARGEST_FILE_BYTES:
        raise ConfigurationError(
            f"{path} is larger than the {LARGEST_FILE_BYTES} bytes that a campaign file may have"
        )
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError as error:
        raise ConfigurationError(f"{path} is not UTF-8 text (byte {error.start}): save it as UTF-8") from None
    if path.suffix.lower() == ".xml":
        return _plan(*parse_measurement_configuration(text, str(path)), text)
    return parse_campaign(text, str(path))


def parse_campaign(text: str, source: str) -> CampaignPlan:
    """Read the text of a campaign file; `source` names it in messages.

    Raises
    ------
    ConfigurationError
        The text is no TOML or does not describe a campaign.
    """
    try:
        content = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise ConfigurationError(f"{source} is not valid TOML: {error or 'nested too deeply'}") from None
    return _plan(content, Places(source), text)


def _plan(content: dict[str, Any], places: Places, text: str) -> CampaignPlan:
    """Return what the nested table of a file defines; `places` says where in its text the values stand."""
    try:
        return replace(CampaignTable.model_validate(_tuples(content)).plan(), text=text)
    except ValidationError as error:
        first, *more = error.errors(include_url=False)
        rest = f" (and {len(more)} more)" if more else ""
        raise ConfigurationError(
            f"{places.at(first['loc'])}: {_explained(first, content)}{rest}; "
            "`sms campaign create --example` prints a valid file"
        ) from None
    except InvalidInput as error:
        raise ConfigurationError(f"{places.source}: {error}") from error


def example_campaign() -> str:
    """Return the text of a commented, valid file: a tension test of a plate on a virtual rig."""
    return files("sms_jobs.formats").joinpath("example_campaign.toml").read_text("utf-8")


def example_session() -> str:
    """Return the text of a commented, valid file: a calibration session of a virtual rig."""
    return files("sms_jobs.formats").joinpath("example_session.toml").read_text("utf-8")


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


__all__ = ["CampaignPlan", "example_campaign", "example_session", "load_campaign", "parse_campaign"]
