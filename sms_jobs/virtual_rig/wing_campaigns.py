"""The thesis's tests of wing panels on the virtual rig (chapter 6)."""

from __future__ import annotations

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
        found.append(made(f"{name}-{number}", cube(200.0), specimen, tuple(states), FringeSequence(), scene))
    return tuple(found)


def disbond_buckling(name: str, size: Size) -> Made:
    """Return the rig and the campaign of thesis section 6.3: a stiffened panel that buckles.

    A skin of 290 mm with a stringer of T profile, 5 mm of foot under a web of 30 mm, whose bond is open over
    200 mm. As the load grows the stringer lifts off the skin there, more on the side of positive y, and the
    skin bends out less.
    """
    loads_n = (530e3, 1028e3, 2012e3, 3008e3)
    gaps_mm, bends_mm = (0.1, 0.4, 1.4, 3.0), (0.1, 0.2, 0.5, 1.0)
    states = [LoadState("S00", 0.0, 0.0, START)]
    for number, (load_n, gap, bend) in enumerate(zip(loads_n, gaps_mm, bends_mm, strict=True), start=1):
        strain = -9e-4 * load_n / loads_n[-1]
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
        StiffenedPanel(290.0, 290.0, 80.0, _FOOT_MM, 30.0, 8.0),
        _speckle(size),
        placed((0.03, -0.02, 0.01), (2.0, -1.0, -10.0)),
        CameraResponse(exposure=0.9),
        _PROJECTOR,
    )
    specimen = Specimen("stiffened panel", "CFRP", "skin with a stringer that has come off in the middle")
    return made(name, cube(200.0), specimen, tuple(states), FringeSequence(), scene)
