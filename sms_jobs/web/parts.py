"""Answers whose parts are made while they are sent."""

from __future__ import annotations

import logging

from fastapi.responses import StreamingResponse
from starlette.types import Send

from sms_jobs.errors import SmsError

_log = logging.getLogger(__name__)


class InParts(StreamingResponse):
    """An answer that is cut off where a part of it cannot be made.

    Its status is sent by then: whoever asked knows by the connection, which ends before the answer does, and
    the log says why.
    """

    async def stream_response(self, send: Send) -> None:
        """Send what there is, up to what cannot be made."""
        try:
            await super().stream_response(send)
        except SmsError as error:
            _log.error("an answer was cut off: %s", error)
