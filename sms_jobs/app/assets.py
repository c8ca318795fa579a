"""What the console shows as reports do."""

from __future__ import annotations

from sms_jobs.formats import look


def style() -> str:
    """Return the style sheet that reports and the console share."""
    return look.look()
