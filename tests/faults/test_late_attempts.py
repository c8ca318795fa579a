"""An attempt that was given up clears away nothing of the one that took its place."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from support.sealing import JOB, files_below, provenance, regions

from sms_jobs.archive import Archive, FolderStore, layout
from sms_jobs.archive.layout import temporary_name


def test_the_attempt_is_known_of_what_is_sealed_and_of_what_is_being_written(tmp_path: Path) -> None:
    archive = Archive(FolderStore(tmp_path))
    for attempt in (1, 2, 12):
        made = replace(provenance(), attempt=attempt)
        sealed = archive.seal_dataset({"regions": regions()}, made)
        document = archive.seal_document("a.txt", "text/plain", lambda p: np.savetxt(p, [1.0]), made)
        for path in (sealed.path, document.path):
            name = temporary_name(Path(path).name, JOB)
            (archive.store.path(path).parent / name).touch()
    found = [layout.attempt_of(path, JOB) for path in archive.leftovers(JOB)]
    # A dataset, a document, and one of each that is being written.
    assert sorted(found) == [1] * 4 + [2] * 4 + [12] * 4
    assert len(files_below(archive)) == 15  # with what stands beside the documents
