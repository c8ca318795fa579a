"""Parameters of a job kind as options of `sms job submit`: `--method fdr` beside `--set method=fdr`.

The kinds declare their parameters; the command knows none of them by name. What it does not know as an
option of its own it leaves among the words, from which `split_words` takes it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from difflib import get_close_matches
from typing import TYPE_CHECKING, Any

from typer.core import TyperCommand

from sms_jobs.cli import output
from sms_jobs.errors import InvalidInput

if TYPE_CHECKING:
    from sms_jobs.app.work.kinds import KindView

_WORDS = "sms_jobs.cli.kind_options.words"

CONTEXT = {"ignore_unknown_options": True}
"""Settings of a command whose words are given to `split_words`."""


def split_words(words: Sequence[str], own: Sequence[str] = ()) -> tuple[list[str], list[str]]:
    """Part the names of kinds from options, and return these as NAME=VALUE.

    `own` are the command's own options, one of which may be meant by what has no value.
    Raises `InvalidInput` for an option without a value and for options of several kinds.
    """
    kinds, settings = [], []
    left: Iterator[str] = iter(words)
    for word in left:
        if not word.startswith("--"):
            kinds.append(word)
            continue
        name, equals, value = word[2:].partition("=")
        if not equals:
            value = next(left, "--")
        if not name or value.startswith("--"):
            near = get_close_matches(word, own, 1, cutoff=0.8)
            if near:
                raise InvalidInput(f"there is no option '{word}'; did you mean '{near[0]}'")
            raise InvalidInput(f"'{word}' needs a value: write {word} VALUE, or --set NAME=VALUE")
        settings.append(f"{name.replace('-', '_')}={value}")
    if settings and len(kinds) != 1:
        raise InvalidInput(
            f"'--{settings[0].partition('=')[0]}' is a parameter of one kind, but there are {len(kinds)}: "
            "write --set KIND.NAME=VALUE"
        )
    return kinds, settings


def given_parameters(settings: Sequence[str]) -> dict[str, Any]:
    """Return the parameters of NAME=VALUE words; a value with commas is a list."""
    parameters: dict[str, Any] = {}
    for text in settings:
        name, equals, value = text.partition("=")
        if not equals or not name:
            raise InvalidInput(f"--set {text} is not NAME=VALUE; write it like --set gauge_length_mm=30")
        if name in parameters:
            raise InvalidInput(
                f"the parameter '{name}' is given more than once: give it once; 'sms job submit KIND --help' "
                "says how several values are written in one"
            )
        parameters[name] = value.split(",") if "," in value else value
    return parameters


def refuse_misspelt(kinds: Sequence[str], settings: Sequence[str], own: Sequence[str]) -> None:
    """Raise `InvalidInput` where a setting of a kind is one of the command's `own` options, misspelt."""
    # Which loads every kind.
    from sms_jobs.app.work.kinds import find_kind

    kind = find_kind(kinds[0]) if settings and len(kinds) == 1 else None
    if kind is None:
        return
    options = [option for option, _, _ in parameter_rows(kind)]
    for setting in settings:
        word = f"--{setting.partition('=')[0].replace('_', '-')}"
        near = get_close_matches(word, [*own, *options], 1, cutoff=0.8)
        if word not in options and near and near[0] in own:
            raise InvalidInput(
                f"there is no option '{word}', nor has {kind.name} such a parameter; did you mean '{near[0]}'"
            )


def parameter_rows(kind: KindView) -> list[tuple[str, Any, str]]:
    """Return option, default and description of each parameter of a kind."""
    return [(f"--{one.name.replace('_', '-')}", one.default, one.meaning) for one in kind.parameters]


class KindCommand(TyperCommand):
    """A command whose help shows the parameters of the kinds that stand before `--help`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Keep the words for the help; refuse a misspelt option of the command's own."""
        ctx.meta[_WORDS] = tuple(args)
        rest = super().parse_args(ctx, args)
        if not ctx.resilient_parsing:
            own = [name for one in self.params for name in one.opts]
            refuse_misspelt(*split_words(ctx.params["kind"], own), own)
        return rest

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Write the command's help, then that of the kinds."""
        from sms_jobs.app.work.kinds import find_kind

        super().format_help(ctx, formatter)
        for word in ctx.meta.get(_WORDS, ()):
            kind = find_kind(word)
            if kind is not None and kind.parameters:
                output.print_sentence(f"Parameters of {kind.name}: {kind.summary}")
                output.print_table(["option", "default", "meaning"], parameter_rows(kind), empty="")
