"""A rig of two scanners with computers of their own, through the service: three homes on one machine."""

from __future__ import annotations

import os
import re
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.command import SMS, answer, inside, service, wait_until
from support.spools import complete_frames

from sms_jobs import bootstrap
from sms_jobs.archive import Archive, FolderStore
from sms_jobs.instruments.simulated.rig import SimulatedRig
from sms_jobs.jobs.archiving.registration import register_campaign
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.measurement import Measurement
from sms_jobs.records.sensors import Rig
from sms_jobs.virtual_rig.campaigns import Lens, aimed, small_plate

SCANNER = """
name = "scanner"
cameras = [{{ name = "C{n}", driver = "simulated", columns = 128, rows = 128 }}]
projectors = [{{ name = "P{n}", driver = "simulated", columns = 256, rows = 192, settle_ms = 40.0 }}]
"""
LENT = 'driver = "scanner", server = "{server}", key_file = \'{key}\''
CLIENT = """
name = "hall"
cameras = [
    {{ name = "C1", columns = 128, rows = 128, {one} }},
    {{ name = "C2", columns = 128, rows = 128, {two} }},
]
projectors = [
    {{ name = "P1", columns = 256, rows = 192, settle_ms = 40.0, {one} }},
    {{ name = "P2", columns = 256, rows = 192, settle_ms = 40.0, {two} }},
]
"""


class Scanner:
    """A home with a scanner, and the process that lends it."""

    def __init__(self, home: Path, number: int) -> None:
        self.home = home
        self.address = "127.0.0.1:0"
        bootstrap.initialise(home)
        (home / "scanner.toml").write_text(SCANNER.format(n=number))
        assert inside("rig", "add", str(home / "scanner.toml"), "--home", str(home)).returncode == 0
        self.start()

    def start(self) -> None:
        """Lend it, on the port that it had before."""
        self.process = subprocess.Popen(
            [*SMS, "rig", "serve", "scanner", "--listen", self.address, "--home", str(self.home)],
            env=os.environ | {"COLUMNS": "200"},
            stderr=subprocess.PIPE,
            text=True,
        )
        assert self.process.stderr is not None
        told = self.process.stderr.readline()
        found = re.fullmatch(r"serving scanner scanner on (\S+); clients need a copy of (\S+)\n", told)
        assert found, told
        self.address, self.key = found[1], found[2]

    def end(self, kill: bool = False) -> int:
        """End it in order, or not; return its exit code."""
        if kill:
            self.process.kill()
        else:
            self.process.terminate()
        code = self.process.wait(timeout=60)
        assert self.process.stderr is not None
        self.process.stderr.close()
        return code


@pytest.fixture
def scanners(tmp_path: Path) -> Iterator[tuple[Scanner, Scanner]]:
    with ExitStack() as stack:
        made = []
        for number in (1, 2):
            made.append(Scanner(tmp_path / f"scanner-{number}", number))
            stack.callback(made[-1].end)
        yield made[0], made[1]


@pytest.fixture
def campaign() -> Campaign:
    _, made = small_plate("plate")
    assert made.scene is not None
    second = aimed("C2", 128, 128, Lens(7.0, -0.08, 0.1, 0.0, 0.0), (200.0, 60.0, 1230.0))
    rig = Rig("hall", (made.scene.rig.sensors[0], second, *made.scene.rig.sensors[1:]))
    return replace(made, rig="hall", views=rig.views(), scene=replace(made.scene, rig=rig))


@pytest.fixture
def home(tmp_path: Path, scanners: tuple[Scanner, Scanner], campaign: Campaign) -> Path:
    home = tmp_path / "home"
    bootstrap.initialise(home)
    assert campaign.scene is not None
    calibration = replace(small_plate("plate")[0], rig=campaign.scene.rig)
    with bootstrap.services(home) as services:
        register_campaign(services.catalogue, services.archive, campaign, calibration, datetime.now(UTC))
    one, two = (LENT.format(server=s.address, key=s.key) for s in scanners)
    (home / "hall.toml").write_text(CLIENT.format(one=one, two=two))
    assert inside("rig", "add", str(home / "hall.toml"), "--home", str(home)).returncode == 0
    return home


def run(home: Path, *arguments: str) -> Any:
    return answer(*arguments, "--home", str(home))


def spooled(home: Path) -> int:
    """Return how many complete frames of the second projector are in the spool."""
    return complete_frames(home, "C1P2")


@pytest.mark.parametrize("whole", [False, pytest.param(True, marks=pytest.mark.long)])
def test_states_are_recorded_while_a_scanner_breaks_down(
    home: Path, scanners: tuple[Scanner, Scanner], campaign: Campaign, whole: bool
) -> None:
    with service(home):
        if whole:
            done = run(home, "acquire", "run", "plate", "--state", "S00", "--process")
            assert done["jobs"] == {"succeeded": 1}
        job = run(home, "acquire", "run", "plate", "--state", "S01", "--no-wait")["jobs"][0]
        wait_until(lambda: spooled(home) > 5)
        scanners[0].end(kill=True)
        wait_until(lambda: run(home, "acquire", "list")[0]["state"] == "needs-operator")
        (waiting,) = run(home, "acquire", "list")
        assert waiting["finished"] == ["C1P1", "C2P1"]
        assert f"the scanner at {scanners[0].address} does not answer" in waiting["reason"]
        scanners[0].start()
        assert run(home, "acquire", "resume", job)["jobs"] == {"succeeded": 1}
        assert run(home, "job", "wait", "-c", "plate")
    assert scanners[1].end() == 0
    scanners[1].start()
    archive = Archive(FolderStore(home / "archive"))
    files = run(home, "data", "find", "--kind", "measurement")
    assert len(files) == (8 if whole else 4)
    for row in files:
        with archive.open_unrecorded(row["path"]) as dataset:
            state = campaign.state(dataset.subject.state or "")
            found = dataset.read("measurement", Measurement)
            assert campaign.scene is not None
            rig = SimulatedRig(campaign.scene, state.label, state.deformation, found.recorded_at)
            expected = rig.record(str(dataset.subject.view), campaign.sequence)
            np.testing.assert_array_equal(found.texture, expected.texture)
            for k in (0, 17, 39):
                np.testing.assert_array_equal(found.frames.frame(k), expected.frames.frame(k))
