"""How many of the thesis's published numbers are reproduced, each with a verdict."""

from __future__ import annotations

from collections.abc import Iterator

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
    wanted = in_chapters(*_CHAPTERS)
    judged: dict[str, Judged] = {}
    for name in dict.fromkeys(one.study for one in PUBLISHED.values() if one.study):
        judged |= {one.key: one for one in study_named(name).run(run.say).judged}
    inside = [
        one
        for one in judged.values()
        if one.published.chapter in range(_CHAPTERS[0], _CHAPTERS[1] + 1) and one.verdict != "not measured"
    ]
    yield Figure("rows", float(len(inside)), f"of {len(wanted)} published numbers of chapters 5 to 7")
    yield Figure("met", float(sum(one.verdict == "met" for one in inside)), f"of these {len(inside)}")
    missed = [
        f"{one.published.place}, {one.published.what}" for one in judged.values() if one.verdict == "missed"
    ]
    reasons = dict.fromkeys(one.why_not for one in wanted if one.why_not)
    without = sum(bool(one.why_not) for one in wanted)
    yield Condition(
        "rows",
        "numbers that the thesis publishes as results in chapters 5 to 7, which a study compares with its "
        f"own and with exact truth; cameras of 512 px; {without} have none: {'; '.join(reasons)}",
    )
    yield Condition("met", f"missed, section 4.6 included: {'; '.join(missed) or 'none'}")


GROUP = Group("thesis", "the thesis's published numbers beside ours", warm_up, measure)
