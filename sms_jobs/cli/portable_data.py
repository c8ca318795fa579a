"""`sms data pack`, `check`, `unpack` and `provenance`: what leaves the archive, and comes into another."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from sms_jobs import bootstrap
from sms_jobs.archive import Checker
from sms_jobs.catalogue import search
from sms_jobs.cli import completion, output, writing
from sms_jobs.cli.calibration_acceptance import used_for
from sms_jobs.cli.output import Home, Json
from sms_jobs.errors import InvalidInput
from sms_jobs.formats.research_crate import CrateFile, as_text
from sms_jobs.jobs import lineage_documents, portable, portable_import
from sms_jobs.jobs.portable import Wanted
from sms_jobs.jobs.portable_import import CheckedFile
from sms_jobs.kinds import kind_named
from sms_jobs.kinds.kind import CALIBRATION, MEASUREMENT

_FINDINGS = 6
_ENTERED = ("indexed", "incomplete")

Folder = Annotated[Path, typer.Argument(help="Folder that 'sms data pack' made.")]
Force = Annotated[bool, typer.Option("--force", help="Replace a file that is there.")]


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
    if link and without_plugins:
        raise InvalidInput("--link takes files as they are; leave it out, or --without-plugins")
    for name in kind or []:
        if name not in (MEASUREMENT, CALIBRATION):
            kind_named(name)
    wanted = Wanted(campaign, tuple(sorted(set(kind or []))), inputs, without_plugins, link)
    now = datetime.now(UTC)
    with bootstrap.services(home) as services:
        with services.catalogue.reading() as session:
            parts = portable.chosen(session, wanted, now)
        writing.new_folder(to)
        done = portable.begin(to, wanted, parts)
        files: list[CrateFile] = []
        with output.byte_bar() as bar, Checker() as checker:
            task = bar.add_task("packing", total=max(sum(part.size_bytes for part in parts), 1))
            for part in parts:
                before = portable.brought_before(part, done)
                files += before or portable.bring(services.archive, to, wanted, part, checker)
                bar.advance(task, part.size_bytes)
        portable.finish(services.catalogue, services.archive, to, wanted, files, now)
    size = sum(one.size_bytes for one in files)
    if as_json:
        output.print_json({"folder": to, "files": len(parts), "bytes": size, "resumed": len(done)})
        return
    output.say(
        f"{len(parts)} files, {output.size(size)}, are in {to}; 'sms data check {to}' reads them again"
    )


def check(folder: Folder, as_json: Json = False) -> None:
    """Read every file of a packed folder and compare it with its checksum; needs no home.

    Files that are missing, altered, or not listed are named; the exit code is then 6.

    Example: sms data check /media/stick/wing
    """
    faults, count, size = _checked(folder)
    if as_json:
        output.print_json({"checked": count, "bytes": size, "faults": faults})
    else:
        _print_faults(faults, f"{count} files, {output.size(size)}: all as they were packed")
    if faults:
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
    faults, _, size = _checked(folder)
    if faults:
        _print_faults(faults, "")
        output.say("nothing was unpacked; get the folder again from where it was packed")
        raise typer.Exit(_FINDINGS)
    with bootstrap.services(home) as services, output.byte_bar() as bar:
        task = bar.add_task("unpacking", total=max(size, 1))
        done = list(
            portable_import.enter(
                services.catalogue,
                services.archive,
                folder,
                portable_import.manifest_of(folder),
                datetime.now(UTC),
                dry_run=dry_run,
                link=link,
                placed=lambda count: bar.advance(task, count),
            )
        )
        with services.catalogue.reading() as session:
            brought = search.calibrations_of_files(session, [one.path for one in done])
    bad = [one for one in done if one.outcome != "indexed"]
    entered = sum(one.outcome in _ENTERED for one in done)
    if as_json:
        output.print_json(
            {
                "done": not dry_run,
                "files": len(done),
                "indexed": entered,
                "not_well": bad,
                "calibrations": brought,
            }
        )
    else:
        if bad:
            rows = [(one.outcome, one.path, one.detail) for one in bad]
            output.print_table(["outcome", "file", "why"], rows, empty="")
        now = "would be" if dry_run else "are now"
        output.say(f"{entered} of {len(done)} files that were new {now} in the catalogue")
        for view in brought:
            output.say(
                f"calibration {view.id} of rig {view.rig} came along and is used for {used_for(view)}; "
                f"'sms calibration accept {view.id}' takes it into use for the rig"
            )
    if bad:
        raise typer.Exit(_FINDINGS)


def provenance(
    what: Annotated[str, typer.Argument(help="Number or archive path of a file, or name of a campaign.")],
    out: Annotated[
        Path | None, typer.Option("--output", "-o", help="File to write; the screen if not given.")
    ] = None,
    force: Force = False,
    home: Home = None,
) -> None:
    """Write where files come from as a W3C PROV document (PROV-JSON), for other programs.

    Files are entities with their hashes, jobs are activities with kind, version, parameters and times, and
    operators, versions of this program and computers are agents; back to what was measured.

    Example: sms data provenance 17 --output strain.prov.json; sms data provenance wing-fatigue
    """
    if out is not None:
        writing.check_new_file(out, force)
    with bootstrap.services(home) as services:
        with services.catalogue.reading() as session:
            paths = lineage_documents.paths_of(session, what)
        document = lineage_documents.document_of(services.catalogue, services.archive, paths)
    if out is None:
        output.print_line(document)
        return
    writing.write_file(out, as_text(document), force)
    output.say(f"wrote {out}: {len(document['entity'])} files and {len(document['activity'])} activities")


def _checked(folder: Path) -> tuple[list[CheckedFile], int, int]:
    """Return the faults of a folder, how many files were read, and their size."""
    manifest = portable_import.manifest_of(folder)
    faults: list[CheckedFile] = []
    size = 0
    with output.byte_bar() as bar:
        task = bar.add_task("checking", total=max(portable_import.size_of(folder, manifest), 1))
        for one in portable_import.check(folder, manifest):
            size += one.size_bytes
            bar.advance(task, one.size_bytes)
            if one.fault is not None:
                faults.append(one)
    return faults, len(manifest), size


def _print_faults(faults: list[CheckedFile], empty: str) -> None:
    output.print_table(["fault", "file"], [(one.fault, one.path) for one in faults], empty=empty)
