"""A catalogue that is lost comes back from the archive alone, on both deployments."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from support.archives import PLAN, Clock, emptied, everything, registered, run_jobs, work_again
from support.command import inside
from support.deployments import Deployment
from support.sealing import calibration, provenance
from support.sessions import small_session

from sms_jobs.archive import Archive, FolderStore
from sms_jobs.catalogue import campaigns
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.formats.importers.readings import Reading
from sms_jobs.jobs.archiving.importing import amend_campaign, with_readings, with_states
from sms_jobs.jobs.archiving.registration import defined, register_calibration
from sms_jobs.jobs.planning.graph import Request
from sms_jobs.jobs.rebuilding import reindexing
from sms_jobs.jobs.rebuilding.reindexing import Reindexed
from sms_jobs.records.campaign import Campaign, CampaignDefinition
from sms_jobs.records.subject import Subject
from sms_jobs.virtual_rig.campaigns import small_plate

REQUESTS = [Request("simulate"), Request("pipeline")]


@pytest.fixture
def shapes(catalogue: Catalogue, archive: Archive, clock: Clock) -> Archive:
    """An archive with a campaign, its recordings and shapes."""
    registered(catalogue, archive, clock)
    run_jobs(catalogue, archive, clock, [*REQUESTS[:1], Request("reconstruct")])
    return archive


@pytest.fixture
def filled(catalogue: Catalogue, archive: Archive, clock: Clock) -> Archive:
    """An archive with a campaign, two calibrations, recordings, shapes and documents."""
    registered(catalogue, archive, clock)
    register_calibration(catalogue, archive, calibration(), clock())
    run_jobs(catalogue, archive, clock, REQUESTS)
    return archive


def reindexed(catalogue: Catalogue, archive: Archive, *, dry_run: bool = False) -> list[Reindexed]:
    paths = reindexing.unknown_files(catalogue, archive)
    return list(reindexing.reindex(catalogue, archive, paths, dry_run=dry_run))


def test_an_empty_catalogue_is_rebuilt_equal_to_the_old_one(
    catalogue: Catalogue, filled: Archive, clock: Clock
) -> None:
    before = everything(catalogue)
    assert {"campaign", "calibration", "measurement", "reconstruct", "export"} < {
        f[1] for f in before["files"]
    }
    assert all(told for name, told in before.items() if name != "readings")  # nothing was read with it
    emptied(catalogue)
    rehearsed = reindexed(catalogue, filled, dry_run=True)
    assert not any(everything(catalogue).values())
    done = reindexed(catalogue, filled)
    assert rehearsed == done
    assert {one.outcome for one in done} == {"indexed"}
    after = everything(catalogue)
    for table, rows in before.items():
        assert after[table] == rows, table
    assert reindexed(catalogue, filled) == []
    assert everything(catalogue) == after
    # What was computed before the loss is reused after it.
    work_again(catalogue, clock)
    again = run_jobs(catalogue, filled, clock, REQUESTS)
    with catalogue.reading() as session:
        assert all(session.get_one(JobRow, job).reused_from for job in again)


@pytest.mark.parametrize("campaign", [small_session("it"), small_plate("it")[1]], ids=["session", "test"])
def test_a_campaign_is_read_as_it_was_sealed(tmp_path: Path, campaign: Campaign) -> None:
    archive, definition = Archive(FolderStore(tmp_path)), CampaignDefinition(campaign, PLAN)
    sealed = archive.seal_dataset({"campaign": definition}, defined("it", Clock()()))
    with archive.open(sealed) as dataset:
        assert dataset.read("campaign", CampaignDefinition) == definition


def test_an_interrupted_run_goes_on(catalogue: Catalogue, shapes: Archive) -> None:
    before = everything(catalogue)
    emptied(catalogue)
    paths = reindexing.unknown_files(catalogue, shapes)
    running = reindexing.reindex(catalogue, shapes, paths)
    first = [next(running) for _ in range(len(paths) // 2)]
    running.close()
    rest = reindexed(catalogue, shapes)
    # What was told before the interruption is not told again.
    assert not {one.path for one in first} & {one.path for one in rest}
    assert everything(catalogue) == before


def test_what_is_not_to_be_trusted_is_refused_with_a_reason(
    catalogue: Catalogue, shapes: Archive, deployment: Deployment
) -> None:
    catalogue_files = everything(catalogue)["files"]
    measured = [f[0] for f in catalogue_files if f[1] == "measurement"]
    made = [f[0] for f in catalogue_files if f[1] == "reconstruct"]
    document = shapes.seal_document(
        "field.csv", "text/csv", lambda path: path.write_text("1"), provenance(subject=Subject("plate"))
    )
    emptied(catalogue)
    flipped = bytearray(shapes.store.path(measured[0]).read_bytes())
    flipped[len(flipped) // 2] ^= 1
    shapes.store.path(measured[0]).chmod(0o644)
    shapes.store.path(measured[0]).write_bytes(flipped)
    moved = made[1].replace("-1.h5", "-2.h5")
    shutil.copy(shapes.store.path(made[1]), shapes.store.root / moved)
    beside = shapes.store.path(document.path)
    beside.with_name(f"{beside.name}.provenance.json").unlink()
    told = {one.path: one for one in reindexed(catalogue, shapes)}
    assert told[measured[0]].outcome == "refused"
    assert told[moved].outcome == "refused"
    assert "moved" in told[moved].detail
    assert told[document.path].outcome == "refused"
    assert "provenance" in told[document.path].detail
    # The shape is whole: only what it was made from is lost, which is said.
    assert told[made[0]].outcome == "incomplete"
    assert measured[0] in told[made[0]].detail
    # Nothing else suffers: not even the original of the copy that bears the name of a later attempt.
    others = set(told) - {measured[0], moved, document.path, made[0]}
    assert {told[path].outcome for path in others} == {"indexed"}
    environment = deployment.environment
    done = inside("archive", "reindex", "--home", str(deployment.home), environment=environment)
    assert done.returncode == 6, done.stderr
    assert "refused" in done.stdout


def test_results_without_their_campaign_say_what_to_do(catalogue: Catalogue, shapes: Archive) -> None:
    emptied(catalogue)
    (definition,) = (p for p in shapes.files() if p.startswith("plate/campaign-"))
    shapes.discard(definition)
    told = reindexed(catalogue, shapes)
    refused = [one for one in told if one.outcome == "no-campaign"]
    assert {one.path.split("/")[0] for one in told if one.outcome == "indexed"} == {"calibrations"}
    assert refused
    assert all("definition of campaign plate" in one.detail for one in refused)


def test_a_campaign_that_was_given_more_comes_back_as_it_was_last(
    catalogue: Catalogue, shapes: Archive, clock: Clock
) -> None:
    """Readings and states that came later are in definitions of their own; the older ones are no error."""
    with catalogue.reading() as session:
        first = campaigns.definition(campaigns.campaign_row(session, "plate"))
    readings = [Reading("S00", {"gauge_1": 1e-4}), Reading("S01", {"gauge_1": 2e-4}, load_n=750.0)]
    second, _ = with_readings(first, readings, replace_others=True)
    amend_campaign(catalogue, shapes, first, second, clock())
    third = with_states(second, ["S02"])
    amend_campaign(catalogue, shapes, second, third, clock())
    before = everything(catalogue)
    emptied(catalogue)
    rehearsed = reindexed(catalogue, shapes, dry_run=True)
    paths = reindexing.unknown_files(catalogue, shapes)
    # As if a catalogue from before the readings had been restored: it learns what came later.
    done = list(reindexing.reindex(catalogue, shapes, paths[:1]))
    with catalogue.reading() as session:
        assert campaigns.definition(campaigns.campaign_row(session, "plate")) == first
    done += reindexed(catalogue, shapes)
    assert {one.outcome for one in done} == {"indexed"}
    assert rehearsed == done
    after = everything(catalogue)
    # Definitions are entered before all else: only theirs is another place.
    for told in (before, after):
        told["files"] = [file for file in told["files"] if file[1] != "campaign"] + sorted(
            (file for file in told["files"] if file[1] == "campaign"), key=str
        )
    assert after == before
    with catalogue.reading() as session:
        assert campaigns.definition(campaigns.campaign_row(session, "plate")) == third


def test_a_later_definition_of_another_test_is_not_continued(
    catalogue: Catalogue, shapes: Archive, clock: Clock
) -> None:
    with catalogue.reading() as session:
        campaign = campaigns.definition(campaigns.campaign_row(session, "plate"))
    other = CampaignDefinition(replace(campaign, rig="another"), None)
    later = shapes.seal_dataset({"campaign": other}, defined("plate", clock()))
    emptied(catalogue)
    told = {one.path: one for one in reindexed(catalogue, shapes)}
    definitions = [path for path in told if path.startswith("plate/campaign-")]
    assert told[later.path].outcome == "indexed"
    (older,) = set(definitions) - {later.path}
    assert told[older].outcome == "refused"
    assert "which is of another test" in told[older].detail
