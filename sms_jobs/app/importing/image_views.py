"""Which cameras measure together: the views of a campaign that images are imported into."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from itertools import combinations
from math import degrees, isnan, radians
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from sms_jobs.errors import InvalidInput
from sms_jobs.formats.importers.frames import Arrangement, FoundTuple, abridged
from sms_jobs.formats.importers.inspection import Inspected
from sms_jobs.metrology.geometry.camera import Camera
from sms_jobs.metrology.geometry.common_view import CommonView, common_view
from sms_jobs.records.shown.times import valid_from
from sms_jobs.records.views import Role, View, view_of

if TYPE_CHECKING:
    from sms_jobs.records.campaign import Campaign
    from sms_jobs.records.sensors import Calibration

LARGEST_ANGLE_DEG = 75.0
"""Between the lines of sight of two cameras: beyond it a texture looks too different to be matched."""
_PER_SIDE = 9
"""Points along each side of the measurement volume at which it is asked who sees them."""


@dataclass(frozen=True)
class Views:
    """The views of a campaign, and why they are these where that is not said by whoever imports."""

    views: tuple[str, ...]
    remarks: tuple[str, ...] = ()


@dataclass(frozen=True)
class UsedCalibration:
    """A calibration that is used, from a time on: its number, and the sizes of sensors, in px, by name."""

    number: int
    valid_from: datetime
    sizes: Mapping[str, tuple[int, int]]


_Pair: TypeAlias = tuple[tuple[str, str], CommonView | None]


def views_asked_for(text: str, cameras: Sequence[str]) -> Views:
    """Return the views that are named; raise `InvalidInput` for what cannot be a view of these cameras."""
    views = tuple(str(view_of(part)) for part in text.replace(",", " ").split())
    if not views or len({*views}) < len(views):
        raise InvalidInput(f"`views` should name each view once, as in 'C1C2 C2C3', not '{text}'")
    for view in map(view_of, views):
        if view.projectors:
            raise InvalidInput(
                f"the view {view} has a projector: its frames come in by 'sms import frames'; images are of "
                "several cameras, as C1C2, or of one alone, as C1"
            )
        unknown = [name for name in view.sensors if name not in cameras]
        if unknown:
            raise InvalidInput(
                f"the view {view} needs {', '.join(unknown)}, of which there is no image; there are images "
                f"of {', '.join(cameras)}"
            )
    return Views(views)


def views_of_all(cameras: Sequence[str], rig: str, calibration: tuple[int, Calibration] | None) -> Views:
    """Return the views of cameras that measure together where they can, in the order of the cameras.

    Two cameras are one view. Of more cameras those pairs are taken that see a part of the measurement volume
    together, from directions that differ little enough; without a calibration that tells, all of them.
    """
    pairs = [*combinations(cameras, 2)]
    if len(pairs) <= 1:
        return Views(tuple(str(View(a, (b,))) for a, b in pairs) or tuple(cameras))
    if calibration is None:
        words = (
            f"all {len(pairs)} pairs of {len(cameras)} cameras are taken, since rig {rig} has no calibration "
            "that shows which of them see the same thing: give `views` to choose some"
        )
        return Views(tuple(str(View(a, (b,))) for a, b in pairs), (words,))
    taken: list[_Pair] = []
    left: list[_Pair] = []
    for pair in pairs:
        found = _common(calibration[1], *pair)
        (taken if found is not None and found.usable > 0.0 else left).append((pair, found))
    paired = {name for pair, _ in taken for name in pair}
    alone = [name for name in cameras if name not in paired]
    remarks = [*_reasons(rig, calibration[0], taken, left)]
    if alone:
        measure = "measures in the plane of its" if len(alone) == 1 else "each measure in the plane of their"
        remarks.append(f"{' and '.join(alone)} {measure} own image, without a partner")
    return Views((*(f"{a}{b}" for (a, b), _ in taken), *alone), tuple(remarks))


def _reasons(rig: str, number: int, taken: Sequence[_Pair], left: Sequence[_Pair]) -> Iterator[str]:
    by = f"by calibration {number} of rig {rig}"
    shares = ", ".join(f"{a}{b} ({100 * found.usable:.0f} %)" for (a, b), found in taken if found is not None)
    if shares:
        yield f"{by}, of the measurement volume these see so much together: {shares}"
    for (a, b), found in left:
        if found is None:
            why = "not both are in it"
        elif isnan(found.least_angle_rad):
            why = "they see nothing of the measurement volume together"
        else:
            why = (
                f"they see it from directions {degrees(found.least_angle_rad):.0f} deg apart or more, and "
                f"textures are matched up to {LARGEST_ANGLE_DEG:.0f}"
            )
        yield f"{a}{b} is not taken {by}: {why}"


def _common(calibration: Calibration, first: str, second: str) -> CommonView | None:
    """Return what two cameras see together of the measurement volume; None where one is not calibrated."""
    from sms_jobs.metrology.calibration.pair_points import box_grid  # loads more than the server needs

    cameras = {
        s.name: Camera(s.intrinsics, s.pose, s.columns, s.rows)
        for s in calibration.rig.sensors
        if s.role is Role.CAMERA
    }
    if not {first, second} <= {*cameras}:
        return None
    volume = calibration.volume
    grid = box_grid(np.array(volume.low), np.array(volume.high), _PER_SIDE)
    return common_view(cameras[first], cameras[second], grid, radians(LARGEST_ANGLE_DEG))


def cameras_together(campaign: Campaign) -> tuple[str, ...]:
    """Return the cameras that measure together with others: a state needs an image of each."""
    return tuple(dict.fromkeys(name for view in campaign.camera_views for name in view_of(view).sensors))


def lacking_by_state(
    arrangement: Arrangement, campaign: Campaign, there: Collection[tuple[str, str]]
) -> dict[str, tuple[str, ...]]:
    """Return the cameras of which states have no image, neither here nor `there`, by state and camera."""
    known, together = {*there} | {(t.state, t.view) for t in arrangement.tuples}, cameras_together(campaign)
    found = {s: tuple(name for name in together if (s, name) not in known) for s in arrangement.states}
    return {state: names for state, names in found.items() if names}


def of_whole_states(arrangement: Arrangement, lacking: Mapping[str, Sequence[str]]) -> Arrangement:
    """Add a fault to the images of states that lack one of a camera which measures together with others."""

    def checked(one: FoundTuple) -> FoundTuple:
        if one.state not in lacking:
            return one
        fault = (
            f"state {one.state} has no image of {' and '.join(lacking[one.state])}: add it and import again "
            "with `add_states`; until then nothing of the state is taken"
        )
        return replace(one, faults=abridged([*one.faults, fault]))

    return replace(arrangement, tuples=tuple(map(checked, arrangement.tuples)))


def calibration_at(used: Sequence[UsedCalibration], at: datetime) -> UsedCalibration | None:
    """Return the calibration that holds at a time: the last that is valid by then."""
    return next((one for one in reversed(used) if one.valid_from <= at), None)


def of_calibrated_size(
    inspected: Sequence[Inspected],
    campaign: Campaign,
    used: Sequence[UsedCalibration],
    recorded_at: datetime | None,
) -> list[Inspected]:
    """Add a fault to images, of cameras that measure together, of another size than is calibrated."""
    together, checked = cameras_together(campaign), []
    for one in inspected:
        held = calibration_at(used, recorded_at or one.recorded_at)
        size = None if held is None else held.sizes.get(one.found.view)
        about = next(iter(one.facts.values()), None)
        measures = one.found.view in together and not one.found.faults
        if size and about and measures and (about.columns, about.rows) != size:
            assert held is not None
            fault = (
                f"it has {about.columns} x {about.rows} px, and calibration {held.number} of rig "
                f"{campaign.rig} is of {one.found.view} with {size[0]} x {size[1]}: import it "
                "uncropped, or name the rig that recorded it"
            )
            one = replace(one, found=replace(one.found, faults=abridged([*one.found.faults, fault])))
        checked.append(one)
    return checked


def with_their_partners(inspected: Sequence[Inspected], campaign: Campaign) -> list[Inspected]:
    """Add a fault to images of states of which a camera that measures together with others has a fault."""
    together = cameras_together(campaign)
    refused: dict[str, list[str]] = {}
    for one in inspected:
        if one.found.view in together and one.found.faults:
            refused.setdefault(one.found.state, []).append(one.found.view)

    def checked(one: Inspected) -> Inspected:
        others = refused.get(one.found.state)
        if others is None or one.found.view not in together or one.found.faults:
            return one
        fault = (
            f"nothing of state {one.found.state} is taken, for its image of {' and '.join(others)} has a "
            "fault: mend that, or leave the state out"
        )
        return replace(one, found=replace(one.found, faults=(fault,)))

    return list(map(checked, inspected))


def without_calibration(
    inspected: Sequence[Inspected],
    campaign: Campaign,
    used: Sequence[UsedCalibration],
    recorded_at: datetime | None,
) -> tuple[str, ...]:
    """Say that cameras which measure together have no calibration for when their images were recorded, or by
    what times one of several was chosen.
    """
    together = cameras_together(campaign)
    times = [
        recorded_at or one.recorded_at
        for one in inspected
        if one.found.view in together and not one.found.faults
    ]
    held = calibration_at(used, min(times)) if times else None
    if held is not None:
        strange = tuple(_strange(name, campaign, held) for name in together if name not in held.sizes)
        by_files = len(used) > 1 and recorded_at is None
        return (*strange, _chosen_by_files(times, campaign, used)) if by_files else strange
    if not times:
        return ()
    shape = f"{', '.join(campaign.shape_views)} of campaign {campaign.name}"
    if not used:
        words = (
            f"rig {campaign.rig} has no calibration, without which {shape} measures nothing: import one "
            f"with 'sms calibration import FILE --rig {campaign.rig}', or certify one that was measured"
        )
    else:
        words = (
            f"the first calibration of rig {campaign.rig} is {valid_from(used[0].valid_from)}, "
            f"and the first image was recorded at {min(times).isoformat()}: give `recorded_at`, or import "
            f"an earlier calibration, since {shape} measures nothing without one"
        )
    return (words,)


def _chosen_by_files(times: Sequence[datetime], campaign: Campaign, used: Sequence[UsedCalibration]) -> str:
    """Say which of several calibrations hold at the times of files, which copies of them may not have."""
    first, last = min(times), max(times)
    held = (calibration_at(used, at) for at in sorted(times))
    numbers = " and ".join(dict.fromkeys(str(one.number) for one in held if one is not None))
    return (
        f"by the times of the files, {first.isoformat(timespec='seconds')} to "
        f"{last.isoformat(timespec='seconds')}, calibration {numbers} of rig {campaign.rig} is used, of "
        f"{len(used)}: give `recorded_at` if these are not the times of recording"
    )


def _strange(camera: str, campaign: Campaign, held: UsedCalibration) -> str:
    """Say that a calibration does not have a camera that measures together with others."""
    views = ", ".join(view for view in campaign.shape_views if camera in view_of(view).sensors)
    return (
        f"calibration {held.number} of rig {campaign.rig} has no camera {camera}, without which {views} of "
        f"campaign {campaign.name} measures nothing: it has {', '.join(held.sizes)}"
    )
