"""A headless Chromium, driven through its debugging pipe: no port, no driver program, no package.

Tests drive it too; where there is none, they and the benchmarks say so.
"""

from __future__ import annotations

import fcntl
import json
import os
import select
import shutil
import subprocess
import time
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import psutil

from sms_jobs.errors import SmsError

NAMES = (
    "chromium-headless-shell",
    "chromium",
    "chromium-browser",
    "google-chrome",
    "google-chrome-stable",
    "/Applications/Google Chrome.app/Contents/MacOS/Google Chrome",
)
_SECONDS = 60.0


def find_browser() -> str | None:
    """Return the path of a Chromium, or None; SMS_TEST_BROWSER names one elsewhere, or is 'none'."""
    named = os.environ.get("SMS_TEST_BROWSER")
    if named:
        return None if named == "none" else named
    return next((found for name in NAMES if (found := shutil.which(name))), None)


def _pipe() -> tuple[int, int]:
    """Return the reading and the writing end of a pipe, out of the way of the numbers that a browser uses."""
    ends = os.pipe()
    high = tuple(fcntl.fcntl(end, fcntl.F_DUPFD_CLOEXEC, 10) for end in ends)
    for end in ends:
        os.close(end)
    return high[0], high[1]


class Browser:
    """One page of a headless Chromium; it keeps what the page says and asks for.

    Attributes
    ----------
    complaints
        Errors of the console, and what the page's policy refused.
    requests
        Addresses that the page asked for, its own included.
    """

    def __init__(self, program: str, profile: Path, width: int = 1280, height: int = 900) -> None:
        (to_read, self._to), (self._from, to_write) = _pipe(), _pipe()
        options = [
            "--headless=new",
            "--no-sandbox",
            "--disable-gpu",
            "--disable-quic",
            "--no-first-run",
            "--disable-background-networking",
            "--disable-component-update",
            "--disable-sync",
            "--disable-extensions",
            "--disable-dev-shm-usage",
            "--use-angle=swiftshader",  # WebGL without a graphics card
            "--enable-unsafe-swiftshader",
            "--force-color-profile=srgb",
            f"--user-data-dir={profile}",
            f"--window-size={width},{height}",
            "--remote-debugging-pipe",
            "about:blank",
        ]
        # The browser reads descriptor 3 and writes 4.
        arranged = f'exec "$@" 3<&{to_read} 4>&{to_write}'
        self._process = subprocess.Popen(
            ["bash", "-c", arranged, "bash", program, *options],
            pass_fds=(to_read, to_write),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(to_read)
        os.close(to_write)
        self._session: str | None = None
        self._number = 0
        self._rest = b""
        self._happened: list[str] = []
        self.complaints: list[str] = []
        self.requests: list[str] = []
        targets = self._call("Target.getTargets")["targetInfos"]
        page = next(t["targetId"] for t in targets if t["type"] == "page")
        attached = self._call("Target.attachToTarget", targetId=page, flatten=True)
        self._session = attached["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        os.close(self._to)  # which ends it
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        os.close(self._from)

    def cpu_seconds(self) -> float:
        """Return the CPU time of all processes of the browser, in s."""
        root = psutil.Process(self._process.pid)
        times = [one.cpu_times() for one in (root, *root.children(recursive=True))]
        return float(sum(one.user + one.system for one in times))

    def call(self, method: str, **parameters: Any) -> Any:
        """Call a method of the page and return its result."""
        return self._call(method, session=self._session, **parameters)

    def open(self, path: Path) -> None:
        """Open a file and wait until it is loaded."""
        self.visit(path.as_uri())

    def visit(self, address: str) -> None:
        """Go to an address and wait until it is loaded."""
        self._happened.clear()
        self.complaints.clear()
        self.requests.clear()
        self.call("Page.navigate", url=address)
        self._until("Page.loadEventFired")

    def click(self, selector: str) -> None:
        """Press the middle of an element, which is brought into sight."""
        self.wait_for(f"document.querySelector({json.dumps(selector)})")
        x, y = self.run(
            f"(() => {{ const e = document.querySelector({json.dumps(selector)}); "
            "e.scrollIntoView({block: 'center'}); const b = e.getBoundingClientRect(); "
            "return [b.x + b.width / 2, b.y + b.height / 2]; })()"
        )
        self.press(x, y)

    def run(self, script: str) -> Any:
        """Return what an expression is worth; of a promise, what it was kept with."""
        answer = self.call("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        if "exceptionDetails" in answer:
            raise SmsError(f"the page of the browser fails: {answer['exceptionDetails']}")
        return answer["result"].get("value")

    def wait_for(self, condition: str, seconds: float = 20.0) -> None:
        """Wait until an expression is true, as it is looked at before each frame."""
        self.run(
            "new Promise((done, failed) => { const started = performance.now(); const look = () => { "
            f"if ({condition}) done(); "
            f"else if (performance.now() - started > {1000 * seconds}) failed('never: ' + "
            f"{json.dumps(condition)}); else setTimeout(look, 20); }}; look(); }})"
        )

    def press(self, x: float, y: float) -> None:
        """Click at a place of the window."""
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=1)

    def _call(self, method: str, session: str | None = None, **parameters: Any) -> Any:
        self._number += 1
        told = {"id": self._number, "method": method, "params": parameters}
        if session is not None:
            told["sessionId"] = session
        written = json.dumps(told).encode() + b"\0"
        while written:
            written = written[os.write(self._to, written) :]
        while True:
            message = self._message()
            if message.get("id") == self._number:
                if "error" in message:
                    raise SmsError(f"the browser does not do {method}: {message['error']}")
                return message["result"]

    def _until(self, event: str) -> None:
        while event not in self._happened:
            self._message()

    def _message(self) -> Any:
        until = time.monotonic() + _SECONDS
        while b"\0" not in self._rest:
            ready, _, _ = select.select([self._from], [], [], max(0.0, until - time.monotonic()))
            if not ready:
                raise SmsError(f"the browser said nothing for {_SECONDS:g} s")
            more = os.read(self._from, 1 << 20)
            if not more:
                raise SmsError("the browser has ended; start it by hand to see why")
            self._rest += more
        one, _, self._rest = self._rest.partition(b"\0")
        message = json.loads(one)
        self._note(message)
        return message

    def _note(self, message: Any) -> None:
        method, told = message.get("method"), message.get("params", {})
        if method is None:
            return
        self._happened.append(method)
        if method == "Runtime.consoleAPICalled" and told["type"] in ("error", "assert"):
            self.complaints.append(str([a.get("value", a.get("description")) for a in told["args"]]))
        elif method == "Runtime.exceptionThrown":
            details = told["exceptionDetails"]
            self.complaints.append(details.get("exception", {}).get("description", details["text"]))
        elif method == "Log.entryAdded" and told["entry"]["level"] == "error":
            self.complaints.append(told["entry"]["text"])
        elif method == "Network.requestWillBeSent":
            self.requests.append(told["request"]["url"])
