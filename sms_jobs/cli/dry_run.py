"""Shows what recording some states would take."""

from __future__ import annotations

from sms_jobs.cli import output
from sms_jobs.records.shown.rehearsals import DryRun
from sms_jobs.records.sizes import number_of, size


def show(campaign: str, done: DryRun, as_json: bool) -> None:
    """Print a dry run for people or for programs."""
    if as_json:
        output.print_json(
            {
                "campaign": campaign,
                "states": {label: {**vars(s), "seconds": s.seconds} for label, s in done.states.items()},
                "seconds": done.seconds,
                "frames": done.frames,
                "raw_bytes": done.raw_bytes,
                "archived_bytes": done.archived_bytes,
                "packed": done.packed,
                "spool_bytes": done.spool_bytes,
                "spool_room": done.spool_room,
                "archive_room": done.archive_room,
                "missing": done.missing,
                "remarks": done.remarks,
                "ways": done.ways,
            }
        )
        return
    output.print_table(
        ["state", "moves [s]", "records [s]", "frames", "raw", "archived"],
        [
            (
                label,
                f"{s.moving_s:.1f}",
                f"{s.recording_s:.1f}",
                s.frames,
                size(s.raw_bytes),
                size(done.archived(s.raw_bytes)),
            )
            for label, s in done.states.items()
        ],
        empty="nothing could be rehearsed",
    )
    if done.states:
        packed = "at most: nothing of the sort was recorded with this rig yet"
        if done.packed is not None:
            packed = f"{done.packed:.0%} of raw, as before with this rig"
        output.print_facts(
            {
                "in all": f"{output.duration(done.seconds)}, {number_of(done.frames, 'frame')}",
                "raw": size(done.raw_bytes),
                "archived": f"{size(done.archived_bytes)} ({packed})",
                "free for it": size(done.archive_room),
                "spool": f"{size(done.spool_bytes)} a state, free {size(done.spool_room)}",
            }
        )
    for projector, words in done.ways.items():
        output.say(f"{projector}: {words}")
    for words in done.remarks:
        output.say(words)
    for words in done.missing:
        output.say(f"missing: {words}")
