"""`sms data`: the commands that find, look at and take out what the archive holds."""

from __future__ import annotations

import typer

from sms_jobs.cli.commands import Command, Commands

TABLE = {
    "find": Command(
        "Find measurements, results and calibrations, the newest first; docs/query.md has the language.",
        "cli.found_files",
        "find",
    ),
    "states": Command(
        "Find load states by what is known of them and what their results tell; "
        "docs/query.md has the language.",
        "cli.found_states",
        "states",
    ),
    "show": Command(
        "Show a file: what it is about, its statistics, what was read while it was "
        "recorded, and its records.",
        "cli.archived",
        "show",
    ),
    "tree": Command(
        "Show what a file was computed from, back to what was measured; or all that was computed from it.",
        "cli.archived",
        "tree",
    ),
    "plot": Command(
        "Draw an image field with colour bar and unit as PNG; of a camera alone, over its reference image.",
        "cli.archived",
        "plot",
    ),
    "query": Command("Questions to the archive that are kept under a name.", "cli.saved_queries"),
    "export": Command(
        "Write a result for other programs, or copy a sealed file, e.g. a report, out of the archive.",
        "cli.exporting",
        "export",
    ),
    "formats": Command(
        "List the formats of 'sms data export --as' and of the job kind export.",
        "cli.exporting",
        "formats",
    ),
    "pin": Command(
        "Keep a file, and all that it was computed from, whatever `sms archive gc` is asked to remove.",
        "cli.pins",
        "pin",
    ),
    "unpin": Command("Let a policy decide about a file again.", "cli.pins", "unpin"),
    "pins": Command("Show the files that are pinned, and why.", "cli.pins", "pins"),
    "outline": Command(
        "Print the outlines of a mask image, for the region-of-interest of 'sms job submit correlate'.",
        "cli.outline",
        "outline",
    ),
    "gauges": Command(
        "Show what virtual strain gauges read, state by state, beside real ones.",
        "cli.surface_places",
        "gauges",
    ),
    "section": Command(
        "Show a field along a line on the surface, which is seen along the world's Z axis, or in the image.",
        "cli.surface_places",
        "section",
    ),
    "advise": Command(
        "Say how coarse and how noisy a texture is, and what subsets and gauge lengths it is good for.",
        "cli.advice",
        "advise",
    ),
    "compare": Command(
        "Subtract another displacement from a merged one: measured minus other, at the measured points.",
        "cli.comparing",
        "compare",
    ),
    "compare-states": Command(
        "Subtract another displacement from the merged one at every state: maps, and rms over the states.",
        "cli.comparing",
        "compare_states",
    ),
    "pack": Command(
        "Export a campaign with all that it depends on into a portable folder, for "
        "another home or a repository.",
        "cli.portable_data",
        "pack",
    ),
    "check": Command(
        "Read every file of a packed folder and compare it with its checksum; needs no home.",
        "cli.portable_data",
        "check",
    ),
    "unpack": Command(
        "Bring the files of a packed folder into this archive and its catalogue.",
        "cli.portable_data",
        "unpack",
    ),
    "provenance": Command(
        "Write where files come from as a W3C PROV document (PROV-JSON), for other programs.",
        "cli.portable_data",
        "provenance",
    ),
}


class _Data(Commands):
    table = TABLE


app = typer.Typer(cls=_Data, help="Measurements and results in the archive.", no_args_is_help=True)
