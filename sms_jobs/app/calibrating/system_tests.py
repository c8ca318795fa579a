"""Tests of measuring systems: positions of artefacts in their volume, and what is decided of the errors.

What computes and reads files is imported by the functions that need it: who lists calibrations needs neither.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from math import inf, isfinite
from pathlib import Path
from typing import TYPE_CHECKING

from sms_jobs.app.calibrating import calibrations
from sms_jobs.app.rules import use_case
from sms_jobs.app.specimens import campaigns
from sms_jobs.app.writing import check_new_file, new_file
from sms_jobs.bootstrap import Services
from sms_jobs.errors import Conflict, InvalidInput, NotFound
from sms_jobs.records.people import Right
from sms_jobs.records.shown.system_tests import (
    CalibrationTested,
    ErrorSource,
    Judgement,
    MeasuredError,
    SystemVerdict,
)

if TYPE_CHECKING:
    from sms_jobs.app.holdings.reading import StoredRecord
    from sms_jobs.metrology.geometry.volume_positions import Position
    from sms_jobs.records.campaign import Campaign
    from sms_jobs.records.scene import Scene, Surface
    from sms_jobs.records.sensors import Calibration
    from sms_jobs.records.system_test import SystemTest

KIND = "system-test"


@dataclass(frozen=True)
class BarCertificate:
    """Of a ball bar, standard uncertainties; see `SystemTestParameters` of the job kind."""

    length_mm: float
    length_sigma_mm: float
    radius_mm: float
    radius_sigma_mm: float
    form_sigma_mm: float


@dataclass(frozen=True)
class PlateCertificate:
    """Of a flat plate: its size, and the standard uncertainty of its flatness."""

    width_mm: float
    height_mm: float
    form_sigma_mm: float


@dataclass(frozen=True)
class PlannedPosition:
    """Where an artefact is to stand: the state of a campaign."""

    campaign: str
    state: str
    artefact: str
    words: str
    middle_mm: tuple[float, float, float]


@use_case(Right.COMPUTE)
def plan(
    services: Services,
    rig: str,
    name: str,
    bar: BarCertificate | None,
    plate: PlateCertificate | None,
    like: str | None = None,
) -> list[PlannedPosition]:
    """Create the campaigns of a test: NAME-bar and NAME-plate, a state for each position.

    Positions fill the volume of the calibration that is used for the rig.

    Parameters
    ----------
    like
        A campaign of the same rig, whose views and, on the virtual rig, scene the new ones have; all views of
        the calibration if None.

    Raises
    ------
    InvalidInput
        There is no artefact, or one that has no size or does not fit in the volume.
    NotFound
        The rig has no calibration in use.
    Conflict
        There is a campaign of one of the names.
    """
    from sms_jobs.jobs.archiving.registration import register_campaign

    if bar is None and plate is None:
        raise InvalidInput("a test needs an artefact: give the certificate of a bar, of a plate, or of both")
    used = [one for one in calibrations.list_calibrations(services, rig) if one.in_use]
    if not used:
        raise NotFound(
            f"rig {rig} has no calibration in use, whose volume could be tested; certify one first"
        )
    calibration = calibrations.show(services, used[0].id).calibration
    pattern = None if like is None else campaigns.definition(services, like)
    if pattern is not None and pattern.rig != rig:
        raise InvalidInput(f"campaign {like} belongs to rig {pattern.rig}, not {rig}; choose one of that rig")
    made = []
    if bar is not None:
        made.append(_of_bar(f"{name}-bar", bar, calibration, pattern))
    if plate is not None:
        made.append(_of_plate(f"{name}-plate", plate, calibration, pattern))
    taken = set(campaigns.names(services))
    for campaign, _ in made:
        if campaign.name in taken:
            raise Conflict(f"there is a campaign {campaign.name} already; give the test another name")
    for campaign, _ in made:
        register_campaign(services.catalogue, services.archive, campaign, None, datetime.now(UTC))
    return [position for _, positions in made for position in positions]


def _of_bar(
    name: str, bar: BarCertificate, calibration: Calibration, like: Campaign | None
) -> tuple[Campaign, list[PlannedPosition]]:
    from sms_jobs.metrology.geometry.volume_positions import bar_positions
    from sms_jobs.records.artefacts import BallBar

    if not 0.0 < 2.0 * bar.radius_mm < bar.length_mm < inf:
        raise InvalidInput(
            "a bar's spheres have a radius above 0 mm and a distance above twice that, not "
            f"{bar.radius_mm:g} and {bar.length_mm:g} mm; give what its certificate says"
        )
    volume = calibration.volume
    stands = bar_positions(volume.low, volume.high, bar.length_mm, bar.radius_mm)
    shown = BallBar(bar.length_mm, bar.length_sigma_mm, bar.radius_mm, bar.radius_sigma_mm)
    parameters = {"artefact": shown.shape} | asdict(bar)
    scene = None if like is None or like.scene is None else _before(like.scene, shown)
    return _campaign(name, "ball bar", stands, parameters, calibration, like, scene)


def _of_plate(
    name: str, plate: PlateCertificate, calibration: Calibration, like: Campaign | None
) -> tuple[Campaign, list[PlannedPosition]]:
    import numpy as np

    from sms_jobs.metrology.geometry.volume_positions import plane_positions
    from sms_jobs.records.scene import Plane
    from sms_jobs.records.views import Role

    if not (0.0 < plate.width_mm < inf and 0.0 < plate.height_mm < inf):
        raise InvalidInput(
            f"a plate is wider and higher than 0 mm, not {plate.width_mm:g} x {plate.height_mm:g} mm; give "
            "the size of its flat side"
        )
    volume = calibration.volume
    centres = [s.pose.centre() for s in calibration.rig.sensors if s.role is Role.CAMERA]
    towards = np.mean(centres, axis=0)
    stands = plane_positions(volume.low, volume.high, plate.width_mm, plate.height_mm, towards)
    shown = Plane(plate.width_mm, plate.height_mm)
    parameters: dict[str, str | float] = {"artefact": shown.shape, "form_sigma_mm": plate.form_sigma_mm}
    scene = None if like is None or like.scene is None else _before(like.scene, shown)
    return _campaign(name, "plate", stands, parameters, calibration, like, scene)


def _before(scene: Scene, shown: Surface) -> Scene:
    """Return a virtual rig with an artefact before it; cameras alone need the texture of its specimen."""
    from dataclasses import replace

    from sms_jobs.records.scene import AT_ORIGIN
    from sms_jobs.records.views import Role

    fringes = any(sensor.role is Role.PROJECTOR for sensor in scene.rig.sensors)
    speckle = None if fringes else scene.speckle
    return replace(scene, surface=shown, speckle=speckle, gloss=None, placement=AT_ORIGIN)


def _campaign(
    name: str,
    artefact: str,
    stands: Sequence[Position],
    parameters: Mapping[str, str | float],
    calibration: Calibration,
    like: Campaign | None,
    scene: Scene | None,
) -> tuple[Campaign, list[PlannedPosition]]:
    from sms_jobs.records.campaign import Campaign, LoadState, Specimen
    from sms_jobs.records.measurement import FringeSequence
    from sms_jobs.records.scene import Rigid

    states = tuple(
        LoadState(
            one.label, deformation=(Rigid(one.rotation_rad, one.middle_mm),) if scene is not None else ()
        )
        for one in stands
    )
    described = "; ".join(f"{one.label} {one.words}" for one in stands)
    campaign = Campaign(
        name,
        Specimen(artefact, description=described),
        calibration.rig.name,
        states,
        calibration.rig.views() if like is None else like.shape_views,
        FringeSequence() if like is None else like.sequence,
        scene,
        {KIND: dict(parameters)},
    )
    told = [PlannedPosition(name, one.label, artefact, one.words, one.middle_mm) for one in stands]
    return campaign, told


@use_case(Right.READ)
def judge(
    services: Services, names: Sequence[str], limits: Mapping[str, float], risk: float
) -> SystemVerdict:
    """Judge the newest `system-test` results of campaigns of one rig against limits.

    Parameters
    ----------
    limits
        Largest error that is allowed, in mm, by quantity (`TESTED`).
    risk
        Largest probability that a decision is wrong, above 0 and below 0.5.

    Raises
    ------
    InvalidInput
        A limit or the risk is none, a quantity is unknown, no limit is given, or the campaigns are of several
        rigs.
    NotFound
        A campaign has no such result yet.
    """
    from sms_jobs.app.holdings import reading
    from sms_jobs.metrology.conformity import decide
    from sms_jobs.records.system_test import TESTED

    for quantity, limit in limits.items():
        if quantity not in TESTED:
            raise InvalidInput(f"no '{quantity}' is tested; give limits of {', '.join(TESTED)}")
        if not 0.0 < limit < inf:
            raise InvalidInput(
                f"the limit of {quantity} is above 0 mm, not {limit:g}: give the largest error allowed"
            )
    if not limits:
        raise InvalidInput(f"nothing can be decided without a limit; give one of {', '.join(TESTED)}")
    rigs = dict.fromkeys(campaigns.definition(services, name).rig for name in names)
    if len(rigs) != 1:
        raise InvalidInput(f"one rig is judged at a time, not {len(rigs)}: {', '.join(rigs)}")
    values: list[MeasuredError] = []
    sources: list[ErrorSource] = []
    doubts: list[str] = []
    for name in dict.fromkeys(names):
        stored = reading.newest(services, name, KIND)
        values += _values(name, stored.record, limits)
        source, stale = _source(services, name, stored)
        sources.append(source)
        if stale:
            doubts.append(
                f"what is judged of {name} is not what would be measured now: {stale}; submit its shapes and "
                f"{KIND} again"
            )
        doubts += _taken_as_exact(name, stored, limits)
    tested = sorted({one.number for source in sources for one in source.calibrations})
    if len(tested) > 1:
        doubts.append(
            f"the errors were measured with calibrations {', '.join(map(str, tested))}: no one of them is "
            "tested at every position; record what was measured with another one again"
        )
    judgements = tuple(_judgement(q, limit, values, risk) for q, limit in limits.items())
    limited = [one for one in values if one.quantity in limits]
    missing = sum(one.missing for one in judgements)
    conformity = decide([one.probability for one in limited if one.probability is not None], risk, missing)
    whole = Judgement(
        "all of them",
        None,
        None,
        sum(one.values for one in judgements),
        missing,
        conformity.least,
        conformity.most,
        conformity.decision.value,
    )
    return SystemVerdict(
        next(iter(rigs)), risk, whole, judgements, tuple(values), tuple(sources), tuple(doubts)
    )


def _taken_as_exact(campaign: str, stored: StoredRecord, limits: Mapping[str, float]) -> list[str]:
    """Say which uncertainties of an artefact are 0 or were not given, where something is judged with them."""
    from sms_jobs.kinds.calibration.system_test import CERTIFIED

    given = stored.provenance.parameters
    judged = [name for name in CERTIFIED if name in limits and name in stored.record.quantities]
    resting = {name: [one for one in CERTIFIED[name] if not given.get(one)] for name in judged}
    exact = [name for name in judged if resting[name]]
    missing = dict.fromkeys(one for some in resting.values() for one in some)
    told = (
        f"the artefact of {campaign} counts as exact in {', '.join(exact)}: {', '.join(missing)} "
        f"{'is' if len(missing) == 1 else 'are'} 0; submit {KIND} again with what its certificate states"
    )
    return [told] if exact else []


def _source(services: Services, campaign: str, stored: StoredRecord) -> tuple[ErrorSource, str]:
    """Say where the errors of a campaign come from, and why others would be measured now; empty if none."""
    from sms_jobs.catalogue import search
    from sms_jobs.catalogue.campaigns import campaign_row
    from sms_jobs.jobs.results.stale import stale_files

    with services.catalogue.reading() as session:
        used = search.calibrations_used(session, stored.file.id)
        stale = stale_files(session, campaign_row(session, campaign), datetime.now(UTC))
    made = stored.provenance
    source = ErrorSource(
        campaign,
        stored.record.artefact,
        stored.record.certificate,
        stored.file.path,
        stored.file.content_hash,
        made.kind_version,
        made.program_version,
        made.created_at,
        tuple(CalibrationTested(one.id, one.valid_from, one.origin, one.content_hash) for one in used),
    )
    return source, stale.get(stored.file.id, "")


def _values(campaign: str, test: SystemTest, limits: Mapping[str, float]) -> list[MeasuredError]:
    from sms_jobs.metrology.conformity import conformance_probability

    found = []
    for k, quantity in enumerate(test.quantities):
        error, sigma, certified = (
            float(v[k]) if isfinite(v[k]) else None for v in (test.error, test.sigma, test.certified_sigma)
        )
        probability = None
        if quantity in limits and error is not None and sigma is not None:
            probability = conformance_probability(error, sigma, limits[quantity])
        found.append(
            MeasuredError(
                quantity,
                campaign,
                test.states[k],
                test.views[k],
                error,
                sigma,
                certified,
                int(test.points[k]),
                int(test.left_out[k]),
                test.missing[k],
                probability,
            )
        )
    return found


def _judgement(quantity: str, limit: float, values: Sequence[MeasuredError], risk: float) -> Judgement:
    """Judge a quantity; one that was not measured at all counts as a value that is missing."""
    from sms_jobs.metrology.conformity import decide

    own = [one for one in values if one.quantity == quantity]
    known = [one.probability for one in own if one.probability is not None]
    errors = [one.error_mm for one in own if one.error_mm is not None]
    missing = len(own) - len(known) or int(not own)
    found = decide(known, risk, missing)
    largest = max(errors, key=abs, default=None)
    return Judgement(
        quantity, limit, largest, max(len(own), 1), missing, found.least, found.most, found.decision.value
    )


@use_case(Right.READ)
def write(
    _services: Services, verdict: SystemVerdict, out: Path, *, force: bool = False
) -> tuple[Path, Path]:
    """Write the page and, beside it, the same as JSON; return both files.

    Raises
    ------
    InvalidInput
        `out` does not end in .html, or its folder is not there.
    Conflict
        There is such a file, and `force` is not given.
    """
    from sms_jobs.formats.report.page import page_writer
    from sms_jobs.formats.report.system_test import DEFINITIONS, DISCLAIMER, system_test_page

    numbers = out.with_suffix(".json")
    check_new_file(out, force, (".html",))
    check_new_file(numbers, force)
    with new_file(out, force, (".html",)) as part:
        page_writer(system_test_page(verdict))(part)
    about = {"schema": 1, "remark": DISCLAIMER, "definitions": DEFINITIONS} | asdict(verdict)
    with new_file(numbers, force) as part:
        part.write_text(json.dumps(about, indent=1, default=str, allow_nan=False) + "\n", encoding="utf-8")
    return out, numbers
