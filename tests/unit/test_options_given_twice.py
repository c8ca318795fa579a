"""An option of one value is given once: which of two is meant, nobody knows."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from support.command import inside

from sms_jobs.cli.commands import COMMANDS
from sms_jobs.errors import InvalidInput


def leaves(command: Any) -> Iterator[Any]:
    inner = getattr(command, "commands", {})
    if not inner:
        yield command
    for name in inner.keys():  # noqa: SIM118 - commands that are loaded when they are looked up
        yield from leaves(inner[name])


@pytest.mark.parametrize("name", COMMANDS)
def test_every_option_of_one_value_is_refused_the_second_time(name: str) -> None:
    tried = 0
    for command in leaves(COMMANDS[name].load(name)):
        context = command.make_context(name, [], resilient_parsing=True)
        context.resilient_parsing = False
        for option in command.params:
            if option.param_type_name != "option":
                continue
            once = [option.opts[0], *["7"] * (0 if option.is_flag else option.nargs)]
            again = [option.opts[-1], *once[1:]]
            parse = command.make_parser(context).parse_args
            parse([*once])
            if option.multiple or option.is_flag:
                parse([*once, *again])
                continue
            tried += 1
            with pytest.raises(InvalidInput, match="has one value, and is given more than once"):
                parse([*once, *again])
    assert tried


def test_whoever_types_it_is_told(home: Path) -> None:
    told = inside("job", "list", "-c", "a", "--campaign=b", "--home", str(home))
    assert (told.returncode, told.stderr) == (
        2,
        "error: --campaign has one value, and is given more than once: give it once\n",
    )
    for words in (
        ("--set", "subset_radius_px=14", "--set", "subset_radius_px=15"),
        ("--subset-radius-px", "14", "--set", "subset_radius_px=15"),
    ):
        told = inside("job", "submit", "correlate", "-c", "a", *words, "--home", str(home))
        assert told.returncode == 2
        assert "the parameter 'subset_radius_px' is given more than once: give it once" in told.stderr
    gauges = ("--gauge", "a x=0 y=0 length=9", "--gauge", "b x=0 y=0 length=9")
    told = inside("job", "submit", "gauges", "-c", "a", *gauges, "--home", str(home))
    assert "'gauge' is given more than once: give it once" in told.stderr
    assert "how several values are written in one" in told.stderr
