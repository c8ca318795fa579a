"""What is listed by view is in the order of the sensors: C2P1 before C10P1."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from support.command import answer
from support.homes import make_home, stored
from support.jobs import NOW

from sms_jobs import bootstrap
from sms_jobs.catalogue.campaigns import campaign_id
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.records.gauges import GaugeReadings
from sms_jobs.records.job import JobState
from sms_jobs.virtual_rig.campaigns import small_plate

VIEWS = ["C1P1", "C2P1", "C10P1"]
STATES = [state.label for state in small_plate("plate")[1].states]
WANTED = [(state, view) for state in STATES for view in VIEWS]


def test_gauges_are_in_the_order_of_states_and_sensors(home: Path) -> None:
    make_home(home, {})
    one = np.ones(1)
    read = GaugeReadings(
        "green-lagrange", ("G1",), one, one.astype(np.float32), np.ones((1, 3)), one.astype(np.int32)
    )
    with bootstrap.services(home) as services:
        for number, (state, view) in enumerate(reversed(WANTED)):
            stored(services, "gauges", f"plate/{state}/{view}", {"gauges": read}, number)
    rows = answer("data", "gauges", "-c", "plate", "--home", str(home))["gauges"]
    assert [(row["state"], row["view"]) for row in rows] == WANTED


def test_quick_looks_are_in_the_order_of_states_and_sensors(home: Path) -> None:
    make_home(home, {})
    with bootstrap.services(home) as services, services.catalogue.writing() as session:
        number = campaign_id(session, "plate")
        for position, (state, view) in enumerate(reversed(WANTED)):
            session.add(
                JobRow(
                    id=f"{position:016x}",
                    kind="quick-look",
                    kind_version=1,
                    campaign_id=number,
                    subject=f"plate/{state}/{view}",
                    parameters={},
                    queue="cpu",
                    position=position,
                    repeatable=True,
                    state=JobState.QUEUED,
                    submitted_at=NOW,
                )
            )
    looks = answer("acquire", "plan", "looks", "plate", "--home", str(home))
    assert [(one["state"], one["view"]) for one in looks] == WANTED
