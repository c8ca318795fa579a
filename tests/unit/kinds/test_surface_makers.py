"""Each view has one kind that measures its surface, and what follows asks that kind."""

from __future__ import annotations

from dataclasses import replace

from sms_jobs.kinds import all_kinds
from sms_jobs.kinds.kind import default_subjects
from sms_jobs.kinds.surface_ports import MAKERS, maker_of
from sms_jobs.virtual_rig.campaigns import small_plate

VIEWS = ("C1P1", "C1C2", "C1C2C3", "C1C2P1", "C4")


def test_the_surface_of_a_view_is_made_by_the_kind_that_is_asked_for_it() -> None:
    _, campaign = small_plate("plate")
    several = replace(campaign, views=VIEWS)
    made = {
        (maker.kind, subject.view)
        for maker in MAKERS
        for subject in default_subjects(all_kinds()[maker.kind], several)
    }
    assert made == {(maker_of(view).kind, view) for view in VIEWS}


def test_what_is_said_of_a_maker_is_what_its_kind_declares() -> None:
    for maker in MAKERS:
        assert set(maker.products) <= set(all_kinds()[maker.kind].records)
