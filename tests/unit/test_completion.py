"""What the shell is offered on Tab."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from support.homes import make_home

from sms_jobs.app.work import kinds
from sms_jobs.bench.groups import all_groups
from sms_jobs.bench.studies import all_studies
from sms_jobs.cli import completion
from sms_jobs.discovery import told_names
from sms_jobs.kinds import all_kinds
from sms_jobs.kinds.recording import acquire, names, stream


class Line:
    """The part of a command line's context that completion looks at."""

    def __init__(self, **params: Any) -> None:
        self.params = params


@pytest.fixture
def made(home: Path) -> Path:
    make_home(home, {})
    return home


def test_campaigns_states_and_pairs_of_the_home_are_offered(made: Path) -> None:
    line: Any = Line(home=made, campaign="plate")
    assert completion.campaign_names(line, "") == ["plate"]
    assert completion.campaign_names(line, "wing") == []
    assert completion.state_labels(line, "S0") == ["S00", "S01"]
    assert completion.view_names(line, "C1P2") == ["C1P2"]
    assert completion.job_ids(line, "") == []


def test_a_half_typed_line_offers_nothing_and_breaks_nothing(made: Path, tmp_path: Path) -> None:
    nowhere: Any = Line(home=tmp_path / "nowhere")
    assert completion.campaign_names(nowhere, "") == []
    assert completion.state_labels(Line(home=made, campaign="wing"), "") == []  # type: ignore[arg-type]


def test_every_kind_is_offered_as_it_describes_itself() -> None:
    (everything, _), *each = completion.kind_names("")
    assert everything == kinds.EVERYTHING
    assert dict(each) == {kind.name: kind.summary for kind in all_kinds().values()}


def test_groups_and_studies_are_offered_by_the_names_that_they_declare() -> None:
    assert told_names("sms_jobs.bench.groups", "GROUP") == sorted(all_groups())
    assert told_names("sms_jobs.bench.studies", "STUDY") == sorted(all_studies())


def test_what_records_with_instruments_is_known_by_the_names_of_its_kinds() -> None:
    assert (acquire.KIND.name, stream.KIND.name) == names.RECORDING
    assert acquire.KIND.name == names.ACQUIRE
