"""Provenance as other programs read it: a W3C PROV document in PROV-JSON.

W3C Recommendation PROV-DM (2013) for the meaning, W3C Member Submission PROV-JSON (2013) for the form. Files
are entities, jobs are activities, and people, programs and computers are agents.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any
from urllib.parse import quote

PREFIXES = {
    "sms": "urn:sms-jobs:term:",
    "file": "urn:sms-jobs:file:",
    "job": "urn:sms-jobs:job:",
    "agent": "urn:sms-jobs:agent:",
}


@dataclass(frozen=True)
class DocumentedFile:
    """A file as an entity.

    Attributes
    ----------
    path, content_hash
        In the archive.
    attributes
        Whatever else is known: numbers and texts by name.
    """

    path: str
    content_hash: str
    attributes: Mapping[str, Any]


@dataclass(frozen=True)
class DocumentedInput:
    """A file that an activity used, and as what."""

    role: str
    path: str


@dataclass(frozen=True)
class DocumentedActivity:
    """What made files: a job, or a person who brought one in.

    Attributes
    ----------
    name
        Unique among activities.
    started, ended
        None where nobody knows.
    program_version, host, operator
        Empty where nobody knows.
    attributes
        Kind, version, parameters and whatever else is known.
    used
        Its inputs.
    outputs
        Paths of its outputs, each with the time when it was made.
    """

    name: str
    started: datetime | None
    ended: datetime | None
    program_version: str
    host: str
    operator: str
    attributes: Mapping[str, Any]
    used: tuple[DocumentedInput, ...]
    outputs: tuple[tuple[str, datetime], ...]


def provenance_document(
    files: Iterable[DocumentedFile], activities: Iterable[DocumentedActivity]
) -> dict[str, Any]:
    """Return a PROV-JSON document of files and of what made them.

    Every input of an activity must be among the files; each output is derived from each input.
    """
    entities = {_file(one.path): _entity(one) for one in files}
    parts: dict[str, dict[str, Any]] = {
        name: {}
        for name in (
            "activity",
            "agent",
            "used",
            "wasGeneratedBy",
            "wasAssociatedWith",
            "actedOnBehalfOf",
            "wasDerivedFrom",
        )
    }

    def relate(kind: str, **ends: Any) -> None:
        attributes = {f"prov:{name}": value for name, value in ends.items() if value is not None}
        parts[kind][f"_:{kind}{len(parts[kind]) + 1}"] = attributes

    for one in activities:
        activity = f"job:{quote(one.name, safe='-._')}"
        parts["activity"][activity] = _activity(one)
        _associate(one, activity, parts["agent"], relate)
        for given in one.used:
            relate("used", activity=activity, entity=_file(given.path), role=given.role)
        for path, made_at in one.outputs:
            relate("wasGeneratedBy", entity=_file(path), activity=activity, time=made_at.isoformat())
            for given in one.used:
                relate(
                    "wasDerivedFrom",
                    generatedEntity=_file(path),
                    usedEntity=_file(given.path),
                    activity=activity,
                )
    return {"prefix": PREFIXES, "entity": entities} | parts


def _file(path: str) -> str:
    return f"file:{quote(path, safe='/-._')}"


def _qualified(name: str) -> dict[str, str]:
    return {"$": name, "type": "prov:QUALIFIED_NAME"}


def _entity(one: DocumentedFile) -> dict[str, Any]:
    attributes = {f"sms:{name}": value for name, value in one.attributes.items() if value is not None}
    return {
        "prov:type": _qualified("sms:File"),
        "prov:location": one.path,
        "sms:sha256": one.content_hash,
    } | attributes


def _activity(one: DocumentedActivity) -> dict[str, Any]:
    attributes: dict[str, Any] = {f"sms:{name}": v for name, v in one.attributes.items() if v is not None}
    if one.started is not None:
        attributes["prov:startTime"] = one.started.isoformat()
    if one.ended is not None:
        attributes["prov:endTime"] = one.ended.isoformat()
    return attributes


def _associate(one: DocumentedActivity, activity: str, agents: dict[str, Any], relate: Any) -> None:
    """Add the agents of an activity: the program acts for the person, on a computer."""
    program = person = None
    if one.program_version:
        program = f"agent:sms_jobs-{quote(one.program_version, safe='-._')}"
        agents[program] = {
            "prov:type": _qualified("prov:SoftwareAgent"),
            "prov:label": f"sms_jobs {one.program_version}",
            "sms:version": one.program_version,
        }
        relate("wasAssociatedWith", activity=activity, agent=program, role="program")
    if one.host:
        host = f"agent:host-{quote(one.host, safe='-._')}"
        agents[host] = {"prov:type": _qualified("sms:Computer"), "prov:label": one.host}
        relate("wasAssociatedWith", activity=activity, agent=host, role="computer")
    if one.operator:
        person = f"agent:person-{quote(one.operator, safe='-._')}"
        agents[person] = {"prov:type": _qualified("prov:Person"), "prov:label": one.operator}
        relate("wasAssociatedWith", activity=activity, agent=person, role="operator")
    if program and person:
        relate("actedOnBehalfOf", delegate=program, responsible=person, activity=activity)
