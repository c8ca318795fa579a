"""Under which role a job keeps an input, and what finds an input by its port."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.homes import WHEN, make_home, stored
from support.planes import moved_in_plane, one_region, plane, strain_in_plane

from sms_jobs import bootstrap
from sms_jobs.app.holdings import files
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import campaigns
from sms_jobs.catalogue.tables.files import ProvenanceRow
from sms_jobs.formats.figures import plot_record
from sms_jobs.kinds import all_kinds, kind_named
from sms_jobs.kinds.kind import MEASUREMENT, Need
from sms_jobs.records.input_roles import port_of, role_at
from sms_jobs.records.measurement import ArrayStack, FringeSequence, Measurement
from sms_jobs.records.reasons import Reason
from sms_jobs.records.subject import Subject

ROWS, COLUMNS = SHAPE = (40, 60)
BARE = np.where(np.indices(SHAPE).sum(axis=0) < ROWS, np.uint32(Reason.NO_TEXTURE), np.uint32(0))
"""A corner of the image shows nothing that could be matched."""


@pytest.mark.parametrize("about", [None, Subject("wing"), Subject("wing", "S01", "C1P2")], ids=str)
def test_a_role_tells_its_port(about: Subject | None) -> None:
    names = {port.name for kind in all_kinds().values() for port in kind.inputs}
    assert {name: port_of(role_at(name, about)) for name in names} == {name: name for name in names}


def records_of(kind: str, state: str | None) -> dict[str, Any]:
    """Return what a camera alone has of a plate: at rest its image is striped, later it is dark."""
    own = plane(BARE)
    if kind == MEASUREMENT:
        image = np.where(np.indices(SHAPE)[0] % 8 < 4, 200 if state == "S00" else 7, 7).astype(np.uint16)
        return {
            "measurement": Measurement(WHEN, FringeSequence(), 255, 0.0, 1.0, image, ArrayStack(image[None]))
        }
    moved = moved_in_plane(own, np.ones(SHAPE), np.ones(SHAPE))
    return {
        "plane": {"surface": own},
        "correlate": {"displacement": moved, "regions": one_region(own)},
        "strain": {"strain": strain_in_plane(own)},
    }[kind]


class Shelf:
    """Files of the plate as kinds would have made them, each with the inputs that its kind asks for."""

    def __init__(self, services: Services) -> None:
        self.services = services
        self.files: dict[tuple[str, Subject], int] = {}
        with services.catalogue.reading() as session:
            self.campaign = campaigns.definition(campaigns.campaign_row(session, "plate"))

    def file(self, kind: str, about: Subject) -> int:
        if (kind, about) in self.files:
            return self.files[kind, about]
        needs: tuple[Need, ...] = ()
        if kind != MEASUREMENT:
            declared = kind_named(kind)
            needs = declared.checked_needs(self.campaign, about, declared.parameters())
        given = {need.role: self.file(need.source, need.subject) for need in needs}
        records = records_of(kind, about.state)
        number = stored(self.services, kind, str(about), records, len(self.files))
        with self.services.catalogue.writing() as session:
            for role, one in given.items():
                session.add(ProvenanceRow(output_id=number, role=role, input_id=one))
        self.files[kind, about] = number
        return number


def test_what_a_camera_alone_measured_is_drawn_over_its_reference_image(home: Path) -> None:
    make_home(home, {})
    with bootstrap.services(home) as services:
        strain = Shelf(services).file("strain", Subject("plate", "S01", "C1"))
        drawn = files.picture(services, str(strain))
    field, image = strain_in_plane(plane(BARE)), records_of(MEASUREMENT, "S00")["measurement"].texture
    assert drawn == plot_record(field, behind=image)
    assert drawn != plot_record(field)
