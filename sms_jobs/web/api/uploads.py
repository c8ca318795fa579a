"""Uploads: files that are sent in chunks, until they are imported."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import Body, Header, Path, Query, Response

from sms_jobs.app.importing import uploads
from sms_jobs.app.importing.uploads import Chunk, Upload, UploadedFile
from sms_jobs.web.identity import Acting
from sms_jobs.web.routes import Routes, answer

ROUTES = Routes("uploads")

UploadId = Annotated[str, Path(pattern=r"^u[0-9a-f]{24}$")]
FilePath = Annotated[
    str, Path(description="Below the upload's folder, as `load_1/left.tif`.", max_length=500)
]
Content = Annotated[
    bytes, Body(media_type="application/octet-stream", description="Up to 8 MiB of the file.")
]
Hash = Annotated[
    str,
    Header(alias="X-Content-SHA256", pattern=r"^[0-9a-fA-F]{64}$", description="SHA-256 of the chunk."),
]


@ROUTES.offer("GET", "/uploads", uploads.list_uploads, answers=list[Upload])
def list_uploads(services: Acting) -> Any:
    """Return the uploads of whoever asks."""
    return answer(uploads.list_uploads(services))


@ROUTES.offer("POST", "/uploads", uploads.begin, answers=Upload, status=201)
def begin(services: Acting) -> Any:
    """Begin an upload."""
    return answer(uploads.begin(services), 201)


@ROUTES.offer("GET", "/uploads/{upload}", uploads.show, answers=Upload)
def show(services: Acting, upload: UploadId) -> Any:
    """Return what of an upload is there."""
    return answer(uploads.show(services, upload))


@ROUTES.offer("PUT", "/uploads/{upload}/{path:path}", uploads.write, answers=UploadedFile)
def write(
    services: Acting,
    upload: UploadId,
    path: FilePath,
    content: Content,
    sha256: Hash,
    offset: Annotated[int, Query(ge=0, le=1 << 40, description="Of the chunk's first byte.")] = 0,
) -> Any:
    """Add a chunk to a file of an upload."""
    return answer(uploads.write(services, upload, path, Chunk(offset, memoryview(content), sha256)))


@ROUTES.offer("DELETE", "/uploads/{upload}", uploads.remove, status=204)
def remove(services: Acting, upload: UploadId) -> Response:
    """Remove an upload."""
    uploads.remove(services, upload)
    return Response(status_code=204)
