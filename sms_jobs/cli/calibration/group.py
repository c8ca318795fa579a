"""`sms calibration`: the calibrations of rigs."""

from __future__ import annotations

from datetime import datetime
from math import isfinite
from typing import TYPE_CHECKING, Annotated

import typer

from sms_jobs import bootstrap
from sms_jobs.app.calibrating import calibrations
from sms_jobs.app.calibrating.calibrations import QualitySummary
from sms_jobs.cli import completion, output
from sms_jobs.cli.asking import PasswordStdin, Reason, because, confirming
from sms_jobs.cli.calibration import acceptance, files, system_test
from sms_jobs.cli.output import Home, Json
from sms_jobs.records.times import parsed_time

if TYPE_CHECKING:
    from sms_jobs.records.sensors import Box

app = typer.Typer(help="Calibrations of rigs.", no_args_is_help=True)
app.add_typer(system_test.app, name="test")
app.command("export")(files.export)
app.command("import")(files.import_)
app.command("accept")(acceptance.accept)
app.command("withdraw")(acceptance.withdraw)

_FINDINGS = 6


@app.command("list")
def list_(
    rig: Annotated[str | None, typer.Option(help="Only of this rig.")] = None,
    inactive: Annotated[
        bool, typer.Option("--inactive", help="Only those that nothing is computed with.")
    ] = False,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Show calibrations, the one that became valid last first, and what each is used for.

    Where nobody knows from when on one is valid, it is the last.

    Example: sms calibration list --rig hall-3; sms calibration list --inactive
    """
    with bootstrap.services(home) as services:
        views = [v for v in calibrations.list_calibrations(services, rig) if v.inactive or not inactive]
    if as_json:
        output.print_json_list(views)
        return
    output.print_table(
        ["calibration", "rig", "used for", "valid from", "sensors", "origin"],
        [(v.id, v.rig, acceptance.used_for(v), v.valid_from, " ".join(v.sensors), v.origin) for v in views],
        empty="there is no inactive calibration" if inactive else "there is no calibration yet",
    )
    acceptance.tell_inactive(views)


@app.command()
def show(number: int, home: Home = None, as_json: Json = False) -> None:
    """Show the parameters of every sensor of a calibration, and what it is worth.

    Example: sms calibration show 1
    """
    from sms_jobs.app.calibrating import calibration_overview

    with bootstrap.services(home) as services:
        known = calibration_overview.overview(services, number)
    worth = {} if known.quality is None else _worth(known.volume, known.quality)
    if as_json:
        output.print_json(
            {
                "calibration": number,
                "rig": known.rig,
                "valid_from": known.valid_from,
                "origin": known.origin,
                "path": known.path,
                "sensors": known.sensors,
                "volume": known.volume,
                "quality": worth or None,
                "decisions": known.decisions,
            }
        )
        return
    output.print_facts(
        {
            "calibration": number,
            "rig": known.rig,
            "valid from": known.valid_from,
            "origin": known.origin,
            **dict(map(acceptance.in_words, known.decisions)),
            "volume diagonal [mm]": known.volume.diagonal_mm,
            **worth,
            "file": known.path,
        }
    )
    names = calibrations.distortion(known.sensors)
    output.print_table(
        ["sensor", "px", "fx, fy [px]", "cx, cy [px]", ", ".join(names), "pin-hole [mm]"],
        [
            (
                s.name,
                f"{s.columns} x {s.rows}",
                f"{s.intrinsics.fx:.2f}, {s.intrinsics.fy:.2f}",
                f"{s.intrinsics.cx:.2f}, {s.intrinsics.cy:.2f}",
                ", ".join(f"{getattr(s.intrinsics, name):g}" for name in names),
                ", ".join(f"{x:.2f}" for x in s.pose.centre()),
            )
            for s in known.sensors
        ],
        empty="",
    )
    for one in known.quality.warnings if known.quality else ():
        output.say(f"warning: {one}")


def _worth(volume: Box, worth: QualitySummary) -> dict[str, str | float | int]:
    """Return the few numbers by which a calibration is judged."""
    told: dict[str, str | float | int] = {"world": worth.gauge, "warnings": len(worth.warnings)}
    if worth.scale:
        told["scale"] = worth.scale
    if worth.shape_sigma_mm:
        told["shape, scale apart, of the diagonal"] = f"1/{volume.diagonal_mm / worth.shape_sigma_mm:,.0f}"
    told |= {name: float(f"{value:.4g}") for name, value in worth.estimates.items()}
    if (held_out := worth.held_out_bar_rms_mm) is not None:
        told["held-out bar lengths, rms [um]"] = round(1e3 * held_out, 3)
        told["of the volume's diagonal"] = f"1/{volume.diagonal_mm / held_out:,.0f}"
    if worth.expected_median_mm is not None and worth.expected_largest_mm is not None:
        told["expected deviation of a point, median [um]"] = round(1e3 * worth.expected_median_mm, 3)
        told["expected deviation of a point, largest [um]"] = round(1e3 * worth.expected_largest_mm, 3)
    return told


@app.command()
def certify(
    session: Annotated[
        str,
        typer.Argument(help="Name of the calibration session.", autocompletion=completion.campaign_names),
    ],
    valid_from: Annotated[
        str | None,
        typer.Option(help="From when on it is used, with zone; from the session's beginning if not given."),
    ] = None,
    despite_warnings: Annotated[
        bool, typer.Option("--despite-warnings", help="Take it into use though it has warnings.")
    ] = False,
    reason: Reason = None,
    password_stdin: PasswordStdin = False,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Take the calibration that a session gave into use.

    Measurements of the rig from that time on are computed with it; results that were computed with an
    older one show as stale in 'sms job explain', and are computed again when they are submitted. Whoever has
    a password here is asked for it.

    Example: sms calibration certify hall-3-june --valid-from 2026-06-01T08:00:00+01:00
    """
    since = None if valid_from is None else _time(valid_from)
    with bootstrap.services(home) as services:
        done = confirming(
            because(services, reason),
            password_stdin,
            lambda who: calibrations.certify(who, session, since, despite_warnings=despite_warnings),
        )
    number, calibration = done.number, done.calibration
    if as_json:
        output.print_json({"calibration": number, "new": done.new, "valid_from": done.valid_from})
        return
    output.say(
        f"calibration {number} of rig {calibration.rig.name} is valid{acceptance.since(done.valid_from)}"
        if done.new
        else f"it is in use already, as calibration {number}"
    )


def _time(text: str) -> datetime:
    return parsed_time(text, "--valid-from")


@app.command()
def compare(
    before: Annotated[int, typer.Argument(help="Number of the earlier calibration.")],
    after: Annotated[int, typer.Argument(help="Number of the later one.")],
    tolerance_mm: Annotated[
        float | None,
        typer.Option(
            help="Change of points from which on it matters; what the earlier lets expect if not given.",
            min=0.0,
        ),
    ] = None,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Say what changed between two calibrations of a rig, and whether it matters.

    Example: sms calibration compare 1 2
    """
    with bootstrap.services(home) as services:
        done = calibrations.compare(services, before, after, tolerance_mm)
    found, tolerance = done.comparison, done.tolerance_mm
    if as_json:
        output.print_json({"tolerance_mm": tolerance, "comparison": found})
        return
    output.print_facts({"verdict": found.verdict, "because": found.reason, "tolerance [um]": 1e3 * tolerance})
    output.print_table(
        ["view", "points move, rms [um]", "largest [um]", "aligned rms [um]", "aligned largest [um]"],
        [
            (
                f"{p.camera}{p.projector}",
                f"{1e3 * p.rms_mm:.2f}",
                f"{1e3 * p.largest_mm:.2f}",
                f"{1e3 * p.aligned_rms_mm:.2f}",
                f"{1e3 * p.aligned_largest_mm:.2f}",
            )
            for p in found.pairs
        ],
        empty="",
    )
    changes = sorted((c for c in found.changes if isfinite(c.z)), key=lambda c: abs(c.z), reverse=True)
    output.print_table(
        ["sensor", "parameter", "change", "in standard deviations"],
        [(c.sensor, c.parameter, f"{c.change:.3g}", f"{c.z:.1f}") for c in changes[:10]],
        empty="no parameter's standard deviation is known",
    )


@app.command()
def check(
    tuples: Annotated[
        list[str], typer.Argument(help="Tuples campaign/state/view whose shape has been measured.")
    ],
    baseline_mm: Annotated[
        float,
        typer.Option(help="Systematic gap that is usual for this rig, from texture or defocus.", min=0.0),
    ] = 0.01,
    false_alarm: Annotated[
        float,
        typer.Option(
            help="Probability that a calibration that holds is said to have drifted.", min=1e-9, max=0.5
        ),
    ] = 0.001,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Decide from ordinary measurements, by their ray gaps, whether the calibration still holds.

    "Points off" is what the smallest change of the sensors that explains the gap does to the measured points.

    The exit code is 6 when one does not.

    Example: sms calibration check wing-fatigue/S00/C1P1 wing-fatigue/S00/C2P2
    """
    with bootstrap.services(home) as services:
        found = calibrations.check(services, tuples, baseline_mm=baseline_mm, false_alarm=false_alarm)
    if as_json:
        output.print_json_list(found)
    else:
        output.print_table(
            [
                "tuple",
                "calibration",
                "verdict",
                "gap, rms [um]",
                "points off, rms [um]",
                "sigma [um]",
                "because",
            ],
            [
                (
                    f.subject,
                    f.calibration,
                    f.check.verdict,
                    f"{1e3 * f.check.gap_rms_mm:.1f}",
                    f"{1e3 * f.check.point_change_rms_mm:.1f}",
                    f"{1e3 * f.check.point_change_sigma_mm:.1f}",
                    f.check.reason,
                )
                for f in found
            ],
            empty="",
        )
    if any(f.check.verdict == "drifted" for f in found):
        raise typer.Exit(_FINDINGS)
