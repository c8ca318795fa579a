"""What people ask of a home again and again: how long each use case takes, and how much memory its process.

Run as `python -m sms_jobs.bench.large.questions HOME QUESTION CALLS`; it prints the milliseconds of every
call, after one of each that does not count, and the most memory that the process has held, as JSON.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path

from sms_jobs import bootstrap
from sms_jobs.bench.large import many_files, many_jobs
from sms_jobs.bench.peak_memory import peak_rss_mb
from sms_jobs.bootstrap import Services
from sms_jobs.errors import SmsError
from sms_jobs.records.plain import plain


@dataclass(frozen=True)
class Answers:
    """How long calls of a use case have taken, in ms, and the peak memory of their process, in MB."""

    ms: tuple[float, ...]
    rss_mb: float


Asked = Sequence[Callable[[], object]]


def _campaign_list(services: Services) -> Asked:
    from sms_jobs.app.specimens import campaigns

    return [lambda: campaigns.list_campaigns(services), lambda: campaigns.list_campaigns(services, 1000)]


def _status(services: Services) -> Asked:
    from sms_jobs.app.home import service

    return [lambda: service.status(services)]


def _job_list(services: Services) -> Asked:
    from sms_jobs.app.work import jobs
    from sms_jobs.records.job import JobState

    campaign = many_jobs.name_of(0)
    return [
        lambda: jobs.list_jobs(services),
        lambda: jobs.list_jobs(services, campaign=campaign),
        lambda: jobs.list_jobs(services, campaign=campaign, states=[JobState.QUEUED]),
        lambda: jobs.list_jobs(services, states=[JobState.FAILED, JobState.SUCCEEDED]),
        lambda: jobs.list_jobs(services, kind="strain"),
    ]


def _data_find(services: Services) -> Asked:
    from sms_jobs.app.holdings import finding

    def pages(text: str) -> Callable[[], object]:
        return lambda: list(islice(finding.find(services, finding.question(text)), 1))

    return [pages(text) for text in many_files.DOCUMENTED]


QUESTIONS: Mapping[str, tuple[str, Callable[[Services], Asked]]] = {
    "campaign_list": ("the newest 50 campaigns, and the newest 1000", _campaign_list),
    "status": ("how the home stands", _status),
    "job_list": ("50 jobs: of all, of a campaign, those queued of it, in two states, of a kind", _job_list),
    "data_find": ("50 files for each query of docs/query.md", _data_find),
}
"""What is asked, and the calls that ask it, one after the other."""


def answers(home: Path, question: str, calls: int) -> Answers:
    """Ask a question so often in a process of its own."""
    command = [sys.executable, "-P", "-m", __name__, str(home), question, str(calls)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SmsError(f"asking for {question} of {home} failed: {done.stderr.strip()[-500:]}; report it")
    found = json.loads(done.stdout)
    return Answers(tuple(found["ms"]), found["rss_mb"])


def main(home: Path, question: str, calls: int) -> None:
    """Ask, and print what came of it."""
    with bootstrap.services(home) as services:
        asked = QUESTIONS[question][1](services)
        for call in asked:
            call()
        taken = []
        for number in range(calls):
            began = time.perf_counter()
            # As it is given out, on a command line and over HTTP.
            json.dumps(plain(asked[number % len(asked)]()))
            taken.append(1e3 * (time.perf_counter() - began))
    print(json.dumps(asdict(Answers(tuple(taken), peak_rss_mb()))))  # noqa: T201 - for `answers`


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]))
