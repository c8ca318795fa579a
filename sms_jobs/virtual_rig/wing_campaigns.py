"""The thesis's tests of wing panels on the virtual rig (chapter 6)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from sms_jobs.records.campaign import LoadState, Specimen
from sms_jobs.records.measurement import FringeSequence
from sms_jobs.records.scene import (
    CameraResponse,
    Disbond,
    MidPointBending,
    Plane,
    ProjectorResponse,
    Rigid,
    Scene,
    Speckle,
    StiffenedPanel,
    StringerCrack,
    Stud,
    TieRod,
    UniaxialStrain,
    Vector,
)
from sms_jobs.records.sensors import Rig, Sensor
from sms_jobs.virtual_rig.campaigns import (
    HOLD,
    PIXELS,
    START,
    Lens,
    Made,
    Size,
    cube,
    made,
    placed,
    scanner,
)

_LENS = Lens(6.6, -0.08, 0.12, 2e-4, -3e-4)
_DISTANCE_MM = 2200.0
_PROJECTOR = ProjectorResponse(defocus_px=0.8, visibility=0.95)
_POSITIONS: tuple[tuple[Vector, Vector], ...] = (
    ((0.028, -0.012, 0.013), (192.0, -2.0, 5.5)),
    ((0.030, -0.020, 0.010), (2.0, -1.0, 4.0)),
    ((0.033, -0.029, 0.004), (-186.0, 1.5, 2.0)),
)
"""How the panel lies in the frame of the rig at each of its positions."""
_FOOT_MM = 5.0  # thickness of the stringer's foot

_PLAIN = StiffenedPanel(290.0, 290.0, 80.0, _FOOT_MM, 30.0, 8.0)

TABLE_5: tuple[tuple[float, float, float], ...] = (
    (524e3, 433e-6, 442e-6),
    (985e3, 809e-6, 830e-6),
    (1445e3, 1185e-6, 1221e-6),
    (1955e3, 1612e-6, 1663e-6),
    (-206e3, -170e-6, -171e-6),
    (-409e3, -335e-6, -342e-6),
    (-673e3, -548e-6, -561e-6),
    (-912e3, -740e-6, -759e-6),
    (-1135e3, -919e-6, -945e-6),
)
"""Load in N, and what strain gauges 1 and 2 of the thesis read along the load."""
GAUGES_MM = ((0.0, 60.0), (0.0, -60.0))
"""Where they are taken to be on the panel, along it and across."""


def _of_300_mm(size: Size) -> tuple[Sensor, ...]:
    """Return one scanner that sees 330 mm at its distance."""
    return scanner(PIXELS[size], _LENS, Lens(5.0, -0.05, 0.08, -4e-4, 2e-4), _DISTANCE_MM)


def _speckle(size: Size) -> Speckle:
    return Speckle(diameter_mm=6.0 * _DISTANCE_MM / (_LENS.focal * PIXELS[size]))


def wing_panel(name: str, size: Size) -> tuple[Made, ...]:
    """Return the rig and the campaigns of thesis section 6.2: a wing panel, seen from three positions.

    A panel of 660 x 175 mm in tension and compression. The scanner sees half of it and is moved along it by
    about 190 mm, turned a little each time; at every position the whole cycle of loads is measured. The
    campaigns are called `name`-1 to `name`-3.
    """
    loads_n, strains = (985e3, 1955e3, -1135e3), (808e-6, 1612e-6, -919e-6)
    states = [LoadState("S00", 0.0, 0.0, START)]
    for number, (load_n, strain) in enumerate(zip(loads_n, strains, strict=True), start=1):
        grips = Rigid((5e-5, -1e-4, 5e-5), (50.0 * strain, -25.0 * strain, 40.0 * strain))
        deformation = (UniaxialStrain(strain, 0.33), grips)
        states.append(
            LoadState(
                f"S{number:02d}", load_n, 660.0 * strain, START + number * HOLD, deformation=deformation
            )
        )
    return _seen_from_all_positions(name, size, tuple(states))


def cracked_wing_panel(name: str, size: Size) -> tuple[Made, ...]:
    """Return the rig and the campaigns of thesis section 6.2 whole: nine loads, and a crack that grows.

    The panel of `wing_panel`. Gauges at `GAUGES_MM` would read the strains of the thesis's Table 5, which
    differ across the panel; the stringer behind y = -50 mm has cracked from the right, by 15 mm more in every
    state, and the skin over the crack is strained by a third more and comes out.
    """
    states = [LoadState("S00", 0.0, 0.0, START)]
    half = 0.5 * (GAUGES_MM[0][1] - GAUGES_MM[1][1])
    for number, (load_n, first, second) in enumerate(TABLE_5, start=1):
        strain = 0.5 * (first + second)
        part = strain / 1.6e-3
        crack = StringerCrack(
            strain, 0.33, (first - second) / (2.0 * half * strain), tip_mm=235.0 - 15.0 * number,
            fade_mm=25.0, stringer_mm=-50.0, width_mm=30.0, relief=0.35, bulge_mm=0.4 * part,
        )  # fmt: skip
        grips = Rigid((8e-5 * part, -1.6e-4 * part, 8e-5 * part), (0.08 * part, -0.04 * part, 0.06 * part))
        time, travel = START + number * HOLD, 660.0 * strain
        states.append(LoadState(f"S{number:02d}", load_n, travel, time, deformation=(crack, grips)))
    return _seen_from_all_positions(name, size, tuple(states))


def _seen_from_all_positions(name: str, size: Size, states: tuple[LoadState, ...]) -> tuple[Made, ...]:
    """Return a campaign of a wing panel for each position of the rig."""
    specimen = Specimen("wing panel", "aluminium", "skin of a lower wing cover, loaded along x")
    found = []
    for number, (rotation_rad, translation_mm) in enumerate(_POSITIONS, start=1):
        scene = Scene(
            Rig("virtual-scanner", _of_300_mm(size)),
            Plane(660.0, 175.0),
            _speckle(size),
            placed(rotation_rad, translation_mm),
            CameraResponse(exposure=0.9),
            _PROJECTOR,
            seed=number,
        )
        found.append(made(f"{name}-{number}", cube(200.0), specimen, states, FringeSequence(), scene))
    return tuple(found)


def disbond_buckling(name: str, size: Size) -> Made:
    """Return the rig and the campaign of thesis section 6.3: a stiffened panel that buckles.

    A skin of 290 mm with a stringer of T profile, 5 mm of foot under a web of 30 mm, whose bond is open over
    200 mm. As the load grows the stringer lifts off the skin there, more on the side of positive y, and the
    skin bends out less.
    """
    return _buckled(
        name, size, _PLAIN, {530e3: (0.1, 0.1), 1028e3: (0.4, 0.2), 2012e3: (1.4, 0.5), 3008e3: (3.0, 1.0)}
    )


def buckling_panel(name: str, size: Size) -> Made:
    """Return the rig and the campaign of thesis section 6.3 whole: seven loads, bolts, sensors and a tie rod.

    The panel of `disbond_buckling`, with two pairs of bolts on the stringer's foot, four sensors on the skin,
    and a tie rod across, which hides part of it and casts its shadow on skin, foot and web. All that is added
    stands beyond the open bond.
    """
    bolts = tuple(Stud((x, y), _FOOT_MM, 6.0, 8.0) for x in (-128.0, -110.0) for y in (22.0, -22.0))
    sensors = tuple(Stud((-118.0, y), 0.0, 9.0, 6.0) for y in (100.0, 68.0, -68.0, -100.0))
    panel = replace(_PLAIN, studs=(*bolts, *sensors), rod=TieRod(118.0, 70.0, 6.0, 280.0))
    return _buckled(
        name, size, panel,
        {
            211e3: (0.02, 0.04), 530e3: (0.1, 0.1), 1028e3: (0.4, 0.2), 1570e3: (0.9, 0.35),
            2012e3: (1.4, 0.5), 2499e3: (2.2, 0.75), 3008e3: (3.0, 1.0),
        },
    )  # fmt: skip


def _buckled(
    name: str, size: Size, panel: StiffenedPanel, gap_and_bend_mm: Mapping[float, tuple[float, float]]
) -> Made:
    """Return the campaign of a stiffened panel; by load in N how far its bond opens and its skin bends."""
    states = [LoadState("S00", 0.0, 0.0, START)]
    for number, (load_n, (gap, bend)) in enumerate(gap_and_bend_mm.items(), start=1):
        strain = -9e-4 * load_n / 3008e3
        deformation = (
            Disbond(gap, 200.0, tilt_per_mm=0.008, level_mm=_FOOT_MM),
            UniaxialStrain(strain, 0.3),
            MidPointBending(bend, 600.0, 600.0),
            Rigid((1e-4 * bend, -2e-4 * bend, 1e-4 * bend), (0.3 * bend, -0.1 * bend, 0.2 * bend)),
        )
        time = START + number * HOLD
        states.append(LoadState(f"S{number:02d}", load_n, 290.0 * strain, time, deformation=deformation))
    scene = Scene(
        Rig("virtual-scanner", _of_300_mm(size)),
        panel,
        _speckle(size),
        placed((0.03, -0.02, 0.01), (2.0, -1.0, -10.0)),
        CameraResponse(exposure=0.9),
        _PROJECTOR,
    )
    specimen = Specimen("stiffened panel", "CFRP", "skin with a stringer that has come off in the middle")
    return made(name, cube(200.0), specimen, tuple(states), FringeSequence(), scene)
