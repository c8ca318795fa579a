"""`sms up --listen` is where the console is: nothing that is silently ignored, or cannot come true."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.command import answer, inside


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ("--listen 127.0.0.1:8999", "--listen 127.0.0.1:8999 is where the console would be: give --web, too"),
        ("--web --listen nowhere", "'nowhere' is no address and port; write it as 127.0.0.1:8470"),
        ("--web --listen 0.0.0.0:8999", "0.0.0.0 can be reached from other machines: 'sms serve' serves"),
    ],
)
def test_an_address_that_says_nothing_is_refused(tmp_path: Path, options: str, said: str) -> None:
    home = str(tmp_path / "home")
    answer("init", "--home", home)
    done = inside("up", *options.split(), "--until-idle", "--home", home, timeout=60.0)
    assert done.returncode == 2, done.stderr
    assert said in done.stderr
