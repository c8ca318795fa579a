"""A real `sms serve`, many clients of it at once, and one who listens to its events."""

from __future__ import annotations

import asyncio
import json
import random
import re
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx2
import psutil

from sms_jobs.bench.browser import Browser
from sms_jobs.errors import SmsError

API = "/api/v1"
GATHERED_S = 0.05
"""How long the page's script waits after an event before it asks: see `live.js`."""
_BEGUN_WITHIN_S = 60.0
_TIMEOUT_S = 60.0


@dataclass(frozen=True)
class Served:
    """A running `sms serve`: the address of its pages, and its process."""

    site: str
    process: psutil.Process

    @property
    def url(self) -> str:
        """Address of its interface for programs."""
        return f"{self.site}{API}"

    @property
    def rss_mb(self) -> float:
        """Memory that it holds now."""
        return float(self.process.memory_info().rss) / 1e6


@contextmanager
def served(home: Path) -> Iterator[Served]:
    """Run `sms serve` of a home until the block ends."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [sys.executable, "-P", "-m", "sms_jobs.cli.main", "serve", "--home", str(home)]
    with (home / "serve.log").open("ab") as log:
        process = subprocess.Popen(
            [*command, "--listen", f"127.0.0.1:{port}"], stdin=subprocess.DEVNULL, stdout=log, stderr=log
        )
    try:
        web = Served(f"http://127.0.0.1:{port}", psutil.Process(process.pid))
        _wait_for(web.url, home)
        yield web
    finally:
        process.terminate()
        process.wait(timeout=60)


def _wait_for(url: str, home: Path) -> None:
    deadline = time.monotonic() + _BEGUN_WITHIN_S
    while time.monotonic() < deadline:
        try:
            httpx2.get(f"{url}/status", timeout=_TIMEOUT_S).raise_for_status()
        except httpx2.TransportError:
            time.sleep(0.1)
        else:
            return
    raise SmsError(f"'sms serve' does not answer; {home / 'serve.log'} tells why")


_NOTE_WHAT_IS_SHOWN = """
window.shown = {};
new MutationObserver(() => requestAnimationFrame(() => {
  for (const row of document.querySelectorAll("#jobs tbody tr")) {
    const job = row.querySelector("a").getAttribute("href").slice("/jobs/".length);
    if (row.querySelector(".state").textContent === "cancelled") window.shown[job] ??= Date.now();
  }
})).observe(document.body, { childList: true, subtree: true });
"""
"""Notes at the next frame what has come to the page, in ms as `time.time` counts them."""
LISTED = 100
"""Jobs that the page lists."""


def crowd(url: str, addresses: Sequence[str], clients: int, pause_s: float, seconds: float) -> dict[str, Any]:
    """Let many ask at once, each an address by chance and then nothing for a while; return ms by address."""
    return asyncio.run(_crowd(url, addresses, clients, pause_s, seconds))


async def _crowd(
    url: str, addresses: Sequence[str], clients: int, pause_s: float, seconds: float
) -> dict[str, list[float]]:
    taken: dict[str, list[float]] = {address: [] for address in addresses}
    ends = time.monotonic() + seconds
    limits = httpx2.Limits(max_connections=clients, max_keepalive_connections=clients)
    async with httpx2.AsyncClient(base_url=url, timeout=_TIMEOUT_S, limits=limits) as client:

        async def ask(number: int) -> None:
            chance = random.Random(number)  # noqa: S311 - the same questions every time
            await asyncio.sleep(chance.uniform(0.0, pause_s))
            while time.monotonic() < ends:
                address = chance.choice(addresses)
                began = time.perf_counter()
                (await client.get(address)).raise_for_status()
                taken[address].append(1e3 * (time.perf_counter() - began))
                await asyncio.sleep(chance.uniform(0.5, 1.5) * pause_s)

        await asyncio.gather(*(ask(number) for number in range(clients)))
    return taken


class EventEar:
    """One who listens to events, and notes when those of a job came."""

    def __init__(self, url: str) -> None:
        self._url = url
        self._heard: dict[str, float] = {}
        self._news = threading.Condition()
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._listen, name="event-ear", daemon=True)

    def __enter__(self) -> EventEar:
        self._thread.start()
        return self

    def __exit__(self, *_error: object) -> None:
        self._ending.set()

    def heard_at(self, job: str, within_s: float) -> float:
        """Return by `time.perf_counter` when the event of a job came; raise `SmsError` where it does not."""
        with self._news:
            if not self._news.wait_for(lambda: job in self._heard, within_s):
                raise SmsError(f"the event of job {job} was not told within {within_s:g} s; report it")
            return self._heard[job]

    def _listen(self) -> None:
        try:
            self._listen_until_the_end()
        except httpx2.TransportError:
            if not self._ending.is_set():
                raise

    def _listen_until_the_end(self) -> None:
        timeout = httpx2.Timeout(_TIMEOUT_S)
        with httpx2.stream("GET", f"{self._url}/events", timeout=timeout) as answer:
            for line in answer.iter_lines():
                if self._ending.is_set():
                    return
                if line.startswith("data:") and (job := json.loads(line[5:]).get("job")):
                    with self._news:
                        self._heard.setdefault(job, time.perf_counter())
                        self._news.notify_all()


class PageOfJobs:
    """The list of the newest jobs as somebody has it open, and when it shows that one was cancelled.

    It is a page of a Chromium where there is one; else a client that asks as the page's script does.

    Parameters
    ----------
    site
        Address of the console.
    ear
        Who hears the events, for the client that stands for a browser.
    folder
        For the profile of the browser.
    program
        Of a Chromium; None where there is none.
    """

    def __init__(self, site: str, ear: EventEar, folder: Path, program: str | None) -> None:
        self._address, self._ear = f"{site}/jobs?limit={LISTED}", ear
        self._folder, self._program = folder, program
        self._left = ExitStack()
        self._browser: Browser | None = None

    def __enter__(self) -> PageOfJobs:
        if self._program is not None:
            self._browser = self._left.enter_context(Browser(self._program, self._folder))
            self._browser.visit(self._address)
            self._browser.run(_NOTE_WHAT_IS_SHOWN)
        else:
            self._client = self._left.enter_context(httpx2.Client(timeout=_TIMEOUT_S))
        return self

    def __exit__(self, *_error: object) -> None:
        self._left.close()

    def shown_at(self, job: str, within_s: float) -> float:
        """Return by `time.time` when the page showed a job as cancelled; `SmsError` where it does not."""
        if self._browser is not None:
            self._browser.wait_for(f"window.shown[{json.dumps(job)}]", within_s)
            return float(self._browser.run(f"window.shown[{json.dumps(job)}]")) / 1e3
        self._ear.heard_at(job, within_s)
        time.sleep(GATHERED_S)
        told = re.compile(rf'href="/jobs/{job}".*?class="state off">cancelled<', re.DOTALL)
        until = time.monotonic() + within_s
        while time.monotonic() < until:
            page = self._client.get(self._address).raise_for_status().text
            row = next((row for row in page.split("<tr>") if f'href="/jobs/{job}"' in row), "")
            if told.search(row):
                return time.time()
        raise SmsError(f"the page does not show within {within_s:g} s that job {job} is cancelled; report it")
