"""Parameters of a job kind, given like options."""

from __future__ import annotations

import re

import pytest
from support.command import inside

from sms_jobs.app.work.kinds import KindView, kinds
from sms_jobs.cli.kind_options import parameter_rows, refuse_misspelt, split_words
from sms_jobs.errors import InvalidInput
from sms_jobs.kinds import all_kinds


def test_options_among_the_kinds_become_settings() -> None:
    words = ["reconstruct", "--method", "fdr", "--pair-rule=least-gap", "--minimum-pair-margin", "-1"]
    assert split_words(words) == (
        ["reconstruct"],
        ["method=fdr", "pair_rule=least-gap", "minimum_pair_margin=-1"],
    )
    assert split_words(["correlate", "strain"]) == (["correlate", "strain"], [])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["reconstruct", "--method"], "'--method' needs a value"),
        (["reconstruct", "--method", "--returns", "2"], "'--method' needs a value"),
        (["correlate", "strain", "--gauge-length-mm", "3"], "'--gauge_length_mm' is a parameter of one kind"),
        (["--method", "fdr"], "there are 0"),
        (["strain", "--dryrun"], "no option '--dryrun'; did you mean '--dry-run'"),
    ],
)
def test_what_cannot_be_meant_is_refused(words: list[str], message: str) -> None:
    with pytest.raises(InvalidInput, match=message):
        split_words(words, ("--dry-run", "--wait"))


@pytest.mark.parametrize(
    ("word", "meant"), [("--states", "--state"), ("--veiw", "--view"), ("--priorty", "--priority")]
)
def test_a_misspelt_option_of_the_command_is_no_parameter(word: str, meant: str) -> None:
    refused = inside("job", "submit", "gauges", word, "S01", "-c", "plate")
    assert refused.returncode == 2
    assert f"no option '{word}', nor has gauges such a parameter; did you mean '{meant}'" in refused.stderr


def test_a_misspelt_parameter_is_named_with_the_parameters() -> None:
    """It is nearer to one of these than to an option of the command, or to neither."""
    for setting in ("gauge_lenght_mm=3", "methd=disc", "entirely=3", "square_px=5"):
        refuse_misspelt(["strain"], [setting], ("--state", "--view", "--set"))
    refuse_misspelt(["correlate", "strain"], ["states=S01"], ("--state",))
    refuse_misspelt(["nothing"], ["states=S01"], ("--state",))


@pytest.mark.parametrize("kind", kinds(), ids=lambda kind: kind.name)
def test_every_parameter_of_every_kind_says_what_it_means(kind: KindView) -> None:
    for option, _, meaning in parameter_rows(kind):
        assert re.fullmatch(r"--[a-z][a-z0-9-]*", option)
        assert meaning


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (
            {"gauge_length_mm": "-3"},
            "'gauge_length_mm' of strain cannot be '-3': it should be greater than 0$",
        ),
        ({"gauge_length_mm": "3cm"}, "cannot be '3cm': it should be a number$"),
        (
            {"gauge_length": 3},
            "strain has no parameter 'gauge_length'; did you mean 'gauge_length_",
        ),
        ({"entirely": 3}, "strain has no parameter 'entirely'; its parameters are gauge_length_mm, "),
    ],
)
def test_a_parameter_is_refused_in_words(given: dict[str, object], message: str) -> None:
    with pytest.raises(InvalidInput, match=message):
        all_kinds()["strain"].parameters.checked("strain", given)


def test_help_after_a_kind_shows_its_parameters() -> None:
    shown = inside("job", "submit", "reconstruct", "--help")
    assert shown.returncode == 0
    for option in ("--priority", "--method", "--returns", "temporal-unwrapping"):
        assert option in shown.stdout
    assert "--method" not in inside("job", "submit", "--help").stdout.partition("Options")[2]
