"""What light that is spread over the projector's image does to ranging, and what widths of returns tell."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sms_jobs.bench.fringes.spread_returns import CROSSED, DIAGONAL, FRINGES, Light, Plate, choice
from sms_jobs.bench.study import Cell, Outcome, Study, Table, new_figure
from sms_jobs.kinds.shape.phase_task import PhaseParameters

PIXELS = 96
NOISES = (50.0, 200.0)
TOO_WIDE = 4.0
"""Deviations from noise of a width beyond which a return would not be trusted."""

LIGHTS: dict[str, Callable[[Plate], list[Light]]] = {
    "direct": lambda plate: [plate.direct()],
    "direct, spread 1 px": lambda plate: [plate.direct(1.0, 1.0)],
    "direct, spread 3 px": lambda plate: [plate.direct(1.0, 3.0)],
    "and a mirror": lambda plate: [plate.direct(), plate.mirrored(0.5)],
    "and a mirror, brushed: 1 px": lambda plate: [plate.direct(), plate.mirrored(0.5, 1.0)],
    "and a mirror, brushed: 2 px": lambda plate: [plate.direct(), plate.mirrored(0.5, 2.0)],
    "and a mirror, brushed: 10 px": lambda plate: [plate.direct(), plate.mirrored(0.5, 10.0)],
    "and a bright mirror, brushed: 1 px": lambda plate: [plate.direct(), plate.mirrored(2.0, 1.0)],
    "and a diffuse wall": lambda plate: [plate.direct(), plate.scattered(0.8)],
    "none, a mirror, brushed: 3 px": lambda plate: [plate.mirrored(0.5, 3.0)],
    "none, a diffuse wall": lambda plate: [plate.scattered(0.8)],
}


def row(plate: Plate, lights: list[Light], signal_to_noise: float) -> list[Cell]:
    """Return the numbers of a plate in some light."""
    measurement = plate.frames(lights, signal_to_noise, 1)
    found = plate.measured(measurement, PhaseParameters(method="fdr", returns=2))
    chosen = choice(plate, measurement)
    valid, wrong = found.valid, found.wrong()
    with np.errstate(invalid="ignore"):
        narrow = ~(chosen.width > TOO_WIDE)
    parts = (chosen.wrong, chosen.wrong_by_width)
    return [
        float(valid.mean()),
        1e6 * float(wrong.mean()),
        found.scatter(),
        *(1e6 * float(part.mean()) for part in parts),
        float((valid & narrow).mean()),
        1e6 * float((wrong & narrow).mean()),
    ]


_COLUMNS = (
    "fringes",
    "B / sigma",
    "light",
    "valid",
    "wrong, 1e-6",
    "rms / sigma",
    "off: likelihood, 1e-6",
    "off: with width, 1e-6",
    "narrow: valid",
    "narrow: wrong, 1e-6",
)


def run(say: Callable[[str], None]) -> Outcome:
    """Range a plate in all lights."""
    rows: list[list[Cell]] = []
    for name, orientations in (("crossed", CROSSED), ("diagonal", DIAGONAL)):
        plate = Plate.seen(PIXELS, orientations)
        for noise in NOISES:
            say(f"{name}, B / sigma = {noise:g}")
            rows += [[name, noise, light, *row(plate, made(plate), noise)] for light, made in LIGHTS.items()]
    figure = new_figure(8.0, 4.0)
    axes = figure.subplots()
    for number, (label, column) in enumerate((("all that is valid", 4), ("narrow returns alone", 9))):
        wrong = [max(float(one[column] or 0.0), 50.0) for one in rows]
        axes.semilogy(wrong, "ox"[number], label=label)
    axes.set_xlabel("row of the table")
    axes.set_ylabel("wrong points of a million (50: none)")
    axes.legend()
    remarks = {
        "conditions": f"a plate in the rig of thesis section 7.3.1, {PIXELS} x {PIXELS} points of which 88 % "
        f"lie in the volume, s = {FRINGES}, exact signals with B / sigma of the direct light, two returns, "
        "default parameters; spreads are standard deviations in px of the projector, along both axes; "
        "mirrors of 0.5 and 2 times the direct light, 120 degrees from the plate; a wall of albedo 0.8 in "
        "the mirror's place",
        "wrong": "valid and off by more than six deviations and 0.1 mm along the ray",
        "off": "the pair that is likeliest, whether valid or not, is more than 2 mm off the plate; with "
        "width: the chi-square of its returns' widths besides",
        "narrow": f"valid, and no return of the pair is wider by more than {TOO_WIDE:g} deviations",
        "thesis": "section 8.2: strength and width of the peaks might help to select the optimum signal",
    }
    return Outcome(Table(_COLUMNS, rows, remarks), figure)


STUDY = Study(
    "spread-returns", "light that is spread over the projector, and what widths of returns tell", run
)
