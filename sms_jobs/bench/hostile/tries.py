"""Command lines for every command, made from what each says of its own options."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from random import Random
from types import NoneType
from typing import Any, Literal, get_args, get_origin

from sms_jobs.bench.hostile.things import ENVIRONMENTS, FITTING, NOWHERE
from sms_jobs.bench.hostile.values import NUMBERS, hostile_text, known_text

ENDLESS = frozenset(
    {"job wait", "job watch", "metrics", "rig serve", "rig simulate", "acquire show", "acquire run",
     "acquire resume", "acquire stream", "acquire plan watch"}
)  # fmt: skip
"""Commands that may go on until somebody interrupts them."""

HEAVY = frozenset({"up", "serve", "worker start", "demo", "bench", "study"})
"""Commands that are only tried with something that they must refuse at once."""

SLOW = frozenset(
    {"data pack", "data unpack", "archive verify", "archive repair", "archive reindex", "db backup",
     "db restore", "doctor", "calibration compare", "calibration check", "campaign exact", "init"}
)  # fmt: skip
COSTLY = 0.08
"""How often, among the others, a command is tried that takes seconds when it is not refused."""

_WRITTEN = frozenset({"out", "to", "home", "plan_out"})
"""Options that name what is written: none of them is led to a file of the machine."""


@dataclass(frozen=True)
class Try:
    """One command line.

    Attributes
    ----------
    command
        Its words, without options.
    arguments
        All of it.
    environment
        Settings that differ.
    endless
        Whether it may go on until it is interrupted.
    """

    command: str
    arguments: tuple[str, ...]
    environment: Mapping[str, str] = field(default_factory=dict)
    endless: bool = False


@dataclass(frozen=True)
class Leaf:
    """A command and its options."""

    name: str
    options: tuple[Any, ...]


def leaves(group: Any, above: str = "") -> Iterator[Leaf]:
    """Yield every command below a group of them."""
    for name in group.commands.keys():  # noqa: SIM118 - those of `sms` are loaded as they are asked for
        command = group.commands[name]
        path = f"{above} {name}".strip()
        if getattr(command, "commands", None) is not None:
            yield from leaves(command, path)
        else:
            yield Leaf(path, tuple(p for p in command.params if p.name != "help"))


def made(leaf: Leaf, rng: Random, things: Mapping[str, list[str]], homes: list[str], home: str) -> Try:
    """Return a command line for a command."""
    heavy = leaf.name in HEAVY
    words: list[str] = []
    positional: list[str] = []
    place = home
    for option in leaf.options:
        chance = rng.random()
        if option.name == "home" and option.opts[0].startswith("-"):
            astray = chance < 0.04 or heavy
            place = f"homes/{rng.choice(NOWHERE if heavy else homes)}" if astray else home
            words += ["--home", place]
            continue
        given = option.required or chance < 0.35 or (heavy and option.name in ("groups", "size", "threads"))
        if not given:
            continue
        flag = _plain(option.type_descriptor.annotation) is bool
        if flag:
            words.append(rng.choice((*option.opts, *option.secondary_opts)))
            continue
        values = _values(option, rng, things, always_hostile=heavy)
        if option.opts[0].startswith("-"):
            for value in values:
                joined = option.opts[0].startswith("--") and isinstance(value, str) and rng.random() < 0.5
                words += [f"{option.opts[0]}={value}"] if joined else [option.opts[0], *_several(value)]
        else:
            positional += [word for value in values for word in _several(value)]
    if positional and rng.random() < 0.5:
        positional = ["--", *positional]
    environment = rng.choice(ENVIRONMENTS) if rng.random() < 0.05 else {}
    arguments = (*leaf.name.split(), *words, *positional)
    return Try(leaf.name, arguments, environment, leaf.name in ENDLESS or "--wait" in words)


def _several(value: Any) -> list[str]:
    return [value] if isinstance(value, str) else list(value)


def _plain(kind: Any) -> Any:
    """Return a type without what says that it may be left out."""
    parts = [part for part in get_args(kind) if part is not NoneType]
    return parts[0] if NoneType in get_args(kind) and len(parts) == 1 else kind


def _values(option: Any, rng: Random, things: Mapping[str, list[str]], *, always_hostile: bool) -> list[Any]:
    kind = _plain(option.type_descriptor.annotation)
    if get_origin(kind) is list or kind is list or option.multiple:
        (kind,) = get_args(kind) or (str,)
        return [_value(kind, option, rng, things, always_hostile) for _ in range(rng.choice((1, 1, 1, 2, 3)))]
    if option.nargs > 1:
        return [[_value(float, option, rng, things, always_hostile) for _ in range(option.nargs)]]
    return [_value(kind, option, rng, things, always_hostile)]


def _value(kind: Any, option: Any, rng: Random, things: Mapping[str, list[str]], always_hostile: bool) -> str:
    hostile = always_hostile or rng.random() < 0.5
    if getattr(kind, "__name__", "") == "Path":
        return _path(option.name, rng, things, hostile)
    if kind in (int, float):
        usual = "1" if option.name != "bits" else "8"
        return rng.choice(NUMBERS) if hostile else usual
    choices = [str(getattr(c, "value", c)) for c in (get_args(kind) if get_origin(kind) is Literal else ())]
    choices = choices or [str(c.value) for c in getattr(kind, "__members__", {}).values()]
    if choices and not hostile:
        return rng.choice(choices)
    if not hostile:
        return known_text(rng, option.name)
    text = hostile_text(rng, option.name)
    while text in choices:
        text = hostile_text(rng, option.name)
    return text


def _path(name: str, rng: Random, things: Mapping[str, list[str]], hostile: bool) -> str:
    if name in _WRITTEN:
        if not hostile:
            return f"out/{rng.choice('ab')}{rng.choice(('', '.png', '.csv', '.ply', '.h5', '.vtu', '.npz'))}"
        return f"things/{rng.choice(things['odd'])}"
    fitting = FITTING.get(name, ())
    if fitting and rng.random() < 0.85:
        return f"things/{rng.choice(things[rng.choice(fitting)])}"
    return f"things/{rng.choice(things[rng.choice(sorted(things))])}"
