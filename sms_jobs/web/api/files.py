"""Files of the archive: what they hold, show and come from, and the files themselves."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Lock
from typing import Annotated, Any
from urllib.parse import quote
from zipfile import ZipFile

from fastapi import Header, Query
from fastapi.responses import JSONResponse, Response, StreamingResponse
from pydantic import Field

from sms_jobs.app.fields import exporting
from sms_jobs.app.fields.exporting import Chosen, ExportOptions, Format
from sms_jobs.app.holdings import files, packing, sealed_files
from sms_jobs.app.holdings.files import Description, Tree
from sms_jobs.app.holdings.sealed_files import SealedFile
from sms_jobs.records.shown.files import FileView
from sms_jobs.web.byte_ranges import range_of
from sms_jobs.web.identity import Acting
from sms_jobs.web.parts import InParts
from sms_jobs.web.request_bodies import Number, RequestBody, Text
from sms_jobs.web.routes import Routes, answer, returned
from sms_jobs.web.validators import has_already

ROUTES = Routes("files")

PNG = "image/png"
DRAWING = Lock()
"""Matplotlib draws for one thread at a time."""
_BLOCK_BYTES = 1 << 20
_ANY = "*/*"


class Reason(RequestBody):
    """Why a file is kept."""

    reason: Annotated[Text, Field(min_length=1)]


@ROUTES.offer("GET", "/data/pins", files.pins, answers=returned(files.pins))
def pins(services: Acting) -> Any:
    """Return the files that are pinned."""
    return answer(files.pins(services))


@ROUTES.offer("GET", "/data/provenance", packing.provenance, media=("application/json",))
def provenance(
    services: Acting, of: Annotated[Text, Query(description="Number of a file, or name of a campaign.")]
) -> Any:
    """Return where files come from, as a W3C PROV document."""
    return JSONResponse(packing.provenance(services, of).document)


@ROUTES.offer("GET", "/data/{key:int}", files.describe, answers=Description)
def describe(services: Acting, key: Number) -> Any:
    """Return what is known of a file."""
    return answer(files.describe(services, str(key)))


@ROUTES.offer("GET", "/data/{key:int}/tree", files.tree, answers=Tree)
def tree(services: Acting, key: Number, down: bool = False) -> Any:
    """Return what a file was computed from, or what was computed from it."""
    return answer(files.tree(services, str(key), down=down))


@ROUTES.offer("GET", "/data/{key:int}/picture.png", files.picture, media=(PNG,))
def picture(
    services: Acting,
    key: Number,
    record: Text | None = None,
    field: Text | None = None,
    component: Text | None = None,
) -> Any:
    """Return a field as a picture."""
    with DRAWING:
        drawn = files.picture(services, str(key), record=record, field=field, component=component)
    return Response(drawn, media_type=PNG)


@ROUTES.offer("POST", "/data/{key:int}/pin", files.pin, answers=FileView)
def pin(services: Acting, key: Number, body: Reason) -> Any:
    """Keep a file."""
    return answer(files.pin(services, str(key), body.reason))


@ROUTES.offer("DELETE", "/data/{key:int}/pin", files.unpin, answers=FileView)
def unpin(services: Acting, key: Number) -> Any:
    """Let a policy decide about a file again."""
    return answer(files.unpin(services, str(key)))


@ROUTES.offer("GET", "/data/{key:int}/file", sealed_files.sealed_file, media=(_ANY,))
def file(
    services: Acting,
    key: Number,
    asked: Annotated[str | None, Header(alias="range")] = None,
    unless: Annotated[str | None, Header(alias="if-none-match")] = None,
    only_of: Annotated[str | None, Header(alias="if-range")] = None,
) -> Any:
    """Return the sealed file as it is, or a range of its bytes."""
    found = sealed_files.sealed_file(services, str(key))
    size, headers = found.file.size_bytes, _headers(found)
    if has_already(unless, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    try:
        part = range_of(asked, size) if only_of in (None, headers["ETag"]) else None
    except ValueError:
        return Response(status_code=416, headers=headers | {"Content-Range": f"bytes */{size}"})
    start, stop = part or (0, size)
    headers["Content-Length"] = str(stop - start)
    if part is not None:
        headers["Content-Range"] = f"bytes {start}-{stop - 1}/{size}"
    status = 200 if part is None else 206
    return InParts(found.read(start, stop), status, headers, _ANY)


@ROUTES.offer("HEAD", "/data/{key:int}/file", sealed_files.sealed_file, media=(_ANY,))
def head(services: Acting, key: Number) -> Any:
    """Return size and digest of the sealed file."""
    found = sealed_files.sealed_file(services, str(key))
    headers = _headers(found) | {"Content-Length": str(found.file.size_bytes)}
    return Response(headers=headers, media_type=_ANY)


@ROUTES.offer("GET", "/data/{key:int}/export", exporting.export, media=(_ANY,))
def export(
    services: Acting,
    key: Number,
    form: Annotated[Text, Query(alias="format", description="Name of a format; see /formats.")],
    record: Text | None = None,
    fields: Annotated[list[Text], Query(description="Only these values; all if not given.")] = [],  # noqa: B006
) -> Any:
    """Return a result in the file of another program; several in a ZIP archive."""
    options = ExportOptions(form, record, tuple(fields))
    with TemporaryDirectory(prefix="sms-export-") as folder:
        made = exporting.export(services, Chosen(file=str(key)), Path(folder), options)
        if len(made) > 1:
            made = [_packed(made, Path(folder) / f"file-{key}.zip")]
        # It can be read after the folder is gone.
        stream, size, name = made[0].open("rb"), made[0].stat().st_size, made[0].name

    def blocks() -> Iterator[bytes]:
        with stream:
            while block := stream.read(_BLOCK_BYTES):
                yield block

    headers = {"Content-Disposition": _attached(name), "Content-Length": str(size)}
    return StreamingResponse(blocks(), headers=headers, media_type="application/octet-stream")


@ROUTES.offer("GET", "/formats", exporting.list_formats, answers=list[Format])
def formats(services: Acting) -> Any:
    """Return the formats that results are written in."""
    return answer(exporting.list_formats(services))


def _headers(found: SealedFile) -> dict[str, str]:
    headers = {
        "ETag": f'"{found.file.sha256 or found.file.content_hash}"',
        "Accept-Ranges": "bytes",
        "Content-Disposition": _attached(found.name),
    }
    if found.digest is not None:
        headers["Repr-Digest"] = found.digest
    return headers


def _attached(name: str) -> str:
    """Say that a browser keeps a file under a name, and never shows it as a page of this site."""
    return f"attachment; filename*=UTF-8''{quote(name, safe='')}"


def _packed(made: list[Path], target: Path) -> Path:
    with ZipFile(target, "w") as archive:
        for path in made:
            archive.write(path, path.name)
    return target
