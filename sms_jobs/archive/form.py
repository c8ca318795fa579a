"""Which form the files of an archive have: known without the library that reads them."""

from __future__ import annotations

from sms_jobs.errors import OtherFormat

FORMAT = "sms-archive"
FORMAT_VERSION = 3
"""1 knew no views, 2 no checks of blocks; what was written before the first release is not read."""
DATASET_MEDIA_TYPE = "application/x-hdf5"
LARGEST_TEXT_BYTES = 64 << 20
"""Of a file's texts together, and of what stands beside a document."""


def require_version(where: str, version: int) -> None:
    """Raise `OtherFormat` for a file that another version of the program has written in another format."""
    if version == FORMAT_VERSION:
        return
    mismatch = f"{where} has format version {version}, this program reads version {FORMAT_VERSION}"
    if version > FORMAT_VERSION:
        raise OtherFormat(f"{mismatch}; install a newer sms_jobs")
    raise OtherFormat(f"{mismatch}: it is from before the first release; import or compute it again")
