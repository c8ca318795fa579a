"""Stereo fringes: shape by the fringes of a projector that nobody calibrated, beside one that was."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sms_jobs.bench.figures import Condition, Figure, Found, Group, Run
from sms_jobs.kinds.kind import CALIBRATION, Kind
from sms_jobs.kinds.shape import reconstruct, stereo_fringes
from sms_jobs.metrology.geometry.planes import trace
from sms_jobs.records.fields import Surface
from sms_jobs.records.reasons import Reason
from sms_jobs.records.subject import Subject
from sms_jobs.testing.shelf import Shelf
from sms_jobs.virtual_rig.stereo_campaigns import (
    curved,
    shared_fringes_campaign,
    shared_fringes_rig,
    stepped,
)

_MICRO = 1e3  # um / mm
_FAR = 10.0
_SURFACES = {"curved": curved, "stepped": stepped}
_TEXTURES = {"plain": 0.0, "speckled": 4.0}
_VIEWS: dict[str, Kind[Any]] = {"C1C2P1": stereo_fringes.KIND, "C1P1": reconstruct.KIND}


@dataclass(frozen=True)
class Judged:
    """How far the points of a view are off.

    Attributes
    ----------
    rms_um, score
        Root mean squares of errors, and of these in units of what is stated.
    far
        Number of valid points that are off by more than ten times what they state, or where nothing is.
    valid
        Part of what all sensors of the view see that has a point.
    """

    rms_um: float
    score: float
    far: int
    valid: float


def judged(surface: str, texture: str, columns: int, threads: int) -> dict[str, Judged]:
    """Return, by view, how far points are off on the virtual rig."""
    rig = shared_fringes_rig(columns, columns * 4 // 5)
    first = rig.sensor("C1")
    field_mm = float(np.linalg.norm(first.pose.centre())) * columns / first.intrinsics.fx
    calibration, campaign = shared_fringes_campaign(
        "shared", rig=rig, surface=_SURFACES[surface](field_mm), speckle_px=_TEXTURES[texture]
    )
    shelf = Shelf(campaign, threads)
    at_rest = Subject(campaign.name, "S00")
    shelf.record(at_rest)
    found = {}
    for view, kind in _VIEWS.items():
        subject = replace(at_rest, view=view)
        shelf.records[CALIBRATION, subject] = {"calibration": calibration}
        shelf.run(kind, subject, kind.parameters())
        measured: Surface = shelf.records[kind.name, subject]["surface"]
        exact = shelf.shape(subject)
        ok = measured.reason == Reason.VALID
        error = np.linalg.norm((measured.position - exact.xyz)[:, ok], axis=0)
        sigma = np.sqrt(trace(np.asarray(measured.covariance))[ok])
        found[view] = Judged(
            _MICRO * float(np.sqrt(np.nanmean(error**2))),
            float(np.sqrt(np.nanmean(np.square(error / sigma)))),
            int(np.count_nonzero(~(error <= _FAR * sigma))),
            float(ok[exact.seen & exact.lit].mean()),
        )
    return found


def warm_up() -> None:
    """Compile what both kinds call."""
    judged("curved", "plain", 160, 1)


def measure(run: Run) -> Iterator[Found]:
    """Yield the figures of every specimen, and their conditions."""
    columns = 320 if run.quick else 640
    for surface in _SURFACES:
        for texture in _TEXTURES:
            run.say(f"stereo fringes: {surface}, {texture}")
            both = judged(surface, texture, columns, run.threads)
            one, other = both["C1C2P1"], both["C1P1"]
            name = f"{surface}_{texture}"
            yield Figure(f"score_{name}", one.score, "1", 1.2, "at most")
            yield Figure(f"far_{name}", float(one.far), "1", 0.0, "at most")
            yield Figure(f"rms_{name}_um", one.rms_um, "um")
            yield Figure(f"valid_{name}", one.valid, "1")
            yield Figure(f"calibrated_rms_{name}_um", other.rms_um, "um")
            yield Figure(f"calibrated_valid_{name}", other.valid, "1")
    yield Condition(
        "rig",
        f"two cameras of {columns} x {columns * 4 // 5} px, 20 degrees apart at 500 mm, 12 bit, blur 0.5 px, "
        "a projector of 640 x 480 px above them, default sequence; speckles of 4 px; errors against the "
        "exact truth over all valid points, 'far' those beyond ten standard deviations, 'calibrated' the "
        "view C1P1",
    )


GROUP = Group(
    "stereo-fringes",
    "errors and honesty of shape by fringes that two cameras share, beside a calibrated projector",
    warm_up,
    measure,
)
