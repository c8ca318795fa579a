"""Where a report comes from: every file that it was made of, and the commands that make them again."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from html import escape
from shlex import quote
from typing import Any, Protocol, runtime_checkable

from sms_jobs.formats.report.html import Cell, Markup, code, folded, paragraph, table
from sms_jobs.formats.report.page import Section
from sms_jobs.formats.report.tables import local_time
from sms_jobs.records.subject import Subject


class Origin(Protocol):
    """How a file of the archive came about."""

    @property
    def kind(self) -> str:
        """Name of the kind that made it."""
        ...

    @property
    def kind_version(self) -> int:
        """Version of that kind."""
        ...

    @property
    def subject(self) -> Subject:
        """What it is about."""
        ...

    @property
    def parameters(self) -> Mapping[str, Any]:
        """Of that kind, as JSON."""
        ...

    @property
    def created_at(self) -> datetime:
        """When it was made."""
        ...

    @property
    def program_version(self) -> str:
        """Version of this program."""
        ...

    @property
    def host(self) -> str:
        """Name of the computer."""
        ...

    @property
    def operator(self) -> str:
        """Name of the person."""
        ...


@runtime_checkable
class Traceable(Protocol):
    """A dataset that tells where it comes from, as those of the archive do."""

    @property
    def path(self) -> str:
        """Of the file in the archive."""
        ...

    @property
    def content_hash(self) -> str:
        """Of what it says."""
        ...

    @property
    def provenance(self) -> Origin:
        """How it came about."""
        ...


@dataclass
class _Alike:
    """Files that one command makes: of one kind and version, with the same parameters."""

    origin: Origin
    states: list[str] = field(default_factory=list)
    views: list[str] = field(default_factory=list)
    files: int = 0


def command(
    kind: str, campaign: str, states: Iterable[str], views: Iterable[str], changed: Mapping[str, Any]
) -> str:
    """Return the command that computes results; `changed` are parameters that differ from the defaults.

    States and views are named where not all are meant.
    """
    words = ["sms", "job", "submit", kind, "-c", campaign]
    for state in states:
        words += ["--state", state]
    for view in views:
        words += ["--view", view]
    for name, value in changed.items():
        words += [f"--{name.replace('_', '-')}", _setting(value)]
    return " ".join(quote(word) for word in words)


def _setting(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list | tuple):
        return ",".join(_setting(part) for part in value)
    return "" if value is None else str(value)


def commands(
    datasets: Iterable[Any], campaign: str, defaults: Mapping[str, Mapping[str, Any]]
) -> list[Markup]:
    """List the commands that compute a report's inputs again, with versions.

    Parameters
    ----------
    datasets
        The inputs.
    campaign
        Name of the campaign.
    defaults
        By kind that can be submitted, its parameters as JSON.
    """
    alike: dict[tuple[str, int, str], _Alike] = {}
    for dataset in datasets:
        if not isinstance(dataset, Traceable) or dataset.provenance.subject.campaign != campaign:
            continue
        made = dataset.provenance
        # What was brought in has a folder and files for parameters, each of its own: it is listed once.
        settings = dict(made.parameters) if made.kind in defaults else {}
        key = (made.kind, made.kind_version, json.dumps(settings, sort_keys=True))
        group = alike.setdefault(key, _Alike(made))
        group.files += 1
        for listed, name in ((group.states, made.subject.state), (group.views, made.subject.view)):
            if name is not None and name not in listed:
                listed.append(name)
    several = {kind for kind, _, _ in alike if sum(key[0] == kind for key in alike) > 1}
    rows: list[list[Cell]] = []
    for group in alike.values():
        made = group.origin
        written: Cell = "recorded or imported; it cannot be computed"
        if made.kind in defaults:
            known = defaults[made.kind]
            changed = {n: v for n, v in made.parameters.items() if n not in known or known[n] != v}
            states, views = (group.states, group.views) if made.kind in several else ([], [])
            written = code(command(made.kind, campaign, states, views, changed))
        rows.append([f"{made.kind}, version {made.kind_version}", made.program_version, group.files, written])
    words = paragraph(
        "Results with the same inputs, parameters and versions are reused, so that these commands change "
        "nothing where everything is as it was. The whole chain is: "
    )
    whole = Markup(f"<pre>{escape(f'sms job submit pipeline -c {quote(campaign)}')}</pre>")
    return [words, whole, table(["made by", "program", "files", "again by"], rows)]


def origin_sections(
    datasets: Mapping[str, Any],
    campaign: str,
    defaults: Mapping[str, Mapping[str, Any]],
) -> list[Section]:
    """Return the last sections of a page: the commands that make its inputs again, and its files."""
    return [
        Section("How to make this again", commands(datasets.values(), campaign, defaults)),
        Section("Where this comes from", origins(datasets)),
    ]


def origins(datasets: Mapping[str, Any]) -> list[Markup]:
    """List every file that a page was made of, by role."""
    rows: list[list[Cell]] = []
    for role, dataset in datasets.items():
        if not isinstance(dataset, Traceable):
            rows.append([role, None, None, None, None, None, None])
            continue
        made = dataset.provenance
        settings = json.dumps(dict(made.parameters), ensure_ascii=False)
        rows.append(
            [
                role,
                code(dataset.path),
                f"{made.kind}, version {made.kind_version}",
                folded("show", code(settings)) if made.parameters else None,
                f"{local_time(made.created_at)}, {made.operator} on {made.host}",
                made.program_version,
                code(dataset.content_hash[:16], title=dataset.content_hash),
            ]
        )
    header = ["used as", "file", "made by", "parameters", "when and by whom", "program", "content hash"]
    return [table(header, rows)]
