"""The groups of the service: honest about what they leave out, and no job is claimed twice."""

from __future__ import annotations

from pathlib import Path

import pytest

from sms_jobs.bench.figures import Figure, Run
from sms_jobs.bench.groups import all_groups, archive, jobs, recording
from sms_jobs.settings import load


def said(text: str) -> None:
    assert text


def test_the_groups_are_found() -> None:
    assert {"archive", "catalogue", "jobs"} <= all_groups().keys()


def test_the_archive_is_measured_and_its_figures_are_speeds(
    home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Speeds of frames of any size are speeds.
    monkeypatch.setattr(archive, "ROWS", 256)
    monkeypatch.setattr(archive, "COLUMNS", 320)
    figures = [f for f in archive.measure(Run(True, said, 1, home)) if isinstance(f, Figure)]
    assert all(f.value is not None and f.value > 0.0 for f in figures)
    names = {"write_frames_mb_s", "read_slab_mb_s", "seal_50mb_ms", "verify_mb_s"}
    assert names <= {f.name for f in figures}


def test_workers_that_compete_claim_no_job_twice(home: Path) -> None:
    jobs._register_long_test(home, 2)
    with jobs.bootstrap.services(home) as services, services.catalogue.writing() as session:
        jobs.submit(session, "long-test", [jobs.Request("simulate")], jobs.datetime.now(jobs.UTC))
    # `_contended` raises where two workers hold the same job; there are three jobs, one a state.
    assert jobs._contended(load(home).catalogue_url, 100) > 0.0


def test_recording_is_measured_from_camera_to_disk(home: Path) -> None:
    (home / "bench").mkdir()
    found = list(recording.measure(Run(True, said, 1, home / "bench")))
    figures = {f.name: f.value for f in found if isinstance(f, Figure)}
    assert figures["frames_4mpx_per_s"] > 0.0
    assert figures["slowest_second_frames"] is None  # so few frames last no second
    files = list((home / "bench" / "spool").glob("*.frames"))
    assert len(files) == 2
    # 2 orientations of 2 densities of 3 steps, and white, all of them whole.
    assert all(f.stat().st_size > 13 * 2 * recording.SIDE**2 for f in files)
