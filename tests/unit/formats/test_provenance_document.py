"""The PROV document is one that programs for W3C PROV read: PROV-DM's relations in PROV-JSON's form."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from support.archives import Clock, entered, registered
from support.sealing import measurement, point_cloud, provenance

from sms_jobs.archive import Archive, FolderStore, InputReference, Sealed
from sms_jobs.catalogue import schema
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.errors import NotFound
from sms_jobs.formats.provenance_document import (
    DocumentedActivity,
    DocumentedFile,
    DocumentedInput,
    provenance_document,
)
from sms_jobs.jobs.portable import lineage_documents
from sms_jobs.records.subject import Subject

NOW = datetime(2026, 3, 1, 12, 0, 5, tzinfo=UTC)
ENDS = {
    "used": {"activity": "activity", "entity": "entity"},
    "wasGeneratedBy": {"entity": "entity", "activity": "activity"},
    "wasAssociatedWith": {"activity": "activity", "agent": "agent"},
    "actedOnBehalfOf": {"delegate": "agent", "responsible": "agent", "activity": "activity"},
    "wasDerivedFrom": {"generatedEntity": "entity", "usedEntity": "entity", "activity": "activity"},
}
"""PROV-DM 5: what each relation holds between; all that we write are given."""
MORE = {"used": {"role"}, "wasGeneratedBy": {"time"}, "wasAssociatedWith": {"role"}}
# PROV-N's qualified names, without escapes: what PROV-JSON takes as identifiers.
QUALIFIED = re.compile(r"[A-Za-z][\w.-]*:[\w/%-]([\w./%-]*[\w/%-])?")


def strictly(document: dict[str, Any]) -> None:
    """Require what PROV-JSON and PROV-CONSTRAINTS require of the parts that we write."""
    document = json.loads(json.dumps(document, allow_nan=False))
    assert set(document) <= {"prefix", "entity", "activity", "agent", *ENDS}
    for name in ("entity", "activity", "agent"):
        for identifier, about in document[name].items():
            assert QUALIFIED.fullmatch(identifier), identifier
            assert identifier.split(":")[0] in document["prefix"]
            for key, value in about.items():
                assert key.split(":")[0] in {*document["prefix"], "prov"}
                literal = isinstance(value, dict) and set(value) == {"$", "type"}
                assert literal or isinstance(value, str | int | float | bool)
    identifiers = [*document["entity"], *document["activity"], *document["agent"]]
    assert len(identifiers) == len(set(identifiers))
    generated = []
    for name, ends in ENDS.items():
        for identifier, about in document[name].items():
            assert identifier.startswith("_:")
            told = {key.removeprefix("prov:") for key in about}
            assert told == set(ends) | (told & MORE.get(name, set()))
            for end, what in ends.items():
                assert about[f"prov:{end}"] in document[what]
        if name == "wasGeneratedBy":
            generated = [about["prov:entity"] for about in document[name].values()]
    # An entity is generated once; what it is derived from was used by what generated it.
    assert len(generated) == len(set(generated))
    used = {(u["prov:activity"], u["prov:entity"]) for u in document["used"].values()}
    made = {(g["prov:activity"], g["prov:entity"]) for g in document["wasGeneratedBy"].values()}
    for one in document["wasDerivedFrom"].values():
        assert (one["prov:activity"], one["prov:usedEntity"]) in used
        assert (one["prov:activity"], one["prov:generatedEntity"]) in made
    for one in document["activity"].values():
        for key in ("prov:startTime", "prov:endTime"):
            assert key not in one or datetime.fromisoformat(one[key]).tzinfo is not None


def test_a_job_with_its_files_and_people_becomes_a_document() -> None:
    files = [DocumentedFile(path, "ab" * 32, {"kind": "x", "nothing": None}) for path in ("in.h5", "a b.h5")]
    job = DocumentedActivity(
        name="0123",
        started=NOW,
        ended=NOW + timedelta(seconds=3),
        program_version="0.1.0",
        host="here",
        operator="Jürgen Müller",
        attributes={"kind": "x", "kind_version": 2, "parameters": '{"a": 1}'},
        used=(DocumentedInput("measured", "in.h5"),),
        outputs=(("a b.h5", NOW),),
    )
    document = provenance_document(files, [job])
    strictly(document)
    (derived,) = document["wasDerivedFrom"].values()
    assert derived == {
        "prov:generatedEntity": "file:a%20b.h5",
        "prov:usedEntity": "file:in.h5",
        "prov:activity": "job:0123",
    }
    assert {about["prov:label"] for about in document["agent"].values()} == {
        "sms_jobs 0.1.0",
        "here",
        "Jürgen Müller",
    }
    (behalf,) = document["actedOnBehalfOf"].values()
    assert document["agent"][behalf["prov:responsible"]]["prov:type"]["$"] == "prov:Person"
    assert document["activity"]["job:0123"]["prov:endTime"] == "2026-03-01T12:00:08+00:00"


@pytest.fixture
def made(tmp_path: Path, rng: Any) -> Iterator[tuple[Catalogue, Archive, Sealed, Sealed]]:
    """A recording, and points and a page that one job made of it."""
    catalogue = Catalogue(f"sqlite:///{tmp_path / 'catalogue.sqlite'}", create=True)
    schema.upgrade(catalogue)
    archive, clock = Archive(FolderStore(tmp_path / "archive")), Clock()
    registered(catalogue, archive, clock)
    subject = Subject("plate", "S00", "C1P1")
    recorded = archive.seal_dataset(
        {"measurement": measurement(rng, 8, 6)},
        provenance(kind="simulate", subject=Subject("plate", "S00", "C1P1"), inputs=(), created_at=NOW),
    )
    given = (InputReference("measured", "measurement", recorded.path, recorded.content_hash),)
    later = provenance(
        kind="reconstruct",
        subject=subject,
        job_id="fedcba9876543210",
        inputs=given,
        created_at=NOW + timedelta(seconds=1),
        statistics={"median_sigma_mm": 0.01},
    )
    points = archive.seal_dataset({"surface": point_cloud(rng)}, later)
    archive.seal_document("page.txt", "text/plain", lambda path: path.write_text("page"), later)
    entered(catalogue, archive)
    yield catalogue, archive, recorded, points
    catalogue.close()


def test_files_tell_the_document_back_to_what_was_measured(
    made: tuple[Catalogue, Archive, Sealed, Sealed],
) -> None:
    catalogue, archive, recorded, points = made
    with catalogue.reading() as session:
        assert lineage_documents.paths_of(session, points.path) == [points.path]
        everything = lineage_documents.paths_of(session, "plate")
        with pytest.raises(NotFound, match="neither a file nor a campaign"):
            lineage_documents.paths_of(session, "nobody")
    document = lineage_documents.document_of(catalogue, archive, [points.path])
    strictly(document)
    assert {about["prov:location"]: about["sms:sha256"] for about in document["entity"].values()} == {
        points.path: points.content_hash,
        recorded.path: recorded.content_hash,
    }
    assert document["entity"][f"file:{points.path}"]["sms:statistic.median_sigma_mm"] == 0.01
    about = document["activity"]["job:fedcba9876543210"]
    assert (about["sms:kind"], about["sms:kind_version"]) == ("reconstruct", 1)
    assert json.loads(about["sms:parameters"]) == {"threshold": 0.5, "names": ["a", "b"]}
    # Of a campaign: its definition, which somebody brought in, and both files of the one job.
    document = lineage_documents.document_of(catalogue, archive, everything)
    strictly(document)
    assert len(document["entity"]) == 4
    assert len(document["activity"]) == 3
    assert len(document["wasDerivedFrom"]) == 2


def test_what_is_lost_stays_in_the_document(made: tuple[Catalogue, Archive, Sealed, Sealed]) -> None:
    catalogue, archive, recorded, points = made
    archive.store.path(recorded.path).unlink()
    document = lineage_documents.document_of(catalogue, archive, [points.path])
    strictly(document)
    lost = document["entity"][f"file:{recorded.path}"]
    assert (lost["sms:readable"], lost["sms:sha256"]) == (False, recorded.content_hash)
