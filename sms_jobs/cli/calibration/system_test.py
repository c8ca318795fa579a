"""`sms calibration test`: whether a measuring system is as good as somebody says, by artefacts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, TypeVar

import typer

from sms_jobs import bootstrap
from sms_jobs.app.calibrating import system_tests
from sms_jobs.app.calibrating.system_tests import BarCertificate, PlateCertificate
from sms_jobs.cli import completion, output
from sms_jobs.cli.output import Home, Json
from sms_jobs.errors import InvalidInput

app = typer.Typer(help="Test a measuring system by artefacts with certificates.", no_args_is_help=True)

_FINDINGS = 6
_Sigma = TypeVar("_Sigma", str, float)


@app.command()
def plan(
    rig: Annotated[str, typer.Argument(help="Name of the rig.")],
    name: Annotated[str, typer.Option("--name", help="Of the campaigns: NAME-bar and NAME-plate.")],
    bar: Annotated[
        str | None,
        typer.Option(help="Certified distance of a bar's spheres and their radius in mm, as 480,25."),
    ] = None,
    bar_sigma: Annotated[
        str | None,
        typer.Option(help="Standard uncertainties of both in mm, as 0.005,0.002; 0 is exact."),
    ] = None,
    bar_form_sigma: Annotated[
        float | None,
        typer.Option(min=0.0, help="Standard uncertainty of the spheres' roundness in mm; 0 is exact."),
    ] = None,
    plate: Annotated[
        str | None, typer.Option(help="Width and height of a flat plate in mm, as 300,200.")
    ] = None,
    plate_form_sigma: Annotated[
        float | None,
        typer.Option(min=0.0, help="Standard uncertainty of the plate's flatness in mm; 0 is exact."),
    ] = None,
    like: Annotated[
        str | None,
        typer.Option(
            help="A campaign of the rig whose views, patterns and virtual scene are taken.",
            autocompletion=completion.campaign_names,
        ),
    ] = None,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Create the campaigns of a test: a bar of two spheres and a plate, at positions all over the volume.

    The volume is that of the calibration in use. Record the states as those of any campaign, then submit
    reconstruct and system-test. An artefact needs its uncertainties: half of expanded ones with k = 2.

    Example: sms calibration test plan hall-3 --name check --bar 480,25 --bar-sigma 0.005,0.002
    --bar-form-sigma 0.001; sms job submit reconstruct system-test -c check-bar --wait
    """
    _of_an_artefact("--bar", bar, {"--bar-sigma": bar_sigma, "--bar-form-sigma": bar_form_sigma})
    _of_an_artefact("--plate", plate, {"--plate-form-sigma": plate_form_sigma})
    of_bar = None
    if bar is not None:
        length, radius = _two(bar, "--bar", "480,25")
        sigmas = _two(_stated(bar_sigma, "--bar-sigma", "--bar"), "--bar-sigma", "0.005,0.002")
        form = _stated(bar_form_sigma, "--bar-form-sigma", "--bar")
        of_bar = BarCertificate(length, sigmas[0], radius, sigmas[1], form)
    of_plate = None
    if plate is not None:
        size = _two(plate, "--plate", "300,200")
        of_plate = PlateCertificate(*size, _stated(plate_form_sigma, "--plate-form-sigma", "--plate"))
    with bootstrap.services(home) as services:
        made = system_tests.plan(services, rig, name, of_bar, of_plate, like)
    if as_json:
        output.print_json_list(made)
        return
    output.print_table(
        ["campaign", "state", "artefact", "stands", "middle X, Y, Z [mm]"],
        [
            (one.campaign, one.state, one.artefact, one.words, ", ".join(f"{v:.0f}" for v in one.middle_mm))
            for one in made
        ],
        empty="",
    )


@app.command()
def report(
    campaign: Annotated[
        list[str],
        typer.Argument(
            help="Campaigns of the test, of one rig.",
            autocompletion=completion.campaign_names,
        ),
    ],
    limit: Annotated[
        list[str],
        typer.Option(
            help="Largest error in mm that is allowed, as flatness=0.04; of probing-form, probing-size, "
            "sphere-distance, length, flatness. Several times."
        ),
    ],
    risk: Annotated[
        float, typer.Option(help="Largest probability that a decision is wrong, between 0 and 0.5.")
    ] = 0.05,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Page to write; JSON is beside it.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace files that exist.")] = False,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Judge the errors of a test against limits, and write the page that is signed.

    Decides by guarded acceptance: conform, not conform, or undecided at the stated risk. No conformity with a
    standard is claimed. Ends with 6 unless all of it is conform, and measured with the one calibration that
    holds and artefacts whose uncertainty is known.

    Example: sms calibration test report check-bar check-plate --limit sphere-distance=0.05
    --limit flatness=0.04 --risk 0.05 -o check.html
    """
    limits = _limits(limit)
    with bootstrap.services(home) as services:
        verdict = system_tests.judge(services, campaign, limits, risk)
        files = () if out is None else system_tests.write(services, verdict, out, force=force)
    if as_json:
        output.print_json(asdict(verdict) | {"files": [str(one) for one in files]})
    else:
        output.print_table(
            ["quantity", "limit [mm]", "largest error [mm]", "values", "missing", "probability", "decision"],
            [
                (
                    one.quantity,
                    one.limit_mm,
                    None if one.largest_mm is None else f"{one.largest_mm:.4f}",
                    one.values,
                    one.missing,
                    f"{one.least:.4f} .. {one.most:.4f}",
                    one.decision,
                )
                for one in (*verdict.judgements, verdict.whole)
            ],
            empty="",
        )
        for doubt in verdict.doubts:
            output.say(f"before it is signed: {doubt}")
        if files:
            output.say(f"wrote {' and '.join(map(str, files))}")
    if verdict.whole.decision != "conform" or verdict.doubts:
        raise typer.Exit(_FINDINGS)


def _of_an_artefact(artefact: str, given: str | None, certified: Mapping[str, str | float | None]) -> None:
    """Refuse what is certified of an artefact that the test does not have: it would count for nothing."""
    for option, value in certified.items():
        if given is None and value is not None:
            raise InvalidInput(f"{option} {value} belongs to {artefact}, which is not given; add {artefact}")


def _stated(sigma: _Sigma | None, option: str, artefact: str) -> _Sigma:
    """Return an uncertainty; refuse a certificate without: its value would count as exact."""
    if sigma is None:
        raise InvalidInput(
            f"{artefact} needs {option}, the standard uncertainty in mm that its certificate states: without "
            "it the artefact would count as exact; give half of an expanded uncertainty with k = 2"
        )
    return sigma


def _two(text: str, option: str, example: str) -> tuple[float, float]:
    parts = text.split(",")
    try:
        first, second = map(float, parts)
    except ValueError:
        raise InvalidInput(f"{option} takes two numbers in mm, as {example}, not '{text}'") from None
    return first, second


def _limits(given: Sequence[str]) -> dict[str, float]:
    found: dict[str, float] = {}
    for text in given:
        name, _, value = text.partition("=")
        try:
            limit = float(value)
        except ValueError:
            raise InvalidInput(f"a limit is a name and mm, as flatness=0.04, not '{text}'") from None
        if name in found:
            raise InvalidInput(f"{name} has two limits, {found[name]:g} and {limit:g} mm; give it one")
        found[name] = limit
    return found
