"""Messages of use cases name parameters, and the command line the options that set them."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from sms_jobs.bench.hostile.trial import commands
from sms_jobs.cli import output

ROOT = Path(__file__).parents[2]
BELOW = ("app", "archive", "catalogue", "formats", "jobs", "kinds", "metrology")


@pytest.mark.parametrize(
    ("said", "shown"),
    [
        ("set `add_states` to add 3", "set --add-states to add 3"),
        ("leave out `views` and `alone`", "leave out --views and --alone"),
        ("`sms acquire resume` keeps it", "`sms acquire resume` keeps it"),
        ("the campaign `Wing` is not there", "the campaign `Wing` is not there"),
    ],
)
def test_a_parameter_is_called_by_its_option(said: str, shown: str) -> None:
    assert output.with_options(said) == shown


def test_every_parameter_that_a_message_names_has_an_option() -> None:
    options = {name for one in commands() for option in one.options for name in option.opts}
    named = {
        name
        for room in BELOW
        for path in (ROOT / "sms_jobs" / room).rglob("*.py")
        for line in path.read_text("utf-8").splitlines()
        if re.match(r'\s*(raise |return |\(?f?"|advice|detail|missing)', line) and '"""' not in line
        for name in re.findall("`([a-z][a-z_]*)`", line)
    }
    assert len(named) > 40
    assert {n for n in named if "--" + n.replace("_", "-") not in options} == set()
