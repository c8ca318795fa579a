"""The commands of `sms`, each loaded when it is asked for: `sms --help` needs none of what they need."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import wraps
from importlib import import_module
from types import SimpleNamespace
from typing import Any, ClassVar

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_group

from sms_jobs.errors import InvalidInput
from sms_jobs.records.numbers import is_excessive


@contextmanager
def loading() -> Iterator[None]:
    """Look for no garbage in what is loaded within, which stays: that takes a sixth of a short command."""
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()


@dataclass(frozen=True)
class Command:
    """Where a command is.

    Attributes
    ----------
    help
        The first sentence of its help, as `sms --help` shows it.
    module
        In `sms_jobs`.
    function
        Of the module; empty for a group of commands, the module's `app`.
    """

    help: str
    module: str
    function: str = ""

    def load(self, name: str) -> Any:
        """Return the command itself."""
        with loading():
            module = import_module(f"sms_jobs.{self.module}")
        above = typer.Typer(rich_markup_mode="rich")
        if self.function:
            above.command(name)(getattr(module, self.function))
        else:
            above.add_typer(module.app, name=name)
        loaded = get_group(above).commands[name]
        _guard(loaded)
        return loaded


def _check_only_what_is_given(command: Any) -> None:
    """Let a command take the defaults of all that is asked of it as they are.

    Typer checks defaults, too, and loads pydantic's adapters for it, a twelfth of a short command.
    """
    parameters, seen = command.get_params, []

    def get_params(ctx: Any) -> list[Any]:
        found: list[Any] = parameters(ctx)
        for one in found:
            if one not in seen:
                seen.append(one)
                one.get_runtime_param = _only_given(one.get_runtime_param)
        return found

    command.get_params = get_params


def _only_given(checking: Callable[[], Any]) -> Callable[[], Any]:
    """Return what checks a parameter's value unless it is the default."""

    def coerce(value: Any, param: Any, ctx: Any) -> Any:
        kind = param.type_descriptor.annotation
        if value is None:
            return () if param.multiple or param.nargs == -1 else None
        if value is param.default and isinstance(kind, type) and isinstance(value, kind):
            return value
        return checking().coerce(value, param=param, ctx=ctx)

    return lambda: SimpleNamespace(coerce=coerce)


def _guard(command: Any) -> None:
    """Let a command, or those of a group, refuse what is given twice, and numbers that tell nothing."""
    for inner in getattr(command, "commands", {}).values():
        _guard(inner)
    _check_only_what_is_given(command)
    run = command.callback
    if run is None or getattr(command, "commands", None):
        return
    command.make_parser = _refusing_twice(command.make_parser)

    @wraps(run)
    def guarded(**given: Any) -> Any:
        for name, value in given.items():
            for one in value if isinstance(value, list | tuple) else (value,):
                if is_excessive(one):
                    raise InvalidInput(
                        f"{name.replace('_', '-')} cannot be {one}: give a number of usual size"
                    )
        return run(**given)

    command.callback = guarded


def _refusing_twice(make_parser: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Return what makes a parser that refuses an option of one value where it is given again."""

    def made(ctx: Any) -> Any:
        parser = make_parser(ctx)
        parse = parser.parse_args

        def parse_args(args: list[str]) -> Any:
            found = parse(args=args)
            _, _, given = found
            for one in () if ctx.resilient_parsing else given:
                valued = one.param_type_name == "option" and not (one.is_flag or one.multiple or one.count)
                if valued and given.count(one) > 1:
                    raise InvalidInput(
                        f"{max(one.opts, key=len)} has one value, and is given more than once: give it once"
                    )
            return found

        parser.parse_args = parse_args
        return parser

    return made


COMMANDS: Mapping[str, Command] = {
    "demo": Command(
        "Calibrate a simulated rig and measure a bending test with it, and compare with the exact truth.",
        "cli.demo",
        "demo",
    ),
    "init": Command("Make a home: folder, settings file and an empty catalogue.", "cli.service", "init"),
    "up": Command(
        "Serve: run queued jobs until Ctrl-C, which lets running jobs finish; twice kills them.",
        "cli.service",
        "up",
    ),
    "serve": Command(
        "Serve the console to browsers and the interface /api/v1 to programs, until Ctrl-C.",
        "cli.serve",
        "serve",
    ),
    "status": Command("Show campaigns, jobs by state, workers and disk.", "cli.service", "status"),
    "doctor": Command(
        "Check catalogue, archive, messages, workers, clock and disk; say what to do about each finding.",
        "cli.doctor",
        "doctor",
    ),
    "metrics": Command(
        "Serve numbers about jobs, queues, workers, archive and schedules to Prometheus, until Ctrl-C.",
        "cli.metrics",
        "metrics",
    ),
    "bench": Command(
        "Measure speed and accuracy on this machine, and compare them with the project's targets.",
        "bench.command",
        "bench",
    ),
    "study": Command(
        "Run a study again: its table on the screen, its picture and numbers in a folder.",
        "bench.command",
        "study",
    ),
    "campaign": Command("Campaigns: a specimen, its load states, and how they are measured.", "cli.campaign"),
    "job": Command("Jobs: submit, follow and mend them.", "cli.job"),
    "run": Command("Runs: results under a name, kept and compared.", "cli.run"),
    "acquire": Command("Recordings: states, with the instruments of a rig.", "cli.acquire"),
    "rig": Command("Rigs: the instruments that are connected to this host.", "cli.rig"),
    "queue": Command("Queues: what may begin, and in which order.", "cli.queue"),
    "schedule": Command("Schedules: jobs that are submitted at their time.", "cli.schedule"),
    "notify": Command("Notifications by mail and webhook.", "cli.notify"),
    "lock": Command("Devices that a job or a person holds.", "cli.lock"),
    "data": Command("Measurements and results in the archive.", "cli.data"),
    "import": Command(
        "Bring in what was made elsewhere: frames, images, readings, calibrations, surfaces.",
        "cli.importing.group",
    ),
    "speckle": Command("Speckle patterns for specimens.", "cli.speckle"),
    "archive": Command("The archive: is everything there, and as it was sealed?", "cli.archive"),
    "calibration": Command("Calibrations of rigs.", "cli.calibration.group"),
    "person": Command("People: their names, roles and passwords.", "cli.person"),
    "token": Command("Tokens: what lets programs in for a person.", "cli.token"),
    "audit": Command("The audit: who did what, and is it as it was written?", "cli.audit"),
    "worker": Command("Workers on this and other hosts.", "cli.worker"),
    "db": Command("The catalogue's database, and backups.", "cli.db"),
}


class _Loading(dict[str, Any]):
    """Commands by name, loaded when one is looked up."""

    def __init__(self, table: Mapping[str, Command]) -> None:
        super().__init__()
        self._table = table

    def __missing__(self, name: str) -> Any:
        return self.setdefault(name, self._table[name].load(name))

    def __contains__(self, name: object) -> bool:
        return name in self._table

    def keys(self) -> Any:
        return self._table.keys()


class Commands(TyperGroup):
    """A group of commands, by default all of `sms`, which shows them without loading them."""

    table: ClassVar[Mapping[str, Command]] = COMMANDS

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        _check_only_what_is_given(self)
        self.commands = _Loading(self.table)
        self._chosen = ""

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names in the order in which they are shown."""
        return list(self.table)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return the chosen command; of the others only what is shown of them."""
        if cmd_name not in self.table:
            return None
        if cmd_name == self._chosen:
            return self.commands[cmd_name]
        return TyperCommand(cmd_name, help=self.table[cmd_name].help)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Load the command that the first word names."""
        self._chosen = args[0] if args else ""
        return super().resolve_command(ctx, args)
