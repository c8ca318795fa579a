"""Reads: whoever reads a file of the archive notices when it is not what was sealed, for next to nothing."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

from sms_jobs.bench.cost_of_checks import measured
from sms_jobs.bench.figures import Condition, Figure, Found, Run
from sms_jobs.bench.promises import Promise
from sms_jobs.bench.tampering import prepare, tried
from sms_jobs.virtual_rig.campaigns import small_plate, top_hat_bending

_JOBS_AMONG = 50
_TURNS = 9


def measure(run: Run) -> Iterator[Found]:
    """Yield the figures and their conditions."""
    count = 200 if run.quick else 10_000
    run.say(f"reads: {count} altered files")
    folder = run.folder / "reads"
    folder.mkdir()
    prepare(folder)
    with_jobs = count // _JOBS_AMONG
    files = Counter(tried(folder, "reads", count - with_jobs))
    jobs = Counter(tried(folder, "jobs", with_jobs))
    counts = files + jobs
    felt = count - counts["same"]
    yield Figure("tampered_reads_noticed", counts["noticed"] / felt, "1", 1.0)
    yield Figure("tampered_reads_with_other_values", float(counts["changed"]), "", 0.0, "at most")
    yield Condition(
        "tampered_reads",
        f"{count} times a file of a small campaign, calibration, recordings, results, documents, has a bit "
        "flipped anywhere (60 %) or in one of its texts (25 %), or another of its sort in its place (15 %); "
        f"{count - with_jobs} are opened and read as a whole, as a job and as an earlier result, and for "
        f"{with_jobs} a job runs whose input or earlier result it is. The share is of those that changed "
        f"anything that is read: {counts['noticed']} were noticed, of {counts['same']} bits nothing is read; "
        f"{counts['changed']} gave other values, {counts['unclear']} failed without naming the file, "
        f"{counts['ended']} made HDF5 spin",
    )
    yield from _cost(run)


def _cost(run: Run) -> Iterator[Found]:
    made = small_plate("cost") if run.quick else top_hat_bending("cost", "small")
    folder = run.folder / "cost-of-reads"
    folder.mkdir()
    costs = list(measured(folder, made, _TURNS, run.say))
    jobs, compared, uncompared = (
        sum(c) for c in zip(*((c.job, c.compared, c.uncompared) for c in costs), strict=True)
    )
    yield Figure("checked_reads_share_of_job", (compared - uncompared) / jobs, "1", 0.03, "at most")
    pixels = "128" if run.quick else "512"
    yield Condition(
        "checked_reads",
        "by how much longer reading takes where what is read is compared, in CPU time, over that of the jobs "
        f"of one tuple, archive to archive; cameras of {pixels} px, one thread, the least of {_TURNS}: "
        + ", ".join(
            f"{c.kind} reads for {c.compared:.3f} and {c.uncompared:.3f} of {c.job:.2f} s" for c in costs
        ),
    )


PROMISE = Promise("reads", measure)
