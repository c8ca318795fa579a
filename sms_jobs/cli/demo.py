"""`sms demo`: a whole simulated campaign through the real service, compared with the exact truth."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from enum import Enum
from pathlib import Path
from typing import Annotated, Any

import typer

from sms_jobs import bootstrap
from sms_jobs.app.work import kernels
from sms_jobs.app.work.waiting import Waiting
from sms_jobs.cli import output
from sms_jobs.cli.output import Json
from sms_jobs.cli.waiting import followed, remarks_as_json, tell_remarks
from sms_jobs.errors import SmsError
from sms_jobs.records.sizes import number_of


class Size(Enum):
    """Of the simulated cameras: 512 or 1024 px square."""

    SMALL = "small"
    FULL = "full"


def demo(
    size: Annotated[Size, typer.Option(help="Cameras of 512 (small) or 1024 (full) px square.")] = Size.SMALL,
    out: Annotated[Path, typer.Option(help="Folder for catalogue, archive and results.")] = Path("sms-demo"),
    as_json: Json = False,
) -> None:
    """Calibrate a simulated rig and measure a bending test with it, and compare with the exact truth.

    A board and a ball bar are shown to two cameras and two projectors in 31 poses. Then a top-hat profile
    is pushed out at its middle in three steps. Run again in the same folder, every result is reused.

    Example: sms demo --size full --out /tmp/demo
    """
    # Which loads the virtual rig: to complete a line takes none of it.
    from sms_jobs.app.home import demo as demo_

    home = bootstrap.initialise(out.absolute()).home
    with bootstrap.services(home) as services, _service(home) as still_there, followed() as show_on_bar:

        def tell(now: Waiting) -> None:
            still_there()
            left = kernels.kernels_left(services)
            show_on_bar(
                replace(now, running=f"{number_of(left, 'kernel')} to compile, {now.running}")
                if left
                else now
            )

        summary, remarks = demo_.run(services, size.value, say=_unsaid if as_json else output.say, tell=tell)
    if as_json:
        output.print_json(summary | remarks_as_json(remarks))
    else:
        _print_summary(summary)
        tell_remarks(remarks)


def _unsaid(text: str) -> None:
    """Say nothing: programs get the summary alone."""


@contextmanager
def _service(home: Path) -> Iterator[Any]:
    """Run `sms up` in a process of its own; yield a function that raises when it has ended."""
    log = home / "logs" / "up.log"
    with log.open("ab") as stream:
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", "sms_jobs.cli.main", "up", "--home", str(home)],
            stdin=subprocess.DEVNULL,
            stdout=stream,
            stderr=stream,
            process_group=0,
        )

    def still_there() -> None:
        if process.poll() is not None:
            raise SmsError(f"the service ended with code {process.returncode}; see {log}")

    try:
        yield still_there
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait()


def _print_summary(summary: dict[str, Any]) -> None:
    jobs = summary["jobs"]
    output.print_facts(
        {
            "campaign": summary["campaign"],
            "jobs": f"{jobs['succeeded']} succeeded ({jobs['reused']} reused), {jobs['failed']} failed",
            "took": f"{summary['seconds']:.0f} s",
            "report": summary["report"],
            "exports": f"{number_of(len(summary['exports']), 'file')} beside {summary['exports'][0]}",
        }
    )
    diagonal = summary["volume_diagonal_mm"]
    calibration = summary["calibration"]
    poses, session = calibration["poses"], calibration["session"]
    off, expected = 1e3 * calibration["point_error_rms_mm"], 1e3 * calibration["expected_point_rms_mm"]
    held_out, part = 1e3 * calibration["held_out_bar_rms_mm"], 1.0 / calibration["held_out_bar_relative"]
    output.print_facts(
        {
            "calibration": f"{calibration['number']}, of {session}: {poses} poses of board and ball bar",
            "held-out bar lengths": f"{held_out:.1f} um rms, 1/{part:,.0f} of the volume's diagonal",
            "what it costs": f"{off:.1f} um rms at points of the volume; {expected:.1f} um were expected",
        }
    )
    output.print_table(
        ["compared with exact truth", "rms error", "of the volume diagonal", "valid"],
        [
            (
                "shape",
                f"{1e3 * summary['shape_rms_mm']:.1f} um",
                f"1/{diagonal / summary['shape_rms_mm']:,.0f}",
                f"{100 * summary['shape_valid_fraction']:.1f} %",
            ),
            (
                "displacement",
                f"{1e3 * summary['displacement_rms_mm']:.1f} um",
                f"1/{diagonal / summary['displacement_rms_mm']:,.0f}",
                f"{100 * summary['displacement_valid_fraction']:.1f} %",
            ),
            (
                "strain",
                f"{summary['strain_rms_microstrain']:.0f} microstrain",
                None,
                f"{100 * summary['strain_valid_fraction']:.1f} %",
            ),
        ],
        empty="",
    )
