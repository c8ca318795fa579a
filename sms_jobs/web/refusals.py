"""How errors become answers: the sentence of the command line, and a status that follows from the class."""

from __future__ import annotations

import json
from collections.abc import Sequence
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
    in_words,
)
from sms_jobs.records.texts import harmless
from sms_jobs.web.request_bodies import TEXT

_LETTERS = 100
_OF_ADDRESSES = {
    400: "the body cannot be read as JSON: it should be text in UTF-8, not nested thousands of levels deep",
    404: "there is no address {path}; GET /api/v1 lists them",
    405: "{path} does not take {method}; GET /api/v1 lists what it takes",
}

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


def _told(errors: Sequence[Any], body: Any) -> str:
    """Say what is wrong with a request; of a misspelt name before what then is missing."""
    first = min(errors, key=lambda error: error["type"] != "extra_forbidden")
    place = ".".join(str(part) for part in first["loc"][1:]) or str(first["loc"][0])
    if first["type"] == "json_invalid":
        return f"the body is no JSON, at character {place}: {first['ctx']['error']}"
    if first["type"] == "extra_forbidden":
        return f"'{place}' is not known here"
    if first["type"] == "missing":
        return f"'{place}' is missing"
    if first["loc"] == ("body",) and isinstance(first.get("input"), str | bytes):
        return "the body should be an object in JSON, sent with 'Content-Type: application/json'"
    words = in_words(first["msg"]).replace(f"match pattern '{TEXT}'", "have no character of code 0")
    if first["type"].startswith(("datetime", "timezone")):
        words = "it should be a time with its zone, such as 2026-05-04T10:00:00Z"
        hint = "; in an address '+' is written '%2B'" if first["loc"][0] == "query" else ""
        return f"'{place}': {words}{_given(first, body)}{hint}"
    return f"'{place}': {words}{_given(first, body)}"


def _given(error: Any, body: Any) -> str:
    """Return what a value is instead of what it should be; nothing where it may be a password."""
    value = error.get("input")
    if error["type"] == "string_too_long":
        return f", not {len(value)}"
    if error["loc"][0] in ("query", "path"):
        return f", not {str(value)[:_LETTERS]!r}"
    plain = value is None or isinstance(value, str | int | float)
    if not plain or not isinstance(body, dict) or "password" in body:
        return ""
    return f", not {json.dumps(value)[:_LETTERS]}"


def install(app: FastAPI) -> None:
    """Let every error of an application be answered in one form."""

    @app.exception_handler(SmsError)
    def _refuse(_request: Request, error: SmsError) -> JSONResponse:
        return refusal(error)

    @app.exception_handler(RequestValidationError)
    def _invalid(_request: Request, error: RequestValidationError) -> JSONResponse:
        return refusal(
            InvalidInput(f"{_told(error.errors(), error.body)}; /api/v1/openapi.json says what is expected")
        )

    @app.exception_handler(HTTPException)
    def _other(request: Request, error: HTTPException) -> JSONResponse:
        if isinstance(error.__cause__, SmsError):
            # The body was refused while it came.
            return refusal(error.__cause__)
        told = _OF_ADDRESSES.get(error.status_code, "{detail}").format(
            method=request.method, path=request.url.path[:_LETTERS], detail=error.detail
        )
        body = {"error": harmless(told), "kind": "HTTP", "exit_code": 2, "retryable": False}
        return JSONResponse(body, error.status_code, error.headers)
