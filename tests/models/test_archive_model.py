"""The archive and its catalogue, driven at random against a dictionary of what lies where and what is wrong.

Jobs are run without their kinds: small records are sealed and registered as the runner does. Then files are
damaged, lost and left behind; verification must name exactly that, repair must mend what it says and lose
nothing, and a catalogue that is rebuilt from the files must equal the one that was kept. The deep form:

    bash ops/test.sh -m long tests/models/test_archive_model.py
"""

from __future__ import annotations

import shutil
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import Any, ClassVar, cast

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)
from sqlalchemy import delete, event, func, select
from support.archives import Clock, everything, registered
from support.sealing import measurement, point_cloud

from sms_jobs.archive import Archive, Checker, FolderStore, InputReference, Provenance
from sms_jobs.catalogue import campaigns, schema
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.every import written_tables
from sms_jobs.catalogue.tables.files import FileRow, ProvenanceRow
from sms_jobs.errors import NotFound
from sms_jobs.jobs.archiving import indexing
from sms_jobs.jobs.archiving.indexing import Entry
from sms_jobs.jobs.archiving.repository import Repository
from sms_jobs.jobs.keeping import repair, retention, verification
from sms_jobs.jobs.planning.graph import Request
from sms_jobs.jobs.planning.submission import Terms, submit
from sms_jobs.jobs.rebuilding import reindexing
from sms_jobs.jobs.results import reuse
from sms_jobs.jobs.running import lifecycle, recovery
from sms_jobs.jobs.running.lifecycle import Claim
from sms_jobs.kinds import kind_named
from sms_jobs.kinds.kind import MEASUREMENT
from sms_jobs.records.job import JobState
from sms_jobs.records.subject import Subject
from sms_jobs.virtual_rig.campaigns import small_plate

QUEUES = ["cpu", "io", "acquisition"]
STATES = [state.label for state in small_plate("plate")[1].states[:2]]
DAMAGES = ["data", "provenance", "cut", "lost"]
# Where a row of `everything` about a file has its source, its type, campaign, state and view, and its job.
SOURCE, STATE, OF, JOB = 1, 7, slice(5, 9), 9


class ArchiveCare(RuleBasedStateMachine):
    """Seals, damages, verifies, repairs, rebuilds and collects at random."""

    catalogue: ClassVar[Catalogue]
    scratch: ClassVar[Catalogue]
    checker: ClassVar[Checker]

    def __init__(self) -> None:
        super().__init__()
        self.folder = Path(tempfile.mkdtemp(prefix="sms-archive-model-"))
        self.archive = Archive(FolderStore(self.folder / "archive"))
        self.clock = Clock()
        self.rng = np.random.default_rng(5)
        # What the catalogue knows, and what is wrong with it: nothing, corrupt or missing.
        self.known: dict[str, str] = {}
        # What lies about besides, and what verification calls it.
        self.besides: dict[str, str] = {}
        self.failed_jobs: set[str] = set()

    def teardown(self) -> None:
        shutil.rmtree(self.folder)

    @initialize()
    def begin(self) -> None:
        for catalogue in (self.catalogue, self.scratch):
            empty(catalogue)
        registered(self.catalogue, self.archive, self.clock)
        with self.catalogue.writing() as session:
            recovery.register_worker(session, "w1", "here", 1, QUEUES, 2, self.clock())
        self.known = dict.fromkeys(self.archive.files(), "")

    # --- jobs ---------------------------------------------------------------------------------------

    @rule(
        kind=st.sampled_from(["simulate", "reconstruct"]), state=st.sampled_from(STATES), ends=st.booleans()
    )
    def work(self, kind: str, state: str, ends: bool) -> None:
        """Run a job to its end, or until it has sealed what it makes and fails."""
        try:
            with self.catalogue.writing() as session:
                submit(
                    session, "plate", [Request(kind, states=(state,))], self.clock(), Terms(use_cache=False)
                )
        except NotFound:
            assert kind == "reconstruct"
            assert not any(path.startswith(f"plate/{state}/") and "/simulate-" in path for path in self.known)
            return
        with self.catalogue.writing() as session:
            held = lifecycle.claim(session, QUEUES, "w1", 1, self.clock())
            assert held is not None
            inputs = indexing.resolve_inputs(session, held.job_id, self.clock())
            campaign = campaigns.definition(campaigns.campaign_row(session, "plate"))
        outputs = list(self.outputs(held, campaign.views, inputs))
        declared = kind_named(kind)
        key = reuse.reuse_key(
            declared,
            held.subject,
            held.parameters,
            declared.context(campaign, held.subject),
            {one.role: one.content_hash for one in inputs},
        )
        with self.catalogue.writing() as session:
            if ends:
                assert lifecycle.succeed(session, held, self.clock(), "done", reuse_key=key)
                now = self.clock()
                for one in outputs:
                    indexing.index(session, one, now)
            else:
                lifecycle.change(session, held.job_id, JobState.FAILED, self.clock(), "no", fence=held.fence)
        if not ends:
            self.failed_jobs.add(held.job_id)
        for one in outputs:
            if ends:
                self.known[one.sealed.path] = ""
            else:
                self.besides[one.sealed.path] = "unknown"

    def outputs(self, held: Claim, views: tuple[str, ...], inputs: Any) -> Iterator[Entry]:
        records = kind_named(held.kind).makes == MEASUREMENT
        repository = Repository(self.catalogue, self.archive)
        for subject in [Subject(held.subject.campaign, held.subject.state, p) for p in views]:
            numbers = {} if records else {"median_sigma_mm": float(self.rng.random())}
            came_from = Provenance(
                kind=held.kind,
                kind_version=kind_named(held.kind).version,
                subject=subject,
                job_id=held.job_id,
                attempt=held.attempt,
                created_at=self.clock(),
                parameters=held.parameters,
                inputs=tuple(InputReference(i.role, i.source, i.path, i.content_hash) for i in inputs),
                program_version="0.1.0",
                host="here",
                operator="somebody",
                statistics=numbers,
            )
            if records:
                recorded = replace(measurement(self.rng, 8, 6), recorded_at=came_from.created_at)
                yield repository.seal({MEASUREMENT: recorded}, came_from)
                continue
            yield repository.seal({"surface": point_cloud(self.rng)}, came_from)
            came_from = Provenance(**{**vars(came_from), "statistics": {}})
            text = str(self.rng.random())
            yield repository.seal_document(
                "page.txt", "text/plain", lambda path, text=text: path.write_text(text), came_from
            )

    # --- what goes wrong ------------------------------------------------------------------------------

    @rule(data=st.data(), how=st.sampled_from(DAMAGES))
    def damage(self, data: st.DataObject, how: str) -> None:
        whole = [path for path, wrong in sorted(self.known.items()) if not wrong]
        if not whole:
            return
        path = whole[data.draw(st.integers(0, len(whole) - 1), label="file")]
        file = self.archive.store.path(path)
        beside = file.with_name(f"{file.name}.provenance.json")
        self.known[path] = "missing" if how == "lost" else "corrupt"
        if how == "lost":
            file.unlink()
            return
        if how == "provenance" and beside.is_file():
            file = beside
        content = bytearray(file.read_bytes())
        place = len(content) - 1
        if how == "provenance":
            place = content.index(b"program_version", len(content) // 4 if file != beside else 0) + 3
        elif how == "data" and path.endswith(".h5"):
            place = a_place_in_a_chunk(file) or content.index(b'"campaign":')
        file.chmod(0o644)
        content[place] ^= 1 << data.draw(st.integers(0, 4), label="bit")
        file.write_bytes(content[:-1] if how == "cut" else content)

    @rule(what=st.sampled_from(["unfinished", "sidecar", "note"]), number=st.integers(0, 2))
    def leave_behind(self, what: str, number: int) -> None:
        folder = self.archive.store.root / "plate" / STATES[0]
        folder.mkdir(exist_ok=True)
        stem = f"reconstruct-20260301T12000{number}Z-feedbeef-1-page.txt"
        name = {
            "unfinished": f".{stem}.feedbeef{number:08d}.tmp",
            "sidecar": f"{stem}.provenance.json",
            "note": f"note {number}.txt",
        }[what]
        (folder / name).write_text(what)
        self.besides[f"plate/{STATES[0]}/{name}"] = "unfinished" if what == "unfinished" else "stray"

    # --- care -----------------------------------------------------------------------------------------

    def findings(self) -> list[verification.Finding]:
        checked = verification.check_known(self.catalogue, self.archive, checker=self.checker)
        found = [one.finding for one in checked if one.finding is not None]
        return found + list(verification.check_unknown(self.catalogue, self.archive))

    def expected(self) -> dict[str, str]:
        return {path: wrong for path, wrong in self.known.items() if wrong} | self.besides

    @rule()
    def verify(self) -> None:
        before = on_disk(self.archive)
        assert {f.path: f.problem for f in self.findings()} == self.expected()
        assert on_disk(self.archive) == before

    @rule(really=st.booleans())
    def mend(self, really: bool) -> None:
        before, said = on_disk(self.archive), everything(self.catalogue)
        findings = self.findings()
        steps = repair.planned(self.catalogue, self.archive, findings, self.checker)
        assert {f.path for f in findings} <= {one.path for one in steps}
        assert on_disk(self.archive) == before
        assert everything(self.catalogue) == said
        if not really:
            return
        assert repair.apply(self.catalogue, self.archive, steps, self.clock(), self.checker) == []
        # Not a byte is lost, whatever was done.
        assert not Counter(before.values()) - Counter(on_disk(self.archive).values())
        for one in steps:
            self.account_for(one)
        assert {f.path: f.problem for f in self.findings()} == self.expected()

    def account_for(self, one: repair.Repair) -> None:
        """Bring the model to where a step of a repair must have brought the archive."""
        wrong = self.known.get(one.path) or self.besides.get(one.path, "")
        assert one.problem == wrong
        if one.step == "index":
            # Whoever measured it: it cannot be measured again.
            assert "/simulate-" in one.path
            self.known[one.path] = ""
            del self.besides[one.path]
        elif one.step == "set-aside" and one.path in self.known:
            self.known[one.path] = "missing"
        elif one.step == "set-aside":
            del self.besides[one.path]
        elif one.step == "forget":
            del self.known[one.path]
        elif one.step == "seal-again":
            del self.known[one.path]
            stem = one.path.partition("-2026")[0]
            (again,) = (p for p in self.archive.files() if p.startswith(f"{stem}-"))
            self.known[again] = ""
        else:
            assert one.step == "nothing"
            assert one.then

    @rule()
    def collect(self) -> None:
        """Remove the results that newer ones have replaced, however young."""
        measured = self.paths(MEASUREMENT)
        gone = retention.remove(self.catalogue, self.archive, self.clock(), timedelta(0))
        for one in gone:
            assert one.kind == "reconstruct"
            del self.known[one.path]
        assert self.paths(MEASUREMENT) == measured

    def paths(self, source: str) -> list[str]:
        with self.catalogue.reading() as session:
            return list(session.scalars(select(FileRow.path).where(FileRow.source == source)))

    @precondition(lambda self: len(self.known) > 3)
    @rule()
    def rebuild(self) -> None:
        """Read the files into an empty catalogue, beside the one that is kept."""
        empty(self.scratch)
        paths = reindexing.unknown_files(self.scratch, self.archive)
        told = list(reindexing.reindex(self.scratch, self.archive, paths, checker=self.checker))
        entered = {one.path for one in told if one.outcome in ("indexed", "incomplete")}
        assert not entered & {path for path, wrong in self.known.items() if wrong}
        before, after = everything(self.catalogue), everything(self.scratch)
        if "plate/" not in "".join(p for p in entered if "/campaign-" in p):
            assert all(one.outcome != "indexed" or one.path.startswith("calibrations/") for one in told)
            return
        # A file of a job that failed tells nothing of the failure: to an empty catalogue it is a result.
        whole = {path for path, wrong in self.known.items() if not wrong}
        if not any("/calibration-" in path for path in whole):
            # What was decided about a calibration that is not there waits for it.
            whole = {path for path in whole if "/acceptance-" not in path}
        assert whole <= entered <= whole | {p for p, what in self.besides.items() if what == "unknown"}
        of_path = {row[0]: row for row in after["files"]}
        for row in before["files"]:
            if row[0] in whole:
                # When a result was recorded, its recording alone tells.
                known = len(row) - self.lacks_a_recording(row)
                assert of_path[row[0]][:known] == row[:known]
        if not self.expected():
            for table, rows in before.items():
                assert self.told(table, after[table], before) == self.told(table, rows, before), table

    def lacks_a_recording(self, row: Any) -> bool:
        """Say whether a row is about a result of a state of which a recording is damaged or lost."""
        recorded = f"plate/{row[STATE]}/"
        return row[SOURCE] != MEASUREMENT and any(
            wrong and path.startswith(recorded) and "/simulate-" in path for path, wrong in self.known.items()
        )

    def told(self, table: str, rows: list[Any], before: dict[str, list[Any]]) -> list[Any]:
        """Leave out what files cannot tell: jobs that failed, and those whose files were collected.

        Nor do they tell that a definition or a decision was sealed again; the order of these does not count.
        Of results that of those about one thing counts: an older one may have been indexed by a repair after
        newer ones about another.
        """
        if table == "files":
            return sorted(rows, key=lambda row: (row[SOURCE], *row[OF]) if row[JOB] else row[:1])
        if table not in ("jobs", "dependencies"):
            return rows
        makers = {row[JOB] for row in before["files"]} - self.failed_jobs
        return [row for row in rows if row[0] in makers]

    @invariant()
    def everything_known_has_what_it_was_made_from(self) -> None:
        with self.catalogue.reading() as session:
            count = session.scalar(select(func.count()).select_from(FileRow))
            edges = session.execute(
                select(FileRow.path, func.count(ProvenanceRow.role))
                .join(ProvenanceRow, ProvenanceRow.output_id == FileRow.id)
                .where(FileRow.source == "reconstruct")
                .group_by(FileRow.path)
            ).all()
            made = session.scalar(
                select(func.count()).select_from(FileRow).where(FileRow.source == "reconstruct")
            )
        assert count == len(self.known)
        assert len(edges) == made
        assert all(number == 2 for _, number in edges)


def empty(catalogue: Catalogue) -> None:
    with catalogue.writing() as session:
        for table in reversed(written_tables()):
            session.execute(delete(table))


def on_disk(archive: Archive) -> dict[str, bytes]:
    """Return the contents of all files that lie anywhere in the archive's folder."""
    return {
        str(p.relative_to(archive.store.root)): p.read_bytes()
        for p in archive.store.root.rglob("*")
        if p.is_file()
    }


def a_place_in_a_chunk(file: Path) -> int | None:
    """Return the middle of the first chunk of the first array that has any."""
    with h5py.File(file) as opened:
        places: list[int] = []

        def visit(_: str, node: Any) -> None:
            if isinstance(node, h5py.Dataset) and node.chunks:
                chunk = node.id.get_chunk_info(0)
                places.append(chunk.byte_offset + chunk.size // 2)

        opened.visititems(visit)
    return places[0] if places else None


@pytest.fixture
def machine(tmp_path: Path) -> Iterator[type[ArchiveCare]]:
    opened = []
    for name in ("kept", "scratch"):
        catalogue = Catalogue(f"sqlite:///{tmp_path / name}.sqlite", create=True)
        event.listen(catalogue.engine, "connect", _without_waiting_for_the_disk)
        schema.upgrade(catalogue)
        opened.append(catalogue)
    with Checker() as checker:
        made = type(
            "ArchiveCareOnce",
            (ArchiveCare,),
            {"catalogue": opened[0], "scratch": opened[1], "checker": checker},
        )
        yield cast("type[ArchiveCare]", made)
    for catalogue in opened:
        catalogue.close()


def _without_waiting_for_the_disk(connection: Any, _record: Any) -> None:
    connection.execute("PRAGMA synchronous = OFF")


QUIET = [HealthCheck.too_slow, HealthCheck.filter_too_much, HealthCheck.data_too_large]


def test_the_archive_is_cared_for_as_the_model_says(machine: type[ArchiveCare]) -> None:
    run_state_machine_as_test(  # type: ignore[no-untyped-call]
        machine, settings=settings(max_examples=6, stateful_step_count=25, suppress_health_check=QUIET)
    )


@pytest.mark.long
def test_the_archive_is_cared_for_as_the_model_says_for_long(machine: type[ArchiveCare]) -> None:
    run_state_machine_as_test(  # type: ignore[no-untyped-call]
        machine,
        settings=settings(
            max_examples=150,
            stateful_step_count=60,
            suppress_health_check=QUIET,
            derandomize=False,
            report_multiple_bugs=False,
            phases=[Phase.generate],
        ),
    )
