"""Work that takes long: how far it has come is sent line by line, and what came of it last.

Each line is a JSON object: `{"doing", "done", "total", "detail"}` while it goes on, then `{"answer": ...}` or
a refusal as of any other address. What fails within a second is answered by a status instead.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncGenerator, Callable
from typing import Any

from anyio import CapacityLimiter, to_thread
from fastapi import Request
from fastapi.responses import StreamingResponse

from sms_jobs.app.progress import Step, Tell
from sms_jobs.errors import Cancelled, SmsError
from sms_jobs.records.plain import plain
from sms_jobs.web.refusals import refused

MEDIA = "application/x-ndjson"
AT_A_TIME = 2
"""Works that go on at a time, beside other requests."""
_FIRST_S = 1.0
_EVERY_S = 0.5
_BEAT_S = 10.0


class _Progress:
    def __init__(self) -> None:
        self.latest: Step | None = None
        self.given_up = False

    def tell(self, step: Step) -> None:
        if self.given_up:
            raise Cancelled("the client that asked for it has gone")
        self.latest = step


async def followed(request: Request, work: Callable[[Tell], Any]) -> StreamingResponse:
    """Answer with how far work comes, and with what it returns as JSON.

    Where whoever asked goes away, the work ends at its next step.
    """
    limiter: CapacityLimiter = request.app.state.long_work
    progress = _Progress()
    task = asyncio.ensure_future(to_thread.run_sync(work, progress.tell, limiter=limiter))
    try:
        await asyncio.wait({task}, timeout=_FIRST_S)
    except asyncio.CancelledError:
        progress.given_up = True
        raise
    if task.done() and (error := task.exception()) is not None:
        raise error
    return StreamingResponse(_lines(task, progress), media_type=MEDIA)


async def _lines(task: asyncio.Future[Any], progress: _Progress) -> AsyncGenerator[bytes, None]:
    try:
        shown, shown_at = None, -_BEAT_S
        while not task.done():
            now = asyncio.get_running_loop().time()
            step = progress.latest
            if step is not None and (step is not shown or now - shown_at >= _BEAT_S):
                shown, shown_at = step, now
                yield _line(step)
            await asyncio.wait({task}, timeout=_EVERY_S)
        try:
            yield _line({"answer": task.result()})
        except SmsError as error:
            yield _line(refused(error))
    finally:
        progress.given_up = True


def _line(value: Any) -> bytes:
    return json.dumps(plain(value), ensure_ascii=False).encode() + b"\n"
