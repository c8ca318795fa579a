"""The browser of the benchmarks, for tests that need it."""

from __future__ import annotations

import os

import pytest

from sms_jobs.bench.browser import Browser, find_browser

__all__ = ["Browser", "browser_or_skip"]


def browser_or_skip() -> str:
    """Return the path of a Chromium; skip the test where there is none, or fail it where CI=true."""
    found = find_browser()
    if found is not None:
        return found
    reason = "needs a Chromium: run ops/test.sh, or set SMS_TEST_BROWSER to its path"
    if os.environ.get("CI", "").lower() == "true" and os.environ.get("SMS_TEST_BROWSER") != "none":
        pytest.fail(reason)
    pytest.skip(reason)
