"""The page about a test of a measuring system: what a metrologist signs."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from sms_jobs.formats.report.certificate import doubts
from sms_jobs.formats.report.charts import Axis, Chart, Line, Point, charts
from sms_jobs.formats.report.html import Cell, Given, Markup, code, facts, paragraph, table
from sms_jobs.formats.report.page import Section, page
from sms_jobs.formats.report.tables import local_time
from sms_jobs.records.shown.system_tests import Judgement, MeasuredError, SystemVerdict
from sms_jobs.records.subject import Subject

_MICROMETRES = 1e3
DISCLAIMER = (
    "No conformity with a standard is claimed. The quantities follow the ideas of VDI/VDE 2634 parts 2 and 3 "
    "and of ISO 10360-13; number and arrangement of positions, artefacts, selection of points and the "
    "treatment of several views are this program's own, as defined below."
)
DEFINITIONS = {
    "probing-form": "span of the distances of a sphere's points from the sphere that fits them best, centre "
    "and radius free; of the two spheres the larger span",
    "probing-size": "diameter of that sphere less the certified one; of the two spheres the larger error",
    "sphere-distance": "distance of the centres of spheres of the certified radius less the certified one",
    "length": "distance of the centres and both measured radii, less the certified length over both spheres: "
    "as between the jaws of a calliper",
    "flatness": "span of the distances of a plate's points from the plane that fits them best",
}


def system_test_page(verdict: SystemVerdict) -> str:
    """Return the whole page."""
    words = (
        f"{verdict.whole.decision.capitalize()}: the probability that every error with a limit lies within "
        f"it, at the tested positions, is between {verdict.whole.least:.4f} and {verdict.whole.most:.4f}. "
        f"It is decided where the probability to be wrong is at most {verdict.risk:g}, undecided elsewhere."
    )
    about = [
        *doubts(verdict.doubts, "What to look at before this is signed"),
        Markup(f"<p><strong>{escape(words)}</strong></p>"),
        paragraph(DISCLAIMER),
    ]
    sections = [
        Section("Verdict", [_verdict(verdict)]),
        Section("Errors by position", [_figures(verdict)]),
        Section("Every value", [_values(verdict.values)]),
        Section("How it is decided", _rule(verdict.risk)),
        Section("Definitions", [facts(DEFINITIONS.items())]),
        Section("Where this comes from", [_sources(verdict), _calibrations(verdict)]),
        Section("Signed", [facts([(name, "_" * 40) for name in ("name", "date", "signature")])]),
    ]
    return page(f"Test of measuring system {verdict.rig}", about, sections)


def _verdict(verdict: SystemVerdict) -> Markup:
    header = [
        "quantity", "limit [µm]", "largest error [µm]", "values", "without value", "probability at least",
        "at most", "decision",
    ]  # fmt: skip
    every: Sequence[Judgement] = [*verdict.judgements, verdict.whole]
    rows: list[list[Cell]] = [
        [
            one.quantity,
            None if one.limit_mm is None else Given(_MICROMETRES * one.limit_mm),
            None if one.largest_mm is None else _MICROMETRES * one.largest_mm,
            one.values,
            one.missing,
            one.least,
            one.most,
            one.decision,
        ]
        for one in every
    ]
    return table(header, rows)


def _figures(verdict: SystemVerdict) -> Markup:
    """Chart each quantity over the positions, a line a view, between its limits."""
    limits = {one.quantity: one.limit_mm for one in verdict.judgements}
    states = list(dict.fromkeys(one.state for one in verdict.values))
    drawn = []
    for name in dict.fromkeys(one.quantity for one in verdict.values):
        own = [one for one in verdict.values if one.quantity == name and one.error_mm is not None]
        lines = [
            Line(view, tuple(_point(one) for one in own if one.view == view))
            for view in dict.fromkeys(one.view for one in own)
        ]
        limit = limits.get(name)
        if limit is not None:
            at = list(dict.fromkeys(one.state for one in own))
            for sign in (1.0, -1.0) if name not in ("probing-form", "flatness") else (1.0,):
                points = tuple(Point(state, sign * _MICROMETRES * limit) for state in at)
                lines.append(Line("limit" if sign > 0 else "lower limit", points))
        drawn.append(Chart(name, "µm", tuple(line for line in lines if line.points)))
    along = Axis("position", {state: float(place) for place, state in enumerate(states)}, names=True)
    return charts([one for one in drawn if one.lines], [along])


def _point(one: MeasuredError) -> Point:
    assert one.error_mm is not None
    sigma = None if one.sigma_mm is None else _MICROMETRES * one.sigma_mm
    return Point(one.state, _MICROMETRES * one.error_mm, sigma)


def _values(values: Sequence[MeasuredError]) -> Markup:
    header = [
        "quantity", "position", "view", "error [µm]", "u [µm]", "u of the certificate [µm]", "points",
        "left out", "probability within the limit", "why no value",
    ]  # fmt: skip
    rows: list[list[Cell]] = [
        [
            one.quantity,
            str(Subject(one.campaign, one.state)),
            one.view,
            _micrometres(one.error_mm),
            _micrometres(one.sigma_mm),
            _micrometres(one.certified_sigma_mm),
            one.points,
            one.left_out,
            one.probability,
            one.missing,
        ]
        for one in values
    ]
    return table(header, rows)


def _micrometres(value: float | None) -> float | None:
    return None if value is None else _MICROMETRES * value


def _rule(risk: float) -> list[Markup]:
    return [
        paragraph(
            "u is a standard uncertainty: the noise of the points, as their covariances state it, and the "
            "certificate of the artefact; for a span the noise of its two extreme points. What the artefact "
            "does beyond its certificate, by temperature or in its holder, is not in it. The calibration of "
            "the system is what is tested, and is not in it either."
        ),
        paragraph(
            "The rule is guarded acceptance after JCGM 106:2012. An error is taken as normally distributed "
            "with u, so that it lies within its limit with a probability p. All of several lie within with a "
            "probability of at least 1 less the sum of 1 - p, and at most the least p, however their errors "
            f"go together. 'Conform' needs the former to be at least {1.0 - risk:g}, 'not conform' the "
            f"latter to be at most {risk:g}; between them it is undecided. A position without a value may be "
            "anything, so that with one nothing is conform."
        ),
    ]


def _sources(verdict: SystemVerdict) -> Markup:
    header = ["campaign", "artefact", "certificate", "file", "content hash", "made by", "when"]
    rows: list[list[Cell]] = [
        [
            one.campaign,
            one.artefact,
            one.certificate,
            code(one.path),
            code(one.content_hash[:16], title=one.content_hash),
            f"system-test, version {one.kind_version}; sms_jobs {one.program_version}",
            local_time(one.created_at),
        ]
        for one in verdict.sources
    ]
    return table(header, rows)


def _calibrations(verdict: SystemVerdict) -> Markup:
    """Name what is tested: the system as it was calibrated."""
    rows: list[list[Cell]] = [
        [
            source.campaign,
            one.number,
            one.origin,
            local_time(one.valid_from),
            code(one.content_hash[:16], title=one.content_hash),
        ]
        for source in verdict.sources
        for one in source.calibrations
    ]
    return table(["campaign", "calibration tested", "origin", "valid from", "content hash"], rows)
