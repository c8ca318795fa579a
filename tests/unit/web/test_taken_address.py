"""A console that cannot listen says so, and not first that it serves."""

from __future__ import annotations

import socket
from pathlib import Path

from support.command import inside
from support.homes import initialised

from sms_jobs.errors import Conflict


def test_an_address_that_is_taken_is_refused_before_anything_is_served(home: Path) -> None:
    initialised(home)
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        refused = inside("serve", "--listen", f"127.0.0.1:{port}", "--home", str(home))
    assert refused.returncode == Conflict.exit_code
    assert (
        f"nothing can listen on 127.0.0.1, port {port}: Address already in use; stop what" in refused.stderr
    )
    assert "serving" not in refused.stderr
    nowhere = inside("serve", "--listen", "nowhere.invalid:8470", "--behind-proxy", "--home", str(home))
    assert nowhere.returncode == Conflict.exit_code
    assert "nothing can listen on nowhere.invalid, port 8470: " in nowhere.stderr
