"""Of those who amend a campaign at the same time none undoes what another gave, on both databases."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

from support.archives import Clock, registered
from support.jobs import NOW

from sms_jobs.archive import Archive
from sms_jobs.catalogue import campaigns
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.jobs.archiving.importing import add_states

LABELS = {f"X{number:02d}" for number in range(6)}


def test_states_that_are_added_at_once_are_all_there(
    catalogue: Catalogue, archive: Archive, clock: Clock
) -> None:
    registered(catalogue, archive, clock)
    with ThreadPoolExecutor(len(LABELS)) as pool:
        list(pool.map(lambda label: add_states(catalogue, archive, "plate", [label], NOW), sorted(LABELS)))
    with catalogue.reading() as session:
        row = campaigns.campaign_row(session, "plate")
        defined = [state.label for state in campaigns.definition(row).states]
        rows = campaigns.state_ids(session, row.id)
    assert len(defined) == len(set(defined))
    assert set(rows) == set(defined) >= LABELS
