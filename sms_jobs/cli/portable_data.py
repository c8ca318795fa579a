"""`sms data pack`, `check`, `unpack` and `provenance`: what leaves the archive, and comes into another."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sms_jobs import bootstrap
from sms_jobs.app import writing
from sms_jobs.cli import bars, completion, output
from sms_jobs.cli.calibration.acceptance import used_for
from sms_jobs.cli.options import Force
from sms_jobs.cli.output import Home, Json
from sms_jobs.records.sizes import number_of, size

if TYPE_CHECKING:
    from sms_jobs.app.holdings.packing import CheckedFolder

_FINDINGS = 6

Folder = Annotated[Path, typer.Argument(help="Folder that 'sms data pack' made.")]


def pack(
    campaign: Annotated[
        str,
        typer.Option(
            "--campaign", "-c", help="Whose files are packed.", autocompletion=completion.campaign_names
        ),
    ],
    to: Annotated[Path, typer.Option(help="Folder, empty or new.")],
    kind: Annotated[
        list[str] | None,
        typer.Option(
            help="Only results of this kind, and what they were computed from; can be repeated.",
            autocompletion=completion.kind_names,
        ),
    ] = None,
    inputs: Annotated[
        bool, typer.Option("--inputs/--no-inputs", help="Also what the files were computed from.")
    ] = True,
    without_plugins: Annotated[
        bool,
        typer.Option("--without-plugins", help="Pack with gzip alone, for readers without HDF5 plugins."),
    ] = False,
    link: Annotated[
        bool, typer.Option("--link", help="Hard links in place of copies; one disk only.")
    ] = False,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Export a campaign with all that it depends on into a portable folder, for another home or a repository.

    The folder is a BagIt bag with an RO-Crate: the files as they lie in the archive, each read again after it
    was copied, with checksums, a description, and a PROV document of where they come from. 'sms data unpack'
    reads it in another home, 'sms data check' without any. Interrupted, the same command goes on.

    Example: sms data pack -c wing-fatigue --to /media/stick/wing
    """
    from sms_jobs.app.holdings import packing

    with bootstrap.services(home) as services, bars.followed(bars.byte_bar()) as tell:
        done = packing.pack(
            services,
            campaign,
            to,
            kinds=tuple(kind or ()),
            inputs=inputs,
            without_plugins=without_plugins,
            link=link,
            tell=tell,
        )
    if as_json:
        output.print_json(
            {"folder": to, "files": done.files, "bytes": done.size_bytes, "resumed": done.resumed}
        )
        return
    output.say(
        f"packed {number_of(done.files, 'file')}, {size(done.size_bytes)}, into {to}; "
        f"'sms data check {to}' reads them again"
    )


def check(folder: Folder, as_json: Json = False) -> None:
    """Read every file of a packed folder and compare it with its checksum; needs no home.

    Files that are missing, altered, or not listed are named; the exit code is then 6.

    Example: sms data check /media/stick/wing
    """
    found = _checked(folder)
    if as_json:
        output.print_json({"checked": found.files, "bytes": found.size_bytes, "faults": found.faults})
    else:
        _print_faults(
            found, f"{number_of(found.files, 'file')}, {size(found.size_bytes)}: all as they were packed"
        )
    if found.faults:
        raise typer.Exit(_FINDINGS)


def unpack(
    folder: Folder,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say what would be done, and change nothing.")
    ] = False,
    link: Annotated[
        bool, typer.Option("--link", help="Hard links in place of copies; one disk only.")
    ] = False,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Bring the files of a packed folder into this archive and its catalogue.

    Every file is compared with its checksum first; if one fails, nothing is brought. Then each is judged as
    'sms archive reindex' does, and what is refused is taken out again. What is there already is passed over.
    Calibrations that come along are used for the campaigns that come with them and are new here, and for
    nothing else before 'sms calibration accept'.
    The exit code is 6 when something was refused or lacks an input. Interrupted, the same command goes on.

    Example: sms data unpack /media/stick/wing --dry-run; sms data unpack /media/stick/wing
    """
    checked = _checked(folder)
    if checked.faults:
        _print_faults(checked, "")
        output.say("nothing was unpacked; get the folder again from where it was packed")
        raise typer.Exit(_FINDINGS)
    from sms_jobs.app.holdings import packing

    with bootstrap.services(home) as services, bars.followed(bars.byte_bar()) as tell:
        done = packing.unpack(services, folder, checked, dry_run=dry_run, link=link, tell=tell)
    if as_json:
        output.print_json(
            {
                "done": not dry_run,
                "files": len(done.files),
                "indexed": done.entered,
                "not_well": done.not_well,
                "calibrations": done.calibrations,
            }
        )
    else:
        if done.not_well:
            rows = [(one.outcome, one.path, one.detail) for one in done.not_well]
            output.print_table(["outcome", "file", "why"], rows, empty="")
        now = "would be" if dry_run else "are now"
        if done.files:
            output.say(f"{done.entered} of {len(done.files)} files that were new {now} in the catalogue")
        else:
            output.say("nothing is new: every file of the folder is in the catalogue already")
        for view in done.calibrations:
            output.say(
                f"calibration {view.id} of rig {view.rig} came along and is used for {used_for(view)}; "
                f"'sms calibration accept {view.id}' takes it into use for the rig"
            )
    if done.not_well:
        raise typer.Exit(_FINDINGS)


def provenance(
    what: Annotated[str, typer.Argument(help="Number or archive path of a file, or name of a campaign.")],
    out: Annotated[
        Path | None, typer.Option("--output", "-o", help="JSON file to write; the screen if not given.")
    ] = None,
    force: Force = False,
    home: Home = None,
) -> None:
    """Write where files come from as a W3C PROV document (PROV-JSON), for other programs.

    Files are entities with their hashes, jobs are activities with kind, version, parameters and times, and
    operators, versions of this program and computers are agents; back to what was measured.

    Example: sms data provenance 17 --output strain.prov.json; sms data provenance wing-fatigue
    """
    from sms_jobs.app.holdings import packing

    if out is not None:
        writing.check_new_file(out, force, (".json",))
    with bootstrap.services(home) as services:
        found = packing.provenance(services, what)
    document = found.document
    if out is None:
        output.print_line(document)
        return
    writing.write_file(out, found.text, force)
    made, by = len(document["entity"]), len(document["activity"])
    output.say(f"wrote {out}: {number_of(made, 'file')} and {by} {'activity' if by == 1 else 'activities'}")


def _checked(folder: Path) -> CheckedFolder:
    from sms_jobs.app.holdings import packing

    with bars.followed(bars.byte_bar()) as tell:
        return packing.check(folder, tell)


def _print_faults(found: CheckedFolder, empty: str) -> None:
    output.print_table(["fault", "file"], [(one.fault, one.path) for one in found.faults], empty=empty)
