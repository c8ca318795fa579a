"""How the application reaches its broker."""

from __future__ import annotations

from pathlib import Path

import pytest
from pydantic import SecretStr

from sms_jobs.settings import Settings
from sms_jobs.workers.celery_app import make_app


@pytest.mark.parametrize(
    ("given", "used"),
    [
        ("redis://:pw@host:1/0", "redis://:pw@host:1/0"),
        ("rediss://:pw@host:1/0", "rediss://:pw@host:1/0?ssl_cert_reqs=required"),
        (
            "rediss://host/0?ssl_ca_certs=/ca.pem",
            "rediss://host/0?ssl_ca_certs=/ca.pem&ssl_cert_reqs=required",
        ),
        ("rediss://host/0?ssl_cert_reqs=none", "rediss://host/0?ssl_cert_reqs=none"),
    ],
)
def test_a_certificate_is_checked_unless_said_otherwise(tmp_path: Path, given: str, used: str) -> None:
    app = make_app(Settings(home=tmp_path, broker_url=SecretStr(given)))
    assert app.conf.broker_url == used
