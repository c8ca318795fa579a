"""Kinds take and give what they declare, and nothing else."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from sms_jobs.kinds import all_kinds
from sms_jobs.kinds.deformation import strain
from sms_jobs.kinds.documents import Document, DocumentOutput
from sms_jobs.kinds.kind import DatasetOutput, Inputs, Kind, Port
from sms_jobs.kinds.products import MERGED, MESH, REGIONS, STRAIN
from sms_jobs.kinds.reporting import report
from sms_jobs.records.fields import Regions
from sms_jobs.records.subject import Subject
from sms_jobs.testing.in_memory import InMemory
from sms_jobs.virtual_rig.campaigns import small_plate

SUBJECT = Subject("plate", "S01", "C1P1")


@pytest.mark.parametrize("kind", all_kinds().values(), ids=lambda kind: str(kind.name))
def test_ports_and_products_of_a_kind_can_be_told_apart(kind: Kind[Any]) -> None:
    # A name may stand for two sources, of which a job has one; a source and name, once.
    assert len({(port.name, port.source) for port in kind.inputs}) == len(kind.inputs)
    assert len({product.name for product in kind.records}) == len(kind.records)
    documents = [one for one in kind.outputs if isinstance(one, Document)]
    assert len({(one.name, one.media_type) for one in documents}) == len(documents)
    # Whatever runs gives something, and nobody has to run it to learn what.
    assert kind.outputs


def test_what_is_not_declared_is_refused() -> None:
    _, campaign = small_plate("plate")
    silent = replace(strain.KIND, inputs=())
    with pytest.raises(TypeError, match="strain does not declare its input displacement of correlate"):
        silent.checked_needs(campaign, SUBJECT, strain.StrainParameters())
    regions = Regions((), None)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="strain does not declare its output regions"):
        strain.KIND.checked(DatasetOutput(SUBJECT, {REGIONS: regions}, {}))
    with pytest.raises(TypeError, match="strain of strain is Regions, not StrainField"):
        strain.KIND.checked(DatasetOutput(SUBJECT, {STRAIN: regions}, {}))
    with pytest.raises(TypeError, match="strain does not declare its output strain_C1"):
        strain.KIND.checked(DatasetOutput(SUBJECT, {STRAIN.of("C1"): regions}, {}))
    page = DocumentOutput(SUBJECT, report.PAGE, "plate-report.html", lambda path: None)
    with pytest.raises(TypeError, match=r"strain does not declare its document plate-report\.html"):
        strain.KIND.checked(page)
    assert report.KIND.checked(page) is page
    picture = replace(page, document=replace(report.PAGE, media_type="image/png"))
    with pytest.raises(TypeError, match="report does not declare its document"):
        report.KIND.checked(picture)


def test_a_port_gives_only_what_it_declares() -> None:
    port = Port("shape", "reconstruct", (REGIONS,), several=True)
    other = replace(SUBJECT, view="C1P2")
    of = {one: Regions((), None) for one in (SUBJECT, other)}  # type: ignore[arg-type]
    datasets = {port.role(one): InMemory(one, {"regions": found}) for one, found in of.items()}
    inputs = Inputs(Subject("plate", "S01"), None, datasets)
    assert inputs.about(port) == (SUBJECT, other)
    assert inputs.read(port, REGIONS, other) is of[other]
    assert inputs.has(port, REGIONS, other)
    assert not inputs.has(port, MESH, other)
    assert not inputs.has(port)
    with pytest.raises(TypeError, match="port shape does not declare that mesh is read"):
        inputs.read(port, MESH, other)


def test_products_with_keys_are_found_among_names() -> None:
    names = ["merged_C1", "mesh", "merged_C2", "merges"]
    assert [one.key for one in MERGED.among(names)] == ["C1", "C2"]
    assert MERGED.of("C1").stored_as == "merged_C1"
    assert MERGED.of("C1").any_key == MERGED
