"""What `sms archive verify` notices, on both deployments."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from support.archives import Clock, run_jobs
from support.command import answer, inside
from support.deployments import Deployment
from support.homes import make_home

from sms_jobs.archive import Archive
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.errors import NotFound
from sms_jobs.jobs.keeping import verification
from sms_jobs.jobs.planning.graph import Request


@pytest.fixture
def recorded(deployment: Deployment, catalogue: Catalogue, archive: Archive, clock: Clock) -> Deployment:
    """A home in which the small plate has been recorded."""
    make_home(deployment.home, deployment.environment)
    run_jobs(catalogue, archive, clock, [Request("simulate")])
    return deployment


def run(deployment: Deployment, *arguments: str) -> object:
    return answer(*arguments, "--home", str(deployment.home), environment=deployment.environment)


def findings(deployment: Deployment, *options: str) -> tuple[int, str]:
    done = inside(
        "archive", "verify", *options, "--home", str(deployment.home), environment=deployment.environment
    )
    return done.returncode, done.stdout


def frames(deployment: Deployment) -> list[Path]:
    return sorted((deployment.home / "archive").rglob("simulate-*.h5"))


def test_whatever_is_wrong_is_named_and_nothing_is_changed(recorded: Deployment) -> None:
    assert findings(recorded)[0] == 0
    first, second, third, fourth = frames(recorded)
    first.unlink()
    flipped = bytearray(second.read_bytes())
    flipped[len(flipped) // 2] ^= 1
    second.chmod(0o644)
    second.write_bytes(flipped)
    third.chmod(0o644)
    third.write_bytes(third.read_bytes()[:-1])
    shutil.copy(fourth, fourth.with_name(fourth.name.replace("-1.h5", "-2.h5")))
    fourth.with_name(f".{fourth.name}.0123456789abcdef.tmp").write_bytes(b"half")
    before = sorted((p, p.stat().st_mtime_ns) for p in (recorded.home / "archive").rglob("*"))
    code, said = findings(recorded)
    assert code == 6
    problems = [line.split()[0] for line in said.splitlines() if line.split()[:1]]
    for problem in ("missing", "unfinished", "unknown"):
        assert problems.count(problem) == 1
    assert problems.count("corrupt") == 2
    assert sorted((p, p.stat().st_mtime_ns) for p in (recorded.home / "archive").rglob("*")) == before
    # A quick look reads no file: a flipped bit leaves size and name as they were.
    code, said = findings(recorded, "--quick", "-c", "plate")
    assert (code, said.count("corrupt"), said.count("missing")) == (6, 1, 1)
    files = run(recorded, "data", "find", "--limit", "100")
    assert isinstance(files, list)
    last = max(f["id"] for f in files)
    code, said = findings(recorded, "--after", str(last), "-c", "plate")
    assert code == 0


def test_a_campaign_that_is_not_there_is_no_campaign_in_order(catalogue: Catalogue) -> None:
    with catalogue.reading() as session, pytest.raises(NotFound, match="there is no campaign 'palte'"):
        verification.extent(session, campaign="palte")
