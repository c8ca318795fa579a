"""The tables of a report, in the units that people expect: strain in microstrain, fractions in per cent."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime
from html import escape

from sms_jobs.formats.report.html import Cell, Given, Markup, facts, table
from sms_jobs.records.assessment import Assessment, Errors
from sms_jobs.records.campaign import Campaign, LoadState

MICROSTRAIN = 1e6
PER_CENT = 100.0


def local_time(time: datetime | None) -> str | None:
    """Write a time as the clock on this wall showed it, with its zone."""
    return None if time is None else time.astimezone().strftime("%Y-%m-%d %H:%M:%S %Z")


def campaign_facts(campaign: Campaign) -> Markup:
    """Say what was tested, with what and how."""
    sequence = campaign.sequence
    fringes = [
        ("patterns of the projector", sequence.in_words),
        ("fringe orientations [rad]", ", ".join(f"{angle:.4g}" for angle in sequence.orientations_rad)),
    ]
    return facts(
        [
            ("specimen", campaign.specimen.name),
            ("material", campaign.specimen.material),
            ("description", campaign.specimen.description),
            ("rig", campaign.rig + (" (virtual)" if campaign.scene is not None else "")),
            ("views of camera and projector", ", ".join(campaign.fringe_views)),
            ("views of several cameras", ", ".join(campaign.camera_views)),
            ("views of several cameras by fringes", ", ".join(campaign.stereo_fringe_views)),
            ("cameras alone", ", ".join(campaign.cameras_alone)),
            *(fringes if campaign.shows_fringes else ()),
            ("states", str(len(campaign.states))),
        ]
    )


def _given(value: float | None) -> Given | None:
    return None if value is None else Given(value)


def load_states(states: Sequence[LoadState], recorded: Mapping[str, datetime]) -> Markup:
    """List the load states by what is known of them.

    `recorded` says when those were measured whose definition does not.
    """
    channels = sorted({name for state in states for name in state.channels})
    columns: list[tuple[str, list[Cell]]] = [
        ("load [N]", [_given(state.known_load_n) for state in states]),
        *_planned("load [N]", [(s.measured_load_n, s.load_n) for s in states]),
        ("displacement [mm]", [_given(state.known_displacement_mm) for state in states]),
        *_planned("displacement [mm]", [(s.measured_displacement_mm, s.displacement_mm) for s in states]),
        ("time", [local_time(state.time or recorded.get(state.label)) for state in states]),
        *(_channel(states, name) for name in channels),
    ]
    labels: list[Cell] = [f"{states[0].label} (reference)", *(_link(state.label) for state in states[1:])]
    known = [(name, cells) for name, cells in columns if any(cell is not None for cell in cells)]
    rows = zip(labels, *(cells for _, cells in known), strict=True)
    return table(["state", *(name for name, _ in known)], [list(row) for row in rows])


def _link(label: str) -> Markup:
    """Lead to the maps of a deformed state."""
    return Markup(f'<a href="#state-{escape(label)}">{escape(label)}</a>')


def _planned(name: str, states: Sequence[tuple[float | None, float | None]]) -> list[tuple[str, list[Cell]]]:
    """Return a column of what was planned, where something else was measured."""
    if all(measured is None or planned is None for measured, planned in states):
        return []
    return [(f"planned {name}", [_given(planned) for _, planned in states])]


def _channel(states: Sequence[LoadState], name: str) -> tuple[str, list[Cell]]:
    return name, [_given(state.channels.get(name)) for state in states]


def _error_cells(errors: Errors | None, scale: float) -> list[Cell]:
    if errors is None:
        return [None] * 4
    return [errors.rms * scale, errors.bias * scale, errors.score_rms, errors.valid_fraction * PER_CENT]


def accuracy(assessments: Mapping[tuple[str, str], Assessment], diagonal_mm: float) -> list[Markup]:
    """List the errors of every (state, view), for shape, displacement and strain.

    The rms of shape and displacement is also given as a part of the volume's diagonal, as is usual in the
    field.
    """
    header = ["state", "view", "rms [mm]", "bias [mm]", "error / predicted", "valid [%]", "diagonal / rms"]
    tables = []
    for name in ("shape", "displacement"):
        rows: list[list[Cell]] = []
        for (state, view), assessment in assessments.items():
            errors: Errors | None = getattr(assessment, name)
            if errors is not None:
                part = diagonal_mm / errors.rms if errors.rms > 0.0 else None
                rows.append([state, view, *_error_cells(errors, 1.0), part])
        if rows:
            tables += [Markup(f"<h3>{name.capitalize()}</h3>"), table(header, rows)]
    strains: list[list[Cell]] = [
        [state, view, *_error_cells(a.strain, MICROSTRAIN)]
        for (state, view), a in assessments.items()
        if a.strain is not None
    ]
    if strains:
        header = ["state", "view", "rms [µε]", "bias [µε]", "error / predicted", "valid [%]"]
        tables += [Markup("<h3>Strain</h3>"), table(header, strains)]
    return tables
