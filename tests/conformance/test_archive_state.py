"""What was verified when, what is due and what is damaged, on both deployments."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from support.command import inside
from support.deployments import Deployment
from support.homes import make_home, stored
from support.over_http import app_of, served
from support.sealing import measurement

from sms_jobs import bootstrap
from sms_jobs.app.holdings import archive
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue.tables.checks import FileCheckRow
from sms_jobs.errors import Cancelled
from sms_jobs.jobs.keeping import archive_state, retention
from sms_jobs.jobs.keeping.archive_state import DUE_AFTER


@pytest.fixture
def services(
    deployment: Deployment, monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator
) -> Iterator[Services]:
    """A home with three small measurements beside the calibration of its rig and the decision to use it."""
    make_home(deployment.home, deployment.environment)
    for name, value in deployment.environment.items():
        monkeypatch.setenv(name, value)
    with bootstrap.services(deployment.home) as opened:
        for number in range(3):
            stored(opened, "simulate", "plate/S00/C1P1", {"measurement": measurement(rng)}, number)
        yield opened


def last_file(deployment: Deployment) -> Path:
    """Return the measurement that is damaged below."""
    return max((deployment.home / "archive").rglob("simulate-*.h5"))


def flip(path: Path) -> None:
    """Change a bit of a file, or change it back."""
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.chmod(0o644)
    path.write_bytes(content)


def test_what_was_compared_is_known_and_what_is_old_is_due(services: Services) -> None:
    before = archive.state(services)
    assert (before.due, before.newest, before.damaged) == (before.files, None, ())
    began = datetime.now(UTC)
    archive.verify(services, quick=True)
    assert archive.state(services) == before  # a quick look says nothing of contents
    archive.verify(services, campaign="plate")
    found = {one.campaign: one for one in archive.state(services).campaigns}
    assert (found["plate"].due, found["plate"].due_bytes, found["plate"].damaged) == (0, 0, 0)
    assert began < found["plate"].oldest <= found["plate"].newest  # type: ignore[operator]
    assert found[""].due == found[""].files > 0
    archive.verify(services)
    assert archive.state(services).due == 0
    with services.catalogue.reading() as session:
        later = archive_state.state(session, datetime.now(UTC) + DUE_AFTER + timedelta(seconds=1))
    assert (later.due, later.due_bytes) == (later.files, later.size_bytes)


def test_what_is_damaged_is_told_until_it_is_well_again(services: Services, deployment: Deployment) -> None:
    archive.verify(services)
    path = last_file(deployment)
    flip(path)
    assert archive.state(services).damaged == ()  # nobody has looked
    archive.verify(services, campaign="plate")
    (one,) = archive.state(services).damaged
    assert (one.problem, one.path) == ("corrupt", str(path.relative_to(deployment.home / "archive")))
    archive.verify(services, quick=True)
    assert archive.state(services).damaged == (one,)  # its size is what it was
    flip(path)
    archive.verify(services, campaign="plate")
    assert archive.state(services).damaged == ()
    path.unlink()
    archive.verify(services, quick=True)
    assert [one.problem for one in archive.state(services).damaged] == ["missing"]
    with services.catalogue.writing() as session:
        retention.forget(session, [one.file])
    assert archive.state(services).damaged == ()


def test_what_was_compared_before_somebody_broke_off_stays_known(services: Services) -> None:
    def passed(number: int) -> None:
        if number >= 3:
            raise Cancelled

    with pytest.raises(Cancelled):
        archive.verify(services, passed=passed)
    with services.catalogue.reading() as session:
        assert session.query(FileCheckRow).count() == 2


def test_the_command_tells_what_is_due_and_what_is_damaged(
    services: Services, deployment: Deployment
) -> None:
    def said() -> tuple[int, str, str]:
        words = ("archive", "state", "--home", str(deployment.home))
        done = inside(*words, environment={**deployment.environment, "COLUMNS": "200"})
        return done.returncode, done.stdout, done.stderr

    code, table, rest = said()
    count = archive.state(services).files
    assert (code, f"{count} of {count} files are due" in rest) == (0, True)
    assert "plate" in table
    flip(last_file(deployment))
    archive.verify(services)
    code, table, rest = said()
    assert (code, f"0 of {count} files are due" in rest) == (6, True)
    assert table.count("corrupt") == 1


def test_it_is_told_over_http_and_on_a_page(services: Services, deployment: Deployment) -> None:
    flip(last_file(deployment))
    archive.verify(services)
    with served(app_of(services)) as web:
        told = web.get("archive/state").json()
        page = web.get(str(web.base_url).removesuffix("/api/v1/") + "/archive/state").text
    assert told["damaged"][0]["problem"] == "corrupt"
    assert {one["campaign"] for one in told["campaigns"]} == {"", "plate"}
    assert told["damaged"][0]["path"] in page
    assert page.count('<span class="state bad">') == 1
