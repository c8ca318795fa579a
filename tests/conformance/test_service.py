"""A whole campaign through the real service on both deployments, and what survives a kill."""

from __future__ import annotations

from collections import Counter
from typing import Any

import pytest
from support.command import answer, kill_all, service, sms, wait_until
from support.deployments import Deployment
from support.homes import make_home
from support.jobs import JOBS

from sms_jobs.jobs.asking import inquiry


def submit_all(deployment: Deployment) -> list[str]:
    found = run(deployment, "job", "submit", "simulate", "pipeline", "-c", "plate")
    jobs: list[str] = found["jobs"]
    return jobs


def run(deployment: Deployment, *arguments: str) -> Any:
    return answer(*arguments, "--home", str(deployment.home), environment=deployment.environment)


def results(deployment: Deployment) -> Counter[tuple[str, str, str]]:
    """Count what the archive holds: one file a kind, subject and name, if nothing is there twice."""
    files = run(deployment, "data", "find", "-c", "plate", "--limit", "1000")
    return Counter((f["source"], f["subject"], f["media_type"] + f["path"].rpartition("-")[2]) for f in files)


def files_on_disk(deployment: Deployment) -> set[str]:
    root = deployment.home / "archive"
    return {
        str(path.relative_to(root))
        for path in root.rglob("*")
        if path.is_file() and ".logs" not in path.parts and not path.name.endswith(".provenance.json")
    }


def files_in_catalogue(deployment: Deployment) -> set[str]:
    return {f["path"] for f in run(deployment, "data", "find", "--limit", "1000")}


def test_a_campaign_runs_to_its_report_and_again_by_reuse(deployment: Deployment) -> None:
    make_home(deployment.home, deployment.environment)
    with service(deployment.home, deployment.environment):
        first = submit_all(deployment)
        assert len(first) == JOBS
        assert run(deployment, "job", "wait", *first)["jobs"] == {"succeeded": JOBS}
        again = submit_all(deployment)
        assert run(deployment, "job", "wait", *again)["jobs"] == {"succeeded": JOBS}
    jobs = {job["id"]: job for job in run(deployment, "job", "list", "--limit", "1000")}
    assert all(jobs[i]["reused_from"] is None for i in first)
    assert all(jobs[i]["reused_from"] in first for i in again)
    found = results(deployment)
    assert set(found.values()) == {1}
    assert {"measurement", "reconstruct", "correlate", "strain", "merge", "export", "report", "assess"} <= {
        source for source, _, _ in found
    }
    assert files_on_disk(deployment) == files_in_catalogue(deployment)
    # On any host: all that another one needs are the catalogue and the archive.
    other = deployment.home.parent / "other"
    shared = {
        "SMS_DATABASE_URL": f"sqlite:///{deployment.home / 'catalogue.sqlite'}",
        "SMS_ARCHIVE": str(deployment.home / "archive"),
    }
    make_home(other, deployment.environment, "another")
    said = sms("job", "logs", first[0], "--home", str(other), environment=shared | deployment.environment)
    assert f"job {first[0]}: simulate plate/S00, attempt 1" in said.stdout, said.stderr


@pytest.mark.long  # every run of the tests kills more, over shorter jobs, in tests/faults
def test_a_campaign_survives_the_killing_of_its_service(deployment: Deployment) -> None:
    make_home(deployment.home, deployment.environment)
    jobs = submit_all(deployment)
    catalogue = deployment.catalogue()

    def busy_after(succeeded: int) -> dict[str, int] | None:
        """Return the counts when jobs run and more than some have succeeded."""
        with catalogue.reading() as session:
            counted = inquiry.counts(session)
        return counted if counted.get("running") and counted.get("succeeded", 0) > succeeded else None

    # First the worker alone is killed while it works: its supervisor starts another. Then everything at once.
    with service(deployment.home, deployment.environment) as supervisor:
        before = wait_until(lambda: busy_after(0))
        (worker,) = supervisor.children()
        kill_all(worker)
        wait_until(lambda: busy_after(before["succeeded"]))
        kill_all(supervisor)
    with catalogue.reading() as session:
        assert inquiry.counts(session)["running"] > 0
    with service(deployment.home, deployment.environment):
        assert run(deployment, "job", "wait", *jobs)["jobs"] == {"succeeded": JOBS}
    catalogue.close()
    assert set(results(deployment).values()) == {1}
    assert files_on_disk(deployment) == files_in_catalogue(deployment)
