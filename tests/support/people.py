"""People who do something in the tests."""

from __future__ import annotations

from sms_jobs.records.people import Actor, Role

SOMEBODY = Actor("somebody", Role.ADMINISTRATOR, "command", "here", confirmed=True)
