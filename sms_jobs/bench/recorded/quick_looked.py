"""A test day with quick looks: how soon after the last frame of a state its gauges are read."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

from sqlalchemy import select

from sms_jobs import bootstrap
from sms_jobs.app.measuring import planned_recordings, quick_looks
from sms_jobs.app.measuring.planned_recordings import InTime
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.catalogue.tables.states import LoadStateRow
from sms_jobs.errors import ServerUnreachable, SmsError
from sms_jobs.jobs.archiving.registration import register_campaign
from sms_jobs.kinds.kind import MEASUREMENT
from sms_jobs.kinds.products import MEASURED, RECORDED
from sms_jobs.records.campaign import LoadState
from sms_jobs.records.gauge_limits import GaugeLimit, Look
from sms_jobs.records.measurement import FringeSequence
from sms_jobs.records.scene import Rigid, Speckle, UniaxialStrain
from sms_jobs.records.sensors import Sensor
from sms_jobs.records.shown.quick_looks import QuickLookView
from sms_jobs.virtual_rig.campaigns import Made, small_plate

CAMPAIGN = "looked"
SIDE = 1024
GAUGES = ("g1 x=0 y=0 length=60", "g2 x=20 y=-10 length=40 angle=90")
_VIEW = "C1P1"
_LIMIT = GaugeLimit("g1", "extension_mm", True, 100.0)
"""Never reached: with it the next state is rendered after the look, and takes no processor from it."""
_PATIENCE_S = 300.0
_RIG = f"""
name = "bench"
cameras = [{{ name = "C1", driver = "simulated", columns = {SIDE}, rows = {SIDE} }}]
projectors = [{{ name = "P1", driver = "simulated", columns = 1024, rows = 768 }}]
"""


@dataclass(frozen=True)
class Looked:
    """What came of looking at some states.

    Attributes
    ----------
    after_s
        From the last frame of each until the values of its gauges were there.
    looks
        What was found at each.
    """

    after_s: tuple[float, ...]
    looks: tuple[QuickLookView, ...]


def looked(home: Path, states: int, say: Callable[[str], None]) -> Looked:
    """Record a reference and so many states of a plate by a plan in a service, and look at each."""
    home.mkdir()
    bootstrap.initialise(home)
    calibration, campaign = _plate(states)
    (home / "rig.toml").write_text(_RIG)
    with bootstrap.services(home) as services, (home / "up.log").open("wb") as log:
        register_campaign(services.catalogue, services.archive, campaign, calibration, datetime.now(UTC))
        services.stations.add(home / "rig.toml", replace=False)
        planned_recordings.plan(services, CAMPAIGN, InTime(), look=Look(True, (_LIMIT,)))
        command = [sys.executable, "-P", "-m", "sms_jobs.cli.main", "up", "--home", str(home)]
        service = subprocess.Popen(
            command, env=os.environ, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT
        )
        try:
            found = _wait(services, states + 1, say)
        finally:
            service.terminate()
            service.wait()
        taken = [_last_frame(services, one.state) for one in found]
    after = [
        (one.looked_at - at).total_seconds() for one, at in zip(found, taken, strict=True) if one.looked_at
    ]
    return Looked(tuple(after[1:]), tuple(found[1:]))


def _plate(states: int) -> Made:
    """Return the small plate in 1 Mpx, with gauges, which moves and stretches from state to state."""
    calibration, campaign = small_plate(CAMPAIGN)
    assert campaign.scene is not None
    rig = replace(
        campaign.scene.rig,
        name="bench",
        sensors=tuple(_finer(s, SIDE if s.name == "C1" else 1024) for s in campaign.scene.rig.sensors),
    )
    loaded = [
        LoadState(
            f"S{n:02d}",
            1000.0 * n,
            deformation=(
                UniaxialStrain(0.002 * n, 0.3),
                Rigid((0.0, 0.0, 0.001 * n), (0.3 * n, -0.2 * n, 0.5 * n)),
            ),
        )
        for n in range(1, states + 1)
    ]
    campaign = replace(
        campaign,
        rig="bench",
        scene=replace(campaign.scene, rig=rig, speckle=Speckle(diameter_mm=1.0)),
        states=(LoadState("S00", 0.0), *loaded),
        views=(_VIEW,),
        sequence=FringeSequence(),
        processing={"gauges": {"gauge": "; ".join(GAUGES)}},
    )
    return replace(calibration, rig=rig), campaign


def _finer(sensor: Sensor, columns: int) -> Sensor:
    """Return a sensor with more pixels behind the same lens."""
    by, inner = columns // sensor.columns, sensor.intrinsics
    middle = 0.5 * (by - 1)
    return replace(
        sensor,
        columns=columns,
        rows=by * sensor.rows,
        intrinsics=replace(
            inner, fx=by * inner.fx, fy=by * inner.fy, cx=by * inner.cx + middle, cy=by * inner.cy + middle
        ),
    )


def _wait(services: Services, count: int, say: Callable[[str], None]) -> list[QuickLookView]:
    deadline, there = time.monotonic() + _PATIENCE_S, 0
    while time.monotonic() < deadline:
        time.sleep(0.2)
        with suppress(ServerUnreachable):
            found = quick_looks.show(services, CAMPAIGN)
            done = [one for one in found if one.looked_at is not None]
            if len(done) > there:
                there, deadline = len(done), time.monotonic() + _PATIENCE_S
                say(f"{there} of {count} states are looked at")
            if there == count:
                return done
    raise SmsError(f"nothing more was looked at within {_PATIENCE_S:.0f} s after {there} states")


def _last_frame(services: Services, label: str) -> datetime:
    """Return when the last frame of a state was taken."""
    with services.catalogue.reading() as session:
        path = session.scalars(
            select(FileRow.path)
            .join(LoadStateRow, LoadStateRow.id == FileRow.state_id)
            .where(FileRow.source == MEASUREMENT, LoadStateRow.label == label)
        ).one()
    with services.archive.open_unrecorded(path) as dataset:
        times = RECORDED.read(dataset).times_s
        return MEASURED.read(dataset).recorded_at + timedelta(seconds=float(times[-1]))
