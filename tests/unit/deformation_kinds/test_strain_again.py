"""Strain over another gauge length is planned from what is stored: nothing is correlated again."""

from __future__ import annotations

from typing import Any

from sms_jobs.jobs.planning.graph import Existing, Request, plan
from sms_jobs.kinds.deformation import gauges, strain
from sms_jobs.kinds.deformation.gauges import GaugesParameters
from sms_jobs.kinds.deformation.strain import StrainParameters
from sms_jobs.kinds.kind import Kind, Need
from sms_jobs.kinds.parameters import Parameters
from sms_jobs.virtual_rig.campaigns import small_plate


def test_strain_and_gauges_alone_take_stored_displacement() -> None:
    _, campaign = small_plate("plate")
    asked: list[Need] = []

    def stored(need: Need) -> Existing | None:
        asked.append(need)
        return Existing(file_id=len(asked))

    for request in (
        Request("strain", {"gauge_length_mm": 30.0}),
        Request("gauges", {"gauge": "G1 x=0 y=0 length=20"}),
    ):
        jobs = plan(campaign, [request], stored)
        assert [job.kind.name for job in jobs] == [request.kind] * len(campaign.views)
        assert all(given.existing is not None and given.producer is None for j in jobs for given in j.inputs)
    assert {need.source for need in asked} == {"correlate", "reconstruct"}


def test_neither_reads_frames_or_textures(plate: Any) -> None:
    subject = plate.subject("S01", "C1P1")
    asked: tuple[tuple[Kind[Any], Parameters], ...] = (
        (strain.KIND, StrainParameters(gauge_length_mm=40.0)),
        (gauges.KIND, GaugesParameters(gauge=("G1 x=0 y=0 length=40",))),
    )
    for kind, chosen in asked:
        sources = {need.source for need in kind.checked_needs(plate.campaign, subject, chosen)}
        assert sources == {"correlate", "reconstruct"}
        assert plate.run(kind, subject, chosen).records
