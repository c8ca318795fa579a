"""How many of the thesis's published numbers are reproduced, each with a verdict."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from sms_jobs.bench.figures import Condition, Figure, Found, Group, Run
from sms_jobs.bench.groups.strain import warm_up
from sms_jobs.bench.published import PUBLISHED, Judged, in_chapters
from sms_jobs.bench.studies import study_named

_CHAPTERS = (5, 7)


def measure(run: Run) -> Iterator[Found]:
    """Yield how many numbers have a verdict, how many of these are met, and the conditions."""
    if run.quick:
        yield Figure("rows", None, "published numbers")
        yield Condition("rows", "left out: the studies behind it take minutes")
        return
    judged: list[Judged] = []
    for name in dict.fromkeys(one.study for one in PUBLISHED.values() if one.study):
        judged += study_named(name).run(run.say).judged
    yield from counted(judged)


def counted(judged: Sequence[Judged]) -> Iterator[Found]:
    """Yield how many numbers have a verdict and how many are met, with what is missed and what has none."""
    wanted = in_chapters(*_CHAPTERS)
    inside = [one for one in judged if one.published in wanted and one.verdict != "not measured"]
    yield Figure("rows", float(len(inside)), f"of {len(wanted)} published numbers of chapters 5 to 7")
    yield Figure("met", float(sum(one.verdict == "met" for one in inside)), f"of these {len(inside)}")
    without = [one for one in wanted if one.why_not]
    reasons = "; ".join(dict.fromkeys(one.why_not for one in without))
    yield Condition(
        "rows",
        "numbers that the thesis publishes as results in chapters 5 to 7, which a study compares with its "
        f"own and with exact truth; cameras of 512 px; {len(without)} have no study: {reasons}",
    )
    missed = [f"{one.published.place}, {one.published.what}" for one in judged if one.verdict == "missed"]
    yield Condition("met", f"missed, section 4.6 included: {'; '.join(missed) or 'none'}")


GROUP = Group("thesis", "the thesis's published numbers beside ours", warm_up, measure)
