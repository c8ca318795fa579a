"""Room on the disks of archive and spool: the first page, `sms status` and `sms doctor` say the same."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from support.command import inside
from support.homes import make_home
from support.over_http import app_of, served
from support.places import mounted

from sms_jobs import bootstrap
from sms_jobs.jobs.devices import disks
from sms_jobs.records.sizes import size

SHARED = " free, shared with the spool"


def told(home: Path) -> tuple[str, str, str, int | None]:
    """Return what the first page, `sms status` and `sms doctor` say, and the number for programs."""
    with bootstrap.services(home, "web") as services, served(app_of(services)) as client:
        page = client.get(str(client.base_url).removesuffix("/api/v1/")).text
        number = client.get("status").json()["spool_free_bytes"]
    facts = json.loads(inside("status", "--json", "--home", str(home)).stdout)
    assert (facts["spool_free_bytes"] is None) == (number is None)
    checks = json.loads(inside("doctor", "--json", "--home", str(home)).stdout)["checks"]
    (disk,) = {check["found"] for check in checks if check["check"] == "disk"}
    return page, inside("status", "--home", str(home)).stdout, disk, number


def test_a_disk_that_both_share_is_told_once(home: Path) -> None:
    make_home(home, {})
    page, status, disk, number = told(home)
    assert number is None
    assert f"</span>{SHARED}" in page
    assert "<h2>Spool</h2>" not in page
    assert SHARED.replace(" free", "") in status
    assert "spool_free" not in status
    assert disk.endswith(SHARED)


def test_two_disks_are_both_told(home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_home(home, {})
    with mounted(tmp_path / "other") as other:
        # Which is made once something is recorded.
        monkeypatch.setenv("SMS_SPOOL", str(other.folder / "spool"))
        page, status, disk, number = told(home)
        free = disks.free_bytes(other.folder)
    assert number == free
    assert f'<h2>Spool</h2><p><span class="figure">{size(free)}</span> free' in page
    assert re.search(rf"^spool_free +{re.escape(size(free))}$", status, re.M)
    assert disk.endswith(f"; {size(free)} free in the spool")
    assert SHARED not in page + status + disk
