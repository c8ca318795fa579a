"""The archive: a folder of sealed, self-describing HDF5 files and the documents made of them."""

from sms_jobs.archive.archive import DATASET_MEDIA_TYPE, Archive
from sms_jobs.archive.checking import Checker
from sms_jobs.archive.dataset import ArchivedDataset
from sms_jobs.archive.provenance import Found, InputReference, Provenance, Recorded, Sealed

__all__ = [
    "DATASET_MEDIA_TYPE",
    "Archive",
    "ArchivedDataset",
    "Checker",
    "Found",
    "InputReference",
    "Provenance",
    "Recorded",
    "Sealed",
]
