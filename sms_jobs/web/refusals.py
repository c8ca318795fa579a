"""How errors become answers: the sentence of the command line, and a status that follows from the class."""

from __future__ import annotations

from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException

from sms_jobs.errors import (
    ArchiveCorrupt,
    CatalogueDamaged,
    Conflict,
    InstrumentError,
    InvalidInput,
    JobFailed,
    NotAllowed,
    NotFound,
    OtherFormat,
    PasswordNeeded,
    ServerUnreachable,
    SmsError,
    StorageFull,
    StorageUnusable,
)
from sms_jobs.records.texts import harmless

_STATUS: tuple[tuple[type[SmsError], int], ...] = (
    (PasswordNeeded, 403),
    (NotAllowed, 403),
    (NotFound, 404),
    (Conflict, 409),
    (OtherFormat, 409),
    (JobFailed, 409),
    (InvalidInput, 422),
    (ArchiveCorrupt, 500),
    (CatalogueDamaged, 500),
    (InstrumentError, 502),
    (StorageFull, 507),
    (StorageUnusable, 503),
    (ServerUnreachable, 503),
)

_REFUSAL = {
    "type": "object",
    "required": ["error", "kind", "exit_code", "retryable"],
    "properties": {
        "error": {"type": "string"},
        "kind": {"type": "string"},
        "exit_code": {"type": "integer"},
        "retryable": {"type": "boolean"},
    },
}
DESCRIBED: dict[int | str, dict[str, Any]] = {
    status: {"description": words, "content": {"application/json": {"schema": _REFUSAL}}}
    for status, words in {
        400: "The request is no proper HTTP or JSON",
        401: "Nobody is logged in",
        403: "Whoever asks may not do that",
        404: "There is no such thing",
        408: "The request came too slowly",
        409: "It exists already, is held, or is in a state that forbids it",
        413: "The body is too large",
        422: "A value cannot be used",
        429: "Too many requests",
        500: "The archive or the program is damaged",
        502: "An instrument does not do what it was told",
        503: "A server or disk is away; try again",
        507: "The disk has no room",
    }.items()
}


class NobodyKnown(NotAllowed):
    """Nobody is logged in."""


class TooLarge(InvalidInput):
    """A request is larger than is received at once."""


def status_of(error: SmsError) -> int:
    """Return the status of the answer for an error."""
    if isinstance(error, NobodyKnown):
        return 401
    if isinstance(error, TooLarge):
        return 413
    return next((status for kind, status in _STATUS if isinstance(error, kind)), 500)


def refusal(error: SmsError) -> JSONResponse:
    """Return the answer for an error."""
    headers = {"WWW-Authenticate": "Bearer"} if isinstance(error, NobodyKnown) else {}
    if error.retryable:
        headers["Retry-After"] = "5"
    return JSONResponse(refused(error), status_of(error), headers)


def refused(error: SmsError) -> dict[str, Any]:
    """Return what is said of an error."""
    return {
        "error": harmless(str(error)),
        "kind": type(error).__name__,
        "exit_code": error.exit_code,
        "retryable": error.retryable,
    }


def install(app: FastAPI) -> None:
    """Let every error of an application be answered in one form."""

    @app.exception_handler(SmsError)
    def _refuse(_request: Request, error: SmsError) -> JSONResponse:
        return refusal(error)

    @app.exception_handler(RequestValidationError)
    def _invalid(_request: Request, error: RequestValidationError) -> JSONResponse:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"][1:]) or str(first["loc"][0])
        return refusal(InvalidInput(f"{place}: {first['msg']}; /api/v1/openapi.json says what is expected"))

    @app.exception_handler(HTTPException)
    def _other(_request: Request, error: HTTPException) -> JSONResponse:
        if isinstance(error.__cause__, SmsError):
            # The body was refused while it came.
            return refusal(error.__cause__)
        body = {"error": error.detail, "kind": "HTTP", "exit_code": 2, "retryable": False}
        return JSONResponse(body, error.status_code, error.headers)
