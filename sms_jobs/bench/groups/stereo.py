"""Stereo: shape, displacement and strain from two cameras, their errors, their honesty and their speed."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median

import numpy as np

from sms_jobs.bench.compared_fields import reported_over_observed
from sms_jobs.bench.figures import Condition, Figure, Found, Group, Run, Sense
from sms_jobs.bench.peers import NO_PEERS, Ratio, missing_peers, peers_folder
from sms_jobs.bench.two_cameras.compared_programs import (
    GT4_SPACING_PX,
    GT4_SUBSET_PX,
    differences_um,
    given_gt4,
)
from sms_jobs.bench.two_cameras.errors import (
    OUTLIER_PX,
    OUTLIER_SIGMAS,
    PointErrors,
    displacement_errors,
    shape_errors,
)
from sms_jobs.bench.two_cameras.peers import (
    SUBSET_PX,
    Case,
    Outcome,
    fields_here,
    measured_by,
    measured_here,
    prepare,
    rendered_plates,
)
from sms_jobs.bench.two_cameras.published import FOLDER, STATES, between_cameras, in_time, published
from sms_jobs.bench.two_cameras.rigid_plates import (
    STAND_OFF_MM,
    search_range_px,
    shifted_plate,
    true_shift,
    with_shape,
)
from sms_jobs.kinds.deformation import correlate, strain
from sms_jobs.kinds.shape import stereo
from sms_jobs.kinds.surface_ports import noise_covariance
from sms_jobs.metrology.arrays import Floats
from sms_jobs.records.fields import Surface
from sms_jobs.records.scene import Plane
from sms_jobs.records.scene import Surface as Shape
from sms_jobs.records.sensors import Rig
from sms_jobs.records.subject import Subject
from sms_jobs.testing.shelf import Shelf, reconstructed
from sms_jobs.virtual_rig.campaigns import Lens, Made
from sms_jobs.virtual_rig.stereo_campaigns import (
    TELEPHOTO,
    WIDE_ANGLE,
    curved,
    stepped,
    stereo_campaign,
    stereo_rig,
)

_MICRO = 1e3  # um / mm
_SHIFTS_MM = (10.0, 20.0)
_STATES = ("S01", "S02", "S03")
_GAUGE_LENGTH_MM = 10.0
_RATE_RADIUS, _RATE_SPACING, _TURNS = 15, 5, 5
_LENSES: dict[str, Lens] = {"telephoto": TELEPHOTO, "wide-angle": WIDE_ANGLE}
_PEERS = {"pyvale": 3.0, "al_dic": 10.0}
"""Programs, and by how much we want to be faster."""
_ROUNDS = 3
_CASES = {
    "shift": "pyvale's plate, rendered by riley, shifted by 5 mm along x and y, part of it out of the image",
    "hole": "pyvale's plate with a hole, rendered by riley, stretched by 0.1 mm, against its mesh",
}
_USUAL_UM = {"u": 2.0, "v": 2.0, "w": 6.0}
"""By how much programs of the field differ, in plane and out of plane."""
_SPECIMENS = {"curved": curved, "stepped": stepped}


@dataclass(frozen=True)
class Judged:
    """What came of a specimen before a lens.

    Attributes
    ----------
    shapes, displacements
        Errors at every state.
    strains
        Errors of strain in units of sigma, at every state but the reference; none of a stepped specimen.
    """

    shapes: list[PointErrors]
    displacements: list[PointErrors]
    strains: list[Floats]


def warm_up() -> None:
    """Compile what two cameras' images go through from frames to strain."""
    shelf, subject = reconstructed(*_specimen("curved", "telephoto", 160), lambda words: None, 1, ("S01",))
    for kind in (correlate.KIND, strain.KIND):
        shelf.run(kind, subject, kind.parameters())


def measure(run: Run) -> Iterator[Found]:
    """Yield the figures and their conditions."""
    yield from _translation(run)
    yield from _still(run)
    yield from _speed(run)
    yield from _specimens(run)
    yield from _published()
    yield from _peers(run)


def flat(field_mm: float) -> Plane:
    """Return a plate that fills most of a field of view that is `field_mm` wide."""
    return Plane(0.75 * field_mm, 0.58 * field_mm)


def _specimen(specimen: str, lens: str, columns: int) -> Made:
    """Return the campaign of a specimen that fills most of a lens's field of view."""
    rig, field_mm = _rig(lens, columns)
    return stereo_campaign(f"{specimen}-{lens}", rig=rig, surface=_SPECIMENS[specimen](field_mm))


def _rig(lens: str, columns: int) -> tuple[Rig, float]:
    """Return two cameras and the width in mm of what they see."""
    rig = stereo_rig(columns, _rows(columns), _LENSES[lens], STAND_OFF_MM)
    return rig, STAND_OFF_MM * columns / rig.sensor("C1").intrinsics.fx


def _rows(columns: int) -> int:
    return columns * 4 // 5


def _reference(subject: Subject, shelf: Shelf) -> Subject:
    return replace(subject, state=shelf.campaign.reference.label)


def _translation(run: Run) -> Iterator[Found]:
    columns, rows = (640, 536) if run.quick else (2448, 2048)
    calibration, campaign = shifted_plate("plate", columns, rows, _SHIFTS_MM)
    shelf, (reference, *shifted) = with_shape(calibration, campaign, run.say, run.threads)
    whole = np.count_nonzero(shelf.records["stereo", reference]["surface"].reason == 0)
    median, valid = [], []
    for shift, subject in zip(_SHIFTS_MM, shifted, strict=True):
        search = correlate.KIND.parameters(search_range_x_px=search_range_px(campaign, shift))
        shelf.run(correlate.KIND, subject, search)
        field = shelf.records["correlate", subject]["displacement"]
        known = field.reason == 0
        error = field.displacement[:, known] - true_shift(campaign, shift)[:, None]
        median.append(_MICRO * float(np.median(np.linalg.norm(error, axis=0))))
        valid.append(float(known.sum() / whole))
    yield Figure("translation_median_um", max(median), "um", 0.2, "at most")
    each = " and ".join(f"{m:.3f} um at {shift:g} mm" for m, shift in zip(median, _SHIFTS_MM, strict=True))
    yield Condition(
        "translation",
        f"median length of the error of displacement over all valid pixels, the worse of {each}: a plate at "
        f"{STAND_OFF_MM:g} mm shifted along its x axis, two cameras of {columns} x {rows} px at 20 degrees, "
        "4 x 4 rays a pixel, no noise, 16 bit, default parameters but the search range; "
        f"{min(valid):.1%} of what has a shape is valid",
    )


def _still(run: Run) -> Iterator[Found]:
    columns = 512 if run.quick else 800
    states = _STATES[:1] if run.quick else _STATES
    run.say("stereo: still specimens")
    wanted: tuple[tuple[str, Callable[[float], Shape], float, Sense], ...] = (
        ("", flat, 1.2, "at most"),
        ("_curved", curved, 0.8, "at least"),
    )
    for name, specimen, target, sense in wanted:
        rig, field_mm = _rig("telephoto", columns)
        still = tuple(() for _ in states)
        made = stereo_campaign("still", rig=rig, surface=specimen(field_mm), deformations=still)
        changes = _changes(made, states, run)
        rms = float(np.sqrt(np.mean(changes**2)))
        yield Figure(f"static_rms_over_bound{name}", rms, "1", target, sense)
    yield Condition(
        "static",
        f"rms change of Z from the first to the next {len(states)} recordings of what does not move over "
        f"what the covariance's part by noise says, over {len(changes)} pixels, cameras of {columns} x "
        f"{_rows(columns)} px, 12 bit; a plate, and a cylinder, whose matches leave over more than noise: "
        "that is in its covariance, but does not change; wanted 0.8 to 1.2",
    )


def _changes(campaign: Made, states: tuple[str, ...], run: Run) -> Floats:
    """Return the changes of Z of all pixels between the first state and others, in units of noise."""
    shelf, subject = reconstructed(*campaign, lambda words: None, run.threads, states)
    first: Surface = shelf.records["stereo", _reference(subject, shelf)]["surface"]
    found = []
    for state in states:
        again: Surface = shelf.records["stereo", replace(subject, state=state)]["surface"]
        both = (first.reason == 0) & (again.reason == 0)
        variance = sum(noise_covariance(one)[5][both].astype(np.float64) for one in (first, again))
        found.append((again.position[2] - first.position[2])[both] / np.sqrt(variance))
    return np.concatenate(found)


def _speed(run: Run) -> Iterator[Found]:
    columns = 512 if run.quick else 1024
    shelf, subject = reconstructed(*_specimen("curved", "telephoto", columns), run.say, run.threads, ("S01",))
    run.say("stereo: points per CPU-second")
    alone = replace(shelf, threads=1)
    states = (_reference(subject, shelf), subject)
    between = stereo.KIND.parameters(subset_radius_px=_RATE_RADIUS, shape_order=2, spacing_px=_RATE_SPACING)
    in_time = correlate.KIND.parameters(
        subset_radius_px=_RATE_RADIUS, shape_order=1, spacing_px=_RATE_SPACING
    )
    shape_s = sum(_process_seconds(lambda s=s: alone.run(stereo.KIND, s, between)) for s in states)  # type: ignore[misc]
    time_s = _process_seconds(lambda: alone.run(correlate.KIND, subject, in_time))
    found = alone.records["correlate", subject]
    x, y = (found["matches"].__dict__[axis].astype(np.int64) for axis in "xy")
    known = int(np.count_nonzero(found["displacement"].reason[y, x] == 0))
    yield Figure("points_per_cpu_s", known / (shape_s + time_s), "points / CPU-s", 5000.0)
    yield Condition(
        "points_per_cpu_s",
        f"nodes of a grid of {_RATE_SPACING} px with a valid displacement, {known} of {len(x)}, over all "
        "that it takes from the images of two states in memory to the displacement of every pixel with its "
        f"covariance: filters, seeds along rays, matches between the cameras of second order and their way "
        f"back, spreading and rays of both states ({shape_s:.2f} s), regions, seeds and matches in time of "
        f"first order, spreading and displacement ({time_s:.2f} s); subsets of {2 * _RATE_RADIUS + 1} px, "
        f"cylinder, two cameras of {columns} x {_rows(columns)} px, 12 bit; CPU time of the whole process, "
        f"one thread, of each job the least of {_TURNS}",
    )


def _process_seconds(work: Callable[[], object]) -> float:
    """Return the CPU time of a call, in s, of all threads: the least of some, once all is compiled."""
    taken = []  # the first turns also fetch memory from the system, which a worker has by its second job
    for _ in range(_TURNS):
        started = time.process_time()
        work()
        taken.append(time.process_time() - started)
    return min(taken)


def _specimens(run: Run) -> Iterator[Found]:
    columns = 480 if run.quick else 800
    states = _STATES[-1:] if run.quick else _STATES
    judged = {
        (specimen, lens): _judge(specimen, lens, columns, states, run)
        for specimen in _SPECIMENS
        for lens in _LENSES
    }
    every = [error for one in judged.values() for error in (*one.shapes, *one.displacements)]
    points, wrong = sum(len(one.length_mm) for one in every), sum(one.outliers for one in every)
    smooth, flat_faces = ([judged[name, lens] for lens in _LENSES] for name in _SPECIMENS)
    honest, of_steps = (
        reported_over_observed([e.normalised for one in some for e in one.displacements])
        for some in (smooth, flat_faces)
    )
    strained = reported_over_observed([e for one in smooth for e in one.strains])
    yield Figure("outliers_per_million", 1e6 * wrong / points, "1", 10.0, "at most")
    yield Figure("least_valid_part", min(one.valid_part for one in every), "1")
    yield Figure("sigma_reported_over_observed", honest, "1", 1.2, "at most")
    yield Figure("sigma_reported_over_observed_stepped", of_steps, "1", 1.2, "at most")
    yield Figure("strain_sigma_reported_over_observed", strained, "1", 1.2, "at most")
    each = "; ".join(f"{' '.join(name)} {_counted(one)}" for name, one in judged.items())
    yield Condition(
        "outliers_per_million",
        f"{wrong} of {points} pixels reported valid whose shape, or displacement, is off by more than "
        f"{OUTLIER_SIGMAS:g} sigma and, as the partner sees it, {OUTLIER_PX:g} px, or where there is "
        f"nothing: a cylinder, and a plate with a hole and a step that hides some of it, at rest and in "
        f"{len(states)} of three states (rigid, bent, stretched), before a hardly distorted and a wide-angle "
        f"lens, {columns} x {_rows(columns)} px, 12 bit, default parameters; outliers of shape and of "
        f"displacement: {each}",
    )
    yield Condition(
        "least_valid_part", "of the pixels whose point both cameras see, in the worst of these fields"
    )
    yield Condition(
        "sigma",
        "displacement of the cylinder, and of the plate with a step, both lenses, all states: one over the "
        "rms of the errors in units of sigma; strain of the cylinder the same, with gauge lengths of "
        f"{_gauge_length_mm('telephoto'):g} and "
        f"{_gauge_length_mm('wide-angle'):g} mm; wanted 0.8 to 1.2",
    )


def _published() -> Iterator[Found]:
    cross, moved = None, None
    if published():
        cross = float(np.nanmedian(between_cameras(2)))
        each = [in_time(state, 1) for state in STATES]
        moved = float(np.nanmedian(np.concatenate(each)))
        told = (
            "DICe's points and matches, subsets of 25 px; between the cameras of second order (of first "
            f"{np.nanmedian(between_cameras(1)):.3f} px), in time of first, by state "
            f"{', '.join(f'{np.nanmedian(one):.3f}' for one in each)} px"
        )
    else:
        told = f"left out: {FOLDER} is not there"
    yield Figure("gt4_cross_median_px", cross, "px", 0.03, "at most")
    yield Figure("gt4_displacement_median_px", moved, "px", 0.01, "at most")
    yield Condition("gt4", told)


def _peers(run: Run) -> Iterator[Found]:
    folder = peers_folder()
    if run.quick or folder is None:
        yield Figure("platehole_rms_um", None, "um", 0.5, "at most")
        yield Condition("platehole", f"left out: {'--quick' if run.quick else NO_PEERS}")
        return
    yield from _programs_on_published(run, folder)
    run.say("stereo: rendering plates")
    cases = rendered_plates(folder, run.folder)
    taken: dict[str, list[dict[str, Outcome]]] = {}
    for name, case in cases.items():
        prepare(case.given, run.folder / name)
        taken[name] = []
        for number in range(1, _ROUNDS + 1):
            run.say(f"stereo: {name}, round {number} of {_ROUNDS}")
            others = {program: measured_by(folder, program, run.folder / name) for program in _PEERS}
            taken[name].append({"here": measured_here(case.given), **others})
    hole = taken["hole"][0]["here"]
    yield Figure("platehole_rms_um", _rms_um(hole.errors_mm(cases["hole"])), "um", 0.5, "at most")
    yield Figure("platehole_valid_part", hole.valid_part(cases["hole"]), "1", 0.97)
    for program, target in _PEERS.items():
        ratios = {name: _ratio(rounds, program) for name, rounds in taken.items()}
        worst = min(ratios.values(), key=lambda ratio: median(ratio.rounds))
        yield worst.figure(f"points_per_cpu_s_over_{program}", target)
        told = "; ".join(f"{name}, {one.told()}" for name, one in ratios.items())
        yield Condition(f"points_per_cpu_s_over_{program}", told)
    for name, case in cases.items():
        each = "; ".join(_told(program, taken[name][0][program], case) for program in ("here", *_PEERS))
        yield Condition(f"platehole, {name}", f"{_CASES[name]}: {each}")
    yield Condition(
        "points_per_cpu_s_over",
        f"the lower of both cases; {SUBSET_PX} px, one thread, {_ROUNDS} rounds in turn, all from "
        "images to displacement, loading and compiling left out; here shape and covariance of every "
        "pixel are in it, and second order between the cameras, which the others do not have",
    )


def _ratio(rounds: list[dict[str, Outcome]], program: str) -> Ratio:
    """Return our rate over that of a program, round by round."""
    return Ratio(tuple(one["here"].points_per_cpu_s() / one[program].points_per_cpu_s() for one in rounds))


def _programs_on_published(run: Run, folder: Path) -> Iterator[Found]:
    """Yield by how much several programs differ on published images."""
    found = None
    if published():
        given = given_gt4()
        prepare(given, run.folder / "gt4")
        others = {}
        for program in _PEERS:
            run.say(f"stereo: gt4, {program}")
            others[program] = measured_by(folder, program, run.folder / "gt4")
        run.say("stereo: gt4, here")
        here, _, _ = fields_here(given)
        found = differences_um(here, others)
        moved = 1e3 * np.nanmedian(here, axis=(2, 3))
        each = "; ".join(", ".join(f"{length:+.2f}" for length in state) for state in moved)
        yield Condition("gt4_programs, here", f"medians of U, V and W in um: {each}")
        for (one, other), apart in found.items():
            yield Condition(f"gt4_programs, {one} - {other}", _each_state(apart))
    for program in _PEERS:
        last = None if found is None else np.nanmedian(np.abs(found["here", program][-1]), axis=1)
        for number, (axis, usual) in enumerate(_USUAL_UM.items()):
            value = None if last is None else float(last[number])
            yield Figure(f"gt4_{program}_{axis}_um", value, "um", usual, "at most")
    yield Condition(
        "gt4_programs",
        f"left out: {FOLDER} is not there"
        if found is None
        else "medians of the absolute differences of U, V and W in um, in brackets those of the differences, "
        "of each state from the first to the last, which the figures are of; in the frame of the reference "
        "camera (x right, y down, z along its axis). All programs are given the images, VIC-3D's calibration "
        f"and one outline; subsets of {GT4_SUBSET_PX} px, in time of first order, between the cameras of "
        f"second here and of first elsewhere, points {GT4_SPACING_PX} px apart; set "
        "besides is how far all look, and the noise that is stated here",
    )


def _each_state(apart: Floats) -> str:
    """Return in words by how much displacements (states, 3, n) in um differ."""
    middle, size = (np.nanmedian(one, axis=2) for one in (apart, np.abs(apart)))
    count = np.isfinite(apart).all(axis=(0, 1)).sum()
    each = (
        ", ".join(f"{s:.2f} ({m:+.2f})" for s, m in zip(*state, strict=True))
        for state in zip(size, middle, strict=True)
    )
    return f"{'; '.join(each)}; {count} points"


def _told(program: str, outcome: Outcome, case: Case) -> str:
    """Return in words what a program found."""
    errors = outcome.errors_mm(case)
    return (
        f"{program} {outcome.points_per_cpu_s():.0f} points / CPU-s, rms {_rms_um(errors):.3g} um and median "
        f"{_MICRO * float(np.median(errors)):.3g} um over {outcome.valid_part(case):.1%} of the specimen's "
        f"points, {outcome.spacing_px} px apart"
    )


def _rms_um(errors_mm: Floats) -> float:
    return _MICRO * float(np.sqrt(np.mean(errors_mm**2)))


def _gauge_length_mm(lens: str) -> float:
    """Return a gauge length that is as long in the image of either lens."""
    return _GAUGE_LENGTH_MM * TELEPHOTO.focal / _LENSES[lens].focal


def _counted(judged: Judged) -> str:
    return " and ".join(
        str(sum(error.outliers for error in errors)) for errors in (judged.shapes, judged.displacements)
    )


def _judge(specimen: str, lens: str, columns: int, states: tuple[str, ...], run: Run) -> Judged:
    """Measure a specimen before a lens and compare every valid pixel with the truth."""
    calibration, campaign = _specimen(specimen, lens, columns)
    shelf, last = reconstructed(calibration, campaign, run.say, run.threads, states)
    partner = calibration.rig.sensor("C2")
    judged = Judged([], [], [])
    for state in (campaign.reference.label, *states):
        subject = replace(last, state=state)
        surface = shelf.records["stereo", subject]["surface"]
        judged.shapes.append(shape_errors(surface, shelf.shape(subject), partner))
    for state in states:
        subject = replace(last, state=state)
        truth = shelf.truth(subject)
        shelf.run(correlate.KIND, subject, correlate.KIND.parameters())
        field = shelf.records["correlate", subject]["displacement"]
        judged.displacements.append(displacement_errors(field, truth, partner))
        if specimen == "curved":
            shelf.run(strain.KIND, subject, strain.KIND.parameters(gauge_length_mm=_gauge_length_mm(lens)))
            found = shelf.records["strain", subject]["strain"]
            ratio = ((found.strain - truth.strain(found.measure)) / found.sigma)[:, found.reason == 0]
            judged.strains.append(ratio[np.isfinite(ratio)])
    return judged


GROUP = Group(
    "stereo",
    "errors, honesty and speed of what two cameras measure together",
    warm_up,
    measure,
    missing_peers,
)
