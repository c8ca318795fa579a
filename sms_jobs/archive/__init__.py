"""The archive: sealed, self-describing HDF5 files, and documents made of them, in a store."""

from sms_jobs.archive.archive import Archive
from sms_jobs.archive.checking import Checker
from sms_jobs.archive.folder import FolderStore
from sms_jobs.archive.form import DATASET_MEDIA_TYPE
from sms_jobs.archive.memory import MemoryStore
from sms_jobs.archive.provenance import Found, InputReference, Provenance, Recorded, Sealed
from sms_jobs.archive.store import Store

__all__ = [
    "DATASET_MEDIA_TYPE",
    "Archive",
    "Checker",
    "FolderStore",
    "Found",
    "InputReference",
    "MemoryStore",
    "Provenance",
    "Recorded",
    "Sealed",
    "Store",
]
