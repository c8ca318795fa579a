"""Records and their arrays: whole, in parts, and as Zarr."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Any, Literal

from fastapi import Path, Query
from fastapi.responses import Response

from sms_jobs.app.fields import arrays, zarr_view
from sms_jobs.app.fields.arrays import FileArrays
from sms_jobs.app.holdings import reading
from sms_jobs.app.holdings.reading import Newest, RecordParts
from sms_jobs.web.identity import Acting
from sms_jobs.web.parts import InParts
from sms_jobs.web.request_bodies import Name, Number, Text
from sms_jobs.web.routes import Routes, answer

ROUTES = Routes("arrays")

NPY, CSV = "application/x-npy", "text/csv; charset=utf-8"
_BYTES = "application/octet-stream"

Part = Annotated[
    Text,
    Query(alias="slice", description="As 0:3,100:200,::4: a place or begin:end:step for each axis."),
]


@ROUTES.offer("GET", "/data/newest", reading.newest_file, answers=Newest)
def newest(services: Acting, subject: Text, what: Text) -> Any:
    """Say which file has the newest record about a subject."""
    return answer(reading.newest_file(services, subject, what))


@ROUTES.offer("GET", "/data/{key:int}/record", reading.parts_of_file, answers=RecordParts)
def record(services: Acting, key: Number, name: Text | None = None) -> Any:
    """Return a record without its arrays."""
    return answer(reading.parts_of_file(services, str(key), name))


@ROUTES.offer("GET", "/data/{key:int}/arrays", arrays.list_arrays, answers=FileArrays)
def list_arrays(services: Acting, key: Number) -> Any:
    """Return what arrays a file has."""
    return answer(arrays.list_arrays(services, str(key)))


@ROUTES.offer("GET", "/data/{key:int}/arrays/{record}/{name}", arrays.read_part, media=(NPY, "text/csv"))
def part(
    services: Acting,
    key: Number,
    record: Name,
    name: Name,
    part: Part = "",
    form: Annotated[Literal["npy", "csv"], Query(alias="format")] = "npy",
) -> Any:
    """Return a part of an array."""
    found = arrays.read_part(services, str(key), record, name, part)
    ending: Iterable[bytes] = found.as_npy() if form == "npy" else found.as_table()
    return InParts(ending, media_type=NPY if form == "npy" else CSV)


@ROUTES.offer(
    "GET", "/data/{key:int}/zarr/{path:path}", zarr_view.zarr_entry, media=("application/json", _BYTES)
)
def zarr(services: Acting, key: Number, path: Annotated[str, Path(max_length=1000)]) -> Any:
    """Return metadata or a chunk of the arrays as Zarr."""
    found = zarr_view.zarr_entry(services, str(key), path)
    return Response(found, media_type="application/json" if path.endswith(".json") else _BYTES)


@ROUTES.offer(
    "GET", "/data/{key:int}/zarr-gzip/{path:path}", zarr_view.zarr_entry, media=("application/json", _BYTES)
)
def packed_zarr(services: Acting, key: Number, path: Annotated[str, Path(max_length=1000)]) -> Any:
    """Return metadata or a chunk of the arrays as Zarr, chunks packed by gzip."""
    found = zarr_view.zarr_entry(services, str(key), path, packed=True)
    return Response(found, media_type="application/json" if path.endswith(".json") else _BYTES)
