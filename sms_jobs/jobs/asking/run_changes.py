"""What was not the same when two runs computed their results: found from what is on record of each."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

from sms_jobs.jobs.asking.runs import Member, Members, ResultInput, in_order
from sms_jobs.kinds.kind import CALIBRATION
from sms_jobs.records.shown.runs import RunChange, What

_Key: TypeAlias = tuple[What, str, str]


@dataclass(frozen=True)
class _Found:
    """One thing that is not the same for one kind and subject."""

    key: _Key
    before: Any
    after: Any
    asked: bool


def pairs(before: Members, after: Members) -> list[tuple[Member, Member]]:
    """Return the results of the same kind and subject that both runs have, in order of kind and subject."""
    both = sorted(before.by_subject.keys() & after.by_subject.keys(), key=in_order)
    return [(before.by_subject[key], after.by_subject[key]) for key in both]


def alone(some: Members, others: Members) -> dict[str, int]:
    """Return how many results, by kind, one run has that the other has not."""
    return dict(
        sorted(Counter(kind for kind, _ in some.by_subject.keys() - others.by_subject.keys()).items())
    )


def changes(before: Members, after: Members) -> tuple[RunChange, ...]:
    """Return what was not the same, each thing once for all subjects, what was asked for first.

    What follows from another change, such as an input that the run itself has computed otherwise, is not
    told again. Of the campaign's definition it is told only where nothing else can have changed a result.
    """
    asked = _Asked(before.parameters, after.parameters)
    ours, theirs = _made_by(before), _made_by(after)
    found: dict[tuple[_Key, str], list[_Found]] = {}
    for mine, other in pairs(before, after):
        for one in _between(mine, other, ours, theirs, asked):
            # The files of inputs are of one subject; values are told apart.
            shown = "" if one.key[0] == "input" else repr((one.before, one.after))
            found.setdefault((one.key, shown), []).append(one)
    told = [
        RunChange(*key, some[0].before, some[0].after, len(some), some[0].asked)
        for (key, _), some in found.items()
    ]
    return tuple(sorted(told, key=lambda change: not change.intended))


@dataclass(frozen=True)
class _Asked:
    """What was asked of two runs, by `kind.name`."""

    before: Mapping[str, Any]
    after: Mapping[str, Any]

    def parameter(self, kind: str, name: str) -> bool:
        """Return whether a parameter was given otherwise."""
        full = f"{kind}.{name}"
        return self.before.get(full) != self.after.get(full)

    @property
    def version(self) -> bool:
        """Whether nothing but the version of the program can have been meant."""
        return self.before == self.after


def _made_by(run: Members) -> frozenset[str]:
    return frozenset(member.result.made_by for member in run.by_subject.values())


def _between(
    mine: Member, other: Member, ours: frozenset[str], theirs: frozenset[str], asked: _Asked
) -> Iterator[_Found]:
    """Yield what is not the same of two results of one kind and subject."""
    kind = mine.result.kind
    before, after = mine.result.parameters, other.result.parameters
    found = False
    for name in sorted(before.keys() | after.keys()):
        if before.get(name) != after.get(name):
            found = True
            key: _Key = ("parameter", kind, name)
            yield _Found(key, before.get(name), after.get(name), asked.parameter(kind, name))
    if mine.result.version != other.result.version:
        found = True
        yield _Found(("version", kind, ""), mine.result.version, other.result.version, asked.version)
    # What files that are gone were computed from is not on record any more.
    if mine.result.files and other.result.files:
        if mine.result.calibrations != other.result.calibrations:
            numbers = (_listed(mine.result.calibrations), _listed(other.result.calibrations))
            yield _Found(("calibration", "", ""), *numbers, False)
        for role in _other_inputs(mine, other):
            found = True
            if not _follows(mine.inputs.get(role), ours) or not _follows(other.inputs.get(role), theirs):
                named = (mine.result.inputs.get(role), other.result.inputs.get(role))
                yield _Found(("input", kind, role), *named, False)
    keys = (mine.reuse_key, other.reuse_key)
    if not found and None not in keys and keys[0] != keys[1]:
        yield _Found(("definition", kind, ""), None, None, False)


def _other_inputs(mine: Member, other: Member) -> Iterator[str]:
    """Yield the roles in which two results were given something else."""
    for role in sorted(mine.inputs.keys() | other.inputs.keys()):
        one, another = mine.inputs.get(role), other.inputs.get(role)
        if one is None or another is None or one.content_hash != another.content_hash:
            yield role


def _follows(given: ResultInput | None, own: frozenset[str]) -> bool:
    """Return whether the run has made an input itself, or it is a calibration, told by its number."""
    return given is None or given.job_id in own or given.source == CALIBRATION


def _listed(numbers: Iterable[int]) -> str:
    return ", ".join(map(str, numbers)) or "none"
