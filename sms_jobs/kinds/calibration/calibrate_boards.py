"""Calibrate from boards: every sensor of a rig from what views saw of a board in several poses.

From nothing, each sensor is first found by itself and all are brought into one world, that of the first
board. On site, the last calibration is the start: lenses are known to what it knew of them, and where the
sensors stand is found anew. Either way all is then adjusted together.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any

from pydantic import Field, field_validator

from sms_jobs.errors import CalibrationFailed
from sms_jobs.formats.report.calibration import calibration_page
from sms_jobs.formats.report.origins import origin_sections
from sms_jobs.formats.report.page import page_writer
from sms_jobs.kinds import defaults_of_kinds
from sms_jobs.kinds.calibration.board_doubts import board_doubts
from sms_jobs.kinds.calibration.held_parameters import (
    as_models,
    at_values,
    checked,
    checked_lenses,
    held_values,
    lenses_of,
    names_of,
    parted,
    values_of,
)
from sms_jobs.kinds.calibration.seen_boards import Boards, board_views
from sms_jobs.kinds.calibration.session_adjustment import (
    Bars,
    Start,
    calibration_of,
    problem_of,
    quality_of,
    refusals,
    rigid_pose,
    start_from_last,
    start_of_rig,
    uncertainty_of,
)
from sms_jobs.kinds.calibration.session_doubts import doubts_of, why_unseen
from sms_jobs.kinds.calibration.sessions import (
    CALIBRATE_BOARDS,
    OBSERVED_BOARDS,
    SessionPlan,
    board_states,
    observations_of,
    observed,
    session_of,
    session_plan,
)
from sms_jobs.kinds.documents import Document, DocumentOutput
from sms_jobs.kinds.kind import CALIBRATION, DatasetOutput, Inputs, Kind, Need, Output, Port, Progress, Scope
from sms_jobs.kinds.parameters import Parameters
from sms_jobs.kinds.products import BOARD, CALIBRATED, QUALITY, UNCERTAINTY, Product
from sms_jobs.metrology.calibration.bundle.adjustment import adjust
from sms_jobs.metrology.calibration.bundle.cross_validation import cross_validate
from sms_jobs.metrology.calibration.bundle.problem import BundleOptions
from sms_jobs.metrology.calibration.bundle.result import Adjustment
from sms_jobs.metrology.calibration.starting.initialisation import initialise
from sms_jobs.metrology.geometry.lens import LENS
from sms_jobs.metrology.geometry.lens_field import fold_px
from sms_jobs.records.calibration import CalibrationQuality
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.sensors import Calibration
from sms_jobs.records.subject import Subject

PAGE = Document("calibration", "text/html")
LAST = Port("last", CALIBRATION, (CALIBRATED, UNCERTAINTY, QUALITY))
"""The calibration that a session on site starts from."""


class CalibrateParameters(Parameters):
    """What is adjusted, and what is reported of it."""

    lens: tuple[str, ...] = Field(
        (),
        description="models of the lenses: plain, rational (eight coefficients) or fisheye for all, or "
        "C1=fisheye for one; by default that of the calibration that it starts from, plain without one",
    )
    fixed: tuple[str, ...] | None = Field(
        None,
        description=f"parameters of every sensor that are held: any of {', '.join(LENS)}; one without a "
        "value keeps its first, which the page says; k2=0 holds it there, and none holds nothing; by default "
        "k3 of a plain lens",
    )
    huber: float = Field(
        3.0, gt=0.0, description="residual, in standard deviations, from which on it pulls no harder"
    )
    reject: float = Field(
        6.0, gt=0.0, description="residual, in standard deviations, beyond which an observation is left out"
    )
    folds: int = Field(
        5,
        ge=2,
        le=100,
        description="in how many parts poses are held out, each once, and measured by the rest",
    )
    figure_width_px: int = Field(640, ge=400, le=4000, description="width of the page's pictures")

    @field_validator("fixed", "lens", mode="before")
    @classmethod
    def _parted(cls, value: Any) -> Any:
        return None if value is None else parted(value)

    @field_validator("fixed")
    @classmethod
    def _known(cls, entries: tuple[str, ...] | None) -> tuple[str, ...] | None:
        return None if entries is None else checked(entries)

    @field_validator("lens")
    @classmethod
    def _models(cls, entries: tuple[str, ...]) -> tuple[str, ...]:
        return checked_lenses(entries)

    def options(self, threads: int) -> BundleOptions:
        """Return them as the adjustment takes them."""
        return BundleOptions(huber=self.huber, reject=self.reject, threads=threads)


def _subjects(campaign: Campaign) -> Iterable[Subject]:
    return (Subject(campaign.name),) if board_states(campaign) else ()


def _needs(campaign: Campaign, subject: Subject, parameters: CalibrateParameters) -> Iterable[Need]:
    yield from observations_of(campaign, OBSERVED_BOARDS, board_states(campaign))
    if session_of(campaign).starts_from == "last-calibration":
        yield LAST.of(subject)


def run(inputs: Inputs, parameters: CalibrateParameters, progress: Progress) -> Iterator[Output]:
    """Find first values, adjust everything together, and tell how accurate the result is."""
    plan: SessionPlan = inputs.context
    boards = observed(inputs, plan, OBSERVED_BOARDS, BOARD)
    progress(0.1, "looking for first values")
    start = from_last(inputs, plan, boards) if inputs.has(LAST) else _from_nothing(plan, boards, parameters)
    progress(0.3, "adjusting all sensors and boards together")
    origin = f"boards of session {plan.name}"
    yield from adjusted(inputs, plan, start, boards, {}, parameters, progress, origin)


def from_last(inputs: Inputs, plan: SessionPlan, boards: Boards) -> Start:
    """Return the start from the last calibration, and what it knew of the lenses."""
    return start_from_last(
        plan,
        inputs.read(LAST, CALIBRATED),
        inputs.read(LAST, UNCERTAINTY) if inputs.has(LAST, UNCERTAINTY) else None,
        inputs.read(LAST, QUALITY) if inputs.has(LAST, QUALITY) else None,
        boards,
    )


def _from_nothing(plan: SessionPlan, boards: Boards, parameters: CalibrateParameters) -> Start:
    views = board_views(plan, boards)
    world = next((p.label for p in plan.poses if p.label in boards), "")
    if not any(v.pose == world for v in views):
        reasons = {
            f"{one.camera}: {why_unseen(one)}": None for one in boards.get(world, ()) if why_unseen(one)
        }
        if not views:
            raise CalibrationFailed(
                f"nobody saw the board in any of {len(boards)} poses; of pose {world}, {'; '.join(reasons)}"
            )
        raise CalibrationFailed(
            f"nobody saw the board in pose {world}, which is to be the world's frame; record it again, or "
            f"start the session with another pose ({'; '.join(reasons)})"
        )
    found = initialise(
        views,
        {s.name: (s.columns, s.rows) for s in plan.session.sensors},
        board_in_world=rigid_pose(plan.session.board_in_world),
        world_pose=world,
        held=values_of(parameters.fixed),
        models=lenses_of(parameters.lens, {s.name: "plain" for s in plan.session.sensors}),
    )
    rig = start_of_rig(plan, {name: (s.intrinsics, s.pose) for name, s in found.sensors.items()})
    usable = frozenset((v.view.sensor, v.view.pose) for v in found.views)
    refused = refusals(r for r in found.refused if (r.sensor, r.pose) not in usable)
    origin = "the boards, each sensor by itself"
    wrong = {r.pose: r.reason for r in found.refused if r.wrong}
    return Start(rig, found.board_poses, world, origin, {}, usable=usable, refused=refused, wrong=wrong)


def adjusted(
    inputs: Inputs,
    plan: SessionPlan,
    start: Start,
    boards: Boards,
    bars: Bars,
    parameters: CalibrateParameters,
    progress: Progress,
    origin: str,
    doubts: tuple[str, ...] = (),
) -> Iterator[Output]:
    """Adjust a session and yield the calibration with all that is known of it, and the page about it."""
    models = lenses_of(parameters.lens, {s.name: s.intrinsics.model for s in start.rig.sensors})
    as_models(start.rig, models)
    start = at_values(start, values_of(parameters.fixed))
    fixed = {name: names_of(parameters.fixed, model) for name, model in models.items()}
    problem = problem_of(plan, start, boards, bars, fixed)
    options = parameters.options(inputs.threads)
    found = adjust(problem, options)
    progress(0.6, "measuring poses that take no part")
    held_out = cross_validate(problem, options, parameters.folds, found)
    calibration = calibration_of(plan, start, found, problem, origin)
    _check_unfolded(calibration)
    uncertainty = uncertainty_of(found)
    doubts = (*doubts, *board_doubts(problem, found), *doubts_of(start, boards, bars))
    quality = quality_of(plan, start, calibration, found, held_out, problem, boards, bars, doubts)
    quality = replace(quality, held=held_values(calibration.rig, parameters.fixed, models))
    progress(0.9, "writing the page")
    products: dict[Product[Any], Any] = {CALIBRATED: calibration, UNCERTAINTY: uncertainty, QUALITY: quality}
    yield DatasetOutput(inputs.subject, products, _statistics(calibration, quality, found))
    page = calibration_page(
        plan.name,
        start.rig,
        calibration,
        uncertainty,
        quality,
        parameters.figure_width_px,
        origin_sections(inputs.datasets, plan.name, defaults_of_kinds()),
    )
    yield DocumentOutput(inputs.subject, PAGE, f"{plan.name}-calibration.html", page_writer(page))
    progress(1.0, f"adjusted {quality.residuals} residuals in {quality.iterations} iterations")


def _check_unfolded(calibration: Calibration) -> None:
    """Refuse a lens that does not tell all rays of its image apart."""
    for sensor in calibration.rig.sensors:
        folded = fold_px(sensor.intrinsics, sensor.columns, sensor.rows)
        if folded is not None:
            at, reach = folded
            raise CalibrationFailed(
                f"the lens of {sensor.name} that fits the boards folds over {at:.0f} px from its principal "
                f"point, and its image reaches to {reach:.0f} px: show boards out to the corners, hold "
                f"the parameters that they do not determine (fixed=k2,k3), or take another lens "
                f"(lens=rational or fisheye)"
            )


def _statistics(calibration: Calibration, quality: CalibrationQuality, found: Adjustment) -> dict[str, float]:
    """Return what people search by."""
    statistics = {
        "residuals_count": float(quality.residuals),
        "iterations_count": float(quality.iterations),
        "warnings_count": float(len(quality.warnings)),
    }
    held_out = quality.held_out_bar_rms_mm()
    if held_out == held_out:
        statistics["held_out_bar_rms_mm"] = held_out
        statistics["held_out_bar_over_diagonal"] = held_out / calibration.volume.diagonal_mm
    every = (one for one in found.rms if one.of == "all")
    return statistics | {f"{one.type.replace(' ', '_')}_rms_{one.unit}": one.rms for one in every}


KIND = Kind(
    name=CALIBRATE_BOARDS,
    summary="calibrate a rig from poses of a board",
    version=12,
    scope=Scope.CAMPAIGN,
    parameters=CalibrateParameters,
    inputs=(OBSERVED_BOARDS, LAST),
    outputs=(CALIBRATED, UNCERTAINTY, QUALITY, PAGE),
    needs=_needs,
    run=run,
    subjects=_subjects,
    context=session_plan,
)
