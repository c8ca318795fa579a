"""The browser of the benchmarks, with what only tests do in it."""

from __future__ import annotations

import base64
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager

from sms_jobs.bench import browser
from sms_jobs.bench.browser import find_browser
from support.missing import do_without


class Browser(browser.Browser):
    """A page that is read, filled in and left."""

    @staticmethod
    def decoded(address: str) -> bytes:
        """Return what a data address holds."""
        return base64.b64decode(address.partition(",")[2])

    def leave_by(self, selector: str) -> None:
        """Press something that leads to another page, and wait until that is loaded."""
        with self.leaving():
            self.click(selector)

    @contextmanager
    def leaving(self) -> Iterator[None]:
        """Wait until another page is loaded, which something done meanwhile leads to."""
        self._happened.clear()
        yield
        self._until("Page.loadEventFired")

    def write(self, selector: str, text: str) -> None:
        """Write into a field."""
        self.run(f"document.querySelector({json.dumps(selector)}).focus()")
        self.call("Input.insertText", text=text)

    def point(self, x: float, y: float) -> None:
        """Move the mouse to a place of the window, in CSS pixels."""
        self.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)

    def key(self, key: str, text: str = "") -> None:
        """Press a key."""
        self.call("Input.dispatchKeyEvent", type="keyDown", key=key, code=key, text=text)
        self.call("Input.dispatchKeyEvent", type="keyUp", key=key, code=key)

    def screen(self, width: int, height: int, mobile: bool = False) -> None:
        """Give the window a size."""
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=mobile,
        )

    def print(self) -> bytes:
        """Return the page as PDF."""
        answer = self.call("Page.printToPDF", preferCSSPageSize=True, printBackground=True)
        return base64.b64decode(answer["data"])


def browser_or_skip() -> str:
    """Return the path of a Chromium; skip the test where there is none, or fail it where CI=true."""
    found = find_browser()
    if found is None:
        reason = "needs a Chromium: run ops/test.sh, or set SMS_TEST_BROWSER to its path"
        do_without(reason, insist=os.environ.get("SMS_TEST_BROWSER") != "none")
    return found
