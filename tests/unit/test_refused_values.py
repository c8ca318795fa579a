"""What a value should be is said in words of people, never in those of what checks it."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from support.command import inside

from sms_jobs import settings
from sms_jobs.errors import ConfigurationError, InvalidInput, in_words
from sms_jobs.kinds import all_kinds
from sms_jobs.settings import FILE_NAME

_TECHNICAL = re.compile(r"Input|valid|parse|permitted|tuple|validator|convert|fractional|Value error")


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ('workers = "a"', "the setting 'workers' .* cannot be used: it should be a whole number$"),
        ("workers = 1.5", "the setting 'workers' .* cannot be used: it should be a whole number$"),
        ("workers = 0", "it should be greater than or equal to 1$"),
        ("database_url = 3", "it should be text$"),
        ("worker = 3", "there is no setting 'worker' .*; did you mean 'workers'$"),
        ("entirely = 3", "there is no setting 'entirely' .*; docs/configuration.md has all$"),
    ],
)
def test_a_setting_is_refused_in_words(tmp_path: Path, line: str, told: str) -> None:
    (tmp_path / FILE_NAME).write_text(line + "\n")
    with pytest.raises(ConfigurationError, match=told) as refused:
        settings.load(tmp_path)
    assert not _TECHNICAL.search(str(refused.value).replace(str(tmp_path), ""))


_GIVEN = ("x", "", "-1e9", "1.5", ["a", "b"], True, None, 1.5)


@pytest.mark.parametrize("kind", all_kinds())
def test_every_parameter_of_a_kind_is_refused_in_words(kind: str) -> None:
    told = [
        refusal(kind, name, value) for name in all_kinds()[kind].parameters.model_fields for value in _GIVEN
    ]
    assert [why for why in told if _TECHNICAL.search(why)] == []


def refusal(kind: str, name: str, value: object) -> str:
    """Return what is said of a value, without the value; nothing where it is taken."""
    try:
        all_kinds()[kind].parameters.checked(kind, {name: value})
    except InvalidInput as error:
        return str(error).rpartition(" cannot be ")[2].removeprefix(repr(value))
    return ""


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("job list --limit 0", "'--limit': it should be greater than or equal to 1, not '0'; see"),
        ("job list --limit x", "'--limit': it should be a whole number, not 'x'; see"),
        ("job wait --timeout -1", "'--timeout': it should be greater than or equal to 0, not '-1'; see"),
        ("job list --state no", "'--state': 'no' is not one of 'waiting', 'queued',"),
    ],
)
def test_a_value_of_an_option_is_refused_in_words_and_told(line: str, told: str) -> None:
    done = inside(*line.split())
    assert done.returncode == 2
    assert done.stderr.startswith(f"error: Invalid value for {told}")


def test_a_body_that_is_no_object_is_refused_in_words() -> None:
    said = in_words("Input should be a valid dictionary or object to extract fields from")
    assert said == "it should be an object"
