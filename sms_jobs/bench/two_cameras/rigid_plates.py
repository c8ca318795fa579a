"""A flat plate before two cameras that is shifted as a whole: its displacement is one known vector.

The virtual rig follows 2 x 2 rays a pixel, and what lies between them is missing: it costs a match
0.001 px, which is as much as the match itself is off without noise. Images are therefore the means of four
whose sensors lie an eighth of a pixel beside their place, which makes 4 x 4 rays, evenly spread.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import ceil

import numpy as np

from sms_jobs.kinds.kind import CALIBRATION, MEASUREMENT
from sms_jobs.kinds.shape import stereo
from sms_jobs.metrology.arrays import Floats
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.measurement import ArrayStack, Measurement
from sms_jobs.records.scene import CameraResponse, Plane, Rigid
from sms_jobs.records.sensors import Calibration, Sensor
from sms_jobs.records.subject import Subject
from sms_jobs.testing.shelf import Shelf
from sms_jobs.virtual_rig.campaigns import Made
from sms_jobs.virtual_rig.stereo_campaigns import stereo_campaign, stereo_rig

NOISELESS = CameraResponse(bits=16, full_well=1e12, read_noise=0.0)
STAND_OFF_MM = 500.0
_BETWEEN_RAYS_PX = tuple((x, y) for x in (-0.125, 0.125) for y in (-0.125, 0.125))


def shifted_plate(name: str, columns: int, rows: int, shifts_mm: Sequence[float]) -> Made:
    """Return the campaign of a plate that is shifted along its x axis, without noise.

    The plate fills half of the width of what is seen, so that it stays in both images.
    """
    rig = stereo_rig(columns, rows, stand_off_mm=STAND_OFF_MM)
    field_mm = STAND_OFF_MM * columns / rig.sensor("C1").intrinsics.fx
    plate = Plane(0.55 * field_mm, 0.6 * field_mm)
    shifts = tuple((Rigid(translation_mm=(shift, 0.0, 0.0)),) for shift in shifts_mm)
    return stereo_campaign(name, rig=rig, surface=plate, deformations=shifts, camera=NOISELESS)


def true_shift(campaign: Campaign, shift_mm: float) -> Floats:
    """Return the displacement in the world, (3,), of a plate shifted along its x axis."""
    assert campaign.scene is not None
    return np.asarray(shift_mm * campaign.scene.placement.matrix()[:, 0])


def search_range_px(campaign: Campaign, shift_mm: float) -> int:
    """Return how far seeds have to look for a shift, with a fifth to spare."""
    assert campaign.scene is not None
    return ceil(1.2 * shift_mm * campaign.scene.rig.sensor("C1").intrinsics.fx / STAND_OFF_MM)


def with_shape(
    calibration: Calibration, campaign: Campaign, say: Callable[[str], None], threads: int
) -> tuple[Shelf, tuple[Subject, ...]]:
    """Record all states with 4 x 4 rays a pixel, and measure their shapes; return the tuples."""
    shelf = Shelf(campaign, threads)
    subjects = tuple(Subject(campaign.name, state.label, campaign.views[0]) for state in campaign.states)
    for subject in subjects:
        say(f"recording and measuring {subject}")
        shelf.records[CALIBRATION, subject] = {"calibration": calibration}
        shelf.records.update(finely_recorded(campaign, subject, threads))
        shelf.run(stereo.KIND, subject, stereo.KIND.parameters())
    return shelf, subjects


def finely_recorded(
    campaign: Campaign, subject: Subject, threads: int
) -> dict[tuple[str, Subject], dict[str, Measurement]]:
    """Return what the cameras of a tuple record with 4 x 4 rays a pixel."""
    levels: dict[Subject, Floats] = {}
    for x, y in _BETWEEN_RAYS_PX:
        beside = Shelf(_beside(campaign, x, y), threads)
        beside.record(subject)
        for own in subject.recordings:
            recorded: Measurement = beside.records[MEASUREMENT, own]["measurement"]
            levels[own] = levels.get(own, 0.0) + recorded.texture.astype(np.float64)
    found = {}
    for own in subject.recordings:
        texture = np.rint(levels[own] / len(_BETWEEN_RAYS_PX)).astype(np.uint16)
        last = beside.records[MEASUREMENT, own]["measurement"]
        mean = replace(last, texture=texture, frames=ArrayStack(texture[None]), simulation=None)
        found[MEASUREMENT, own] = {"measurement": mean}
    return found


def _beside(campaign: Campaign, x_px: float, y_px: float) -> Campaign:
    """Return a campaign whose sensors lie beside their place, so that all is seen elsewhere in the image."""
    assert campaign.scene is not None

    def moved(sensor: Sensor) -> Sensor:
        lens = sensor.intrinsics
        return replace(sensor, intrinsics=replace(lens, cx=lens.cx + x_px, cy=lens.cy + y_px))

    rig = replace(campaign.scene.rig, sensors=tuple(map(moved, campaign.scene.rig.sensors)))
    return replace(campaign, scene=replace(campaign.scene, rig=rig))
