"""The archive: a folder of sealed, self-describing HDF5 files and the documents made of them."""

from sms_jobs.archive.archive import Archive
from sms_jobs.archive.dataset import ArchivedDataset
from sms_jobs.archive.provenance import InputReference, Provenance, Sealed

__all__ = ["Archive", "ArchivedDataset", "InputReference", "Provenance", "Sealed"]
