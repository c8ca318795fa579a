"""What a test needs and does not find."""

from __future__ import annotations

import os
from typing import NoReturn

import pytest


def do_without(reason: str, *, insist: bool = True) -> NoReturn:
    """Skip a test that lacks what ops/test.sh installs; fail it where CI=true, which leaves nothing out.

    `insist` is False where ops/test.sh does not install it.
    """
    if insist and os.environ.get("CI", "").lower() == "true":
        pytest.fail(reason)
    pytest.skip(reason)
