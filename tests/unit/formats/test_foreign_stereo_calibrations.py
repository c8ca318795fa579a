"""Calibrations of other stereo-correlation programs: DICe, VIC-3D, MatchID, with a truth computed here."""

from __future__ import annotations

import csv
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sms_jobs.errors import ConfigurationError, InvalidInput
from sms_jobs.formats.interchange.calibration_files import read_calibration
from sms_jobs.formats.interchange.calibration_formats import all_formats
from sms_jobs.metrology.calibration.pair_points import meet_rays
from sms_jobs.metrology.geometry.camera import project
from sms_jobs.records.sensors import Sensor
from sms_jobs.records.supplements import Supplement

Floats = NDArray[np.float64]

SHARED = Path(__file__).resolve().parents[4] / "shared" / "data"
GIVEN = Supplement(rig="desk", valid_from=datetime(2026, 5, 4, tzinfo=UTC))
SIZED = replace(GIVEN, sizes={"C1": (1920, 1200), "C2": (1920, 1200)})

INNER = (
    {
        "fx": 6600.0,
        "fy": 6610.0,
        "cx": 950.0,
        "cy": 640.0,
        "fs": 0.4,
        "k": (0.02, 0.9, -20.0),
        "p": (2e-4, -3e-4),
    },
    {
        "fx": 6550.0,
        "fy": 6555.0,
        "cx": 970.0,
        "cy": 610.0,
        "fs": -0.7,
        "k": (-0.01, 1.1, -30.0),
        "p": (1e-4, 4e-4),
    },
)
ANGLES = (0.13, -19.1, 0.28)
"""In degrees about the fixed axes x, y, z: of the way from the first camera to the second."""
WAY = np.array([122.2, 1.8, 17.6])
POINTS = np.array([(x, y, z) for x in (-30.0, 5.0, 35.0) for y in (-20.0, 15.0) for z in (370.0, 395.0)])
"""In the first camera's frame, in mm."""


def turn(angles: tuple[float, ...]) -> Floats:
    return np.asarray(Rotation.from_euler("xyz", angles, degrees=True).as_matrix())


def seen(camera: int, inside: Floats, *, skew: bool = True, tangential: bool = True) -> Floats:
    """Return the pixels of points (n, 3) in a camera's frame: the other programs' equations, once more."""
    inner = INNER[camera]
    x, y = inside[:, 0] / inside[:, 2], inside[:, 1] / inside[:, 2]
    radius = np.hypot(x, y)
    factor = 1.0 + sum(k * radius**power for k, power in zip(inner["k"], (2, 4, 6), strict=True))
    p1, p2 = inner["p"] if tangential else (0.0, 0.0)
    u = x * factor + 2.0 * p1 * x * y + p2 * (radius**2 + 2.0 * x**2)
    v = y * factor + p1 * (radius**2 + 2.0 * y**2) + 2.0 * p2 * x * y
    fs = inner["fs"] if skew else 0.0
    return np.stack([inner["fx"] * u + fs * v + inner["cx"], inner["fy"] * v + inner["cy"]], axis=1)


def parameter(name: str, value: object, kind: str = "double") -> str:
    return f'<Parameter name="{name}" type="{kind}" value="{value}" />'


def dice_camera(number: int, model: str, outer: str, **more: float) -> str:
    inner = INNER[number]
    values = {key.upper(): inner[key] for key in ("cx", "cy", "fx", "fy")}
    values |= dict(zip(("K1", "K2", "K3"), inner["k"], strict=True)) | more
    lines = [parameter(name, f"{value:.12e}") for name, value in values.items()]
    return "\n".join(
        [
            f'<ParameterList name="CAMERA {number}">',
            *lines,
            parameter("LENS_DISTORTION_MODEL", model, "string"),
            parameter("IMAGE_HEIGHT_WIDTH", "{ 1200, 1920 }", "string"),
            outer,
            "</ParameterList>",
        ]
    )


def translated(way: Floats) -> str:
    return "".join(parameter(name, repr(float(t))) for name, t in zip(("TX", "TY", "TZ"), way, strict=True))


def matrix_rows(rotation: Floats) -> str:
    rows = [
        parameter(f"ROW {k}", "{ " + ", ".join(f"{x:.12e}" for x in row) + " }", "string")
        for k, row in enumerate(rotation)
    ]
    return '<ParameterList name="rotation_3x3_matrix">' + "".join(rows) + "</ParameterList>"


def dice(*cameras: str, relative: bool = True) -> str:
    head = parameter("xml_file_format", "DICe_xml_camera_system_file", "string")
    way = parameter("extrinsics_relative_camera_to_camera", str(relative).lower(), "bool")
    return "\n".join(["<ParameterList>", "<!-- a comment -->", head, way, *cameras, "</ParameterList>"])


PAIR = (
    dice_camera(0, "OPENCV_LENS_DISTORTION", "", P1=INNER[0]["p"][0], P2=INNER[0]["p"][1]),
    dice_camera(
        1,
        "OPENCV_LENS_DISTORTION",
        translated(WAY) + matrix_rows(turn(ANGLES)),
        P1=INNER[1]["p"][0],
        P2=INNER[1]["p"][1],
    ),
)


def vic3d(
    poses: list[tuple[tuple[float, ...], Floats]], head: str = "<!DOCTYPE vpml>", tail: str = ""
) -> str:
    cameras = []
    for number, (inner, (angles, way)) in enumerate(zip(INNER, poses, strict=False)):
        own = [*(inner[k] for k in ("cx", "cy", "fx", "fy", "fs")), *inner["k"]]
        outer = [*angles, *way.tolist()]
        cameras.append(
            f'<camera id="{number}">{" ".join(f"{x:.9e}" for x in own)}'
            f"<orientation>{' '.join(f'{x:.9e}' for x in outer)}</orientation></camera>"
        )
    return (
        f'<?xml version="1.0" encoding="ISO-8859-1"?>\n{head}\n<project dir="C:/x">'
        f'<calibration lri="calibration">{"".join(cameras)}</calibration>{tail}</project>'
    )


def caldat(separator: str = ";", first: int = 0) -> str:
    lines = []
    for number, inner in enumerate(INNER, start=first):
        lines += [
            f"Cam{number}_{key.capitalize()} [pixels]{separator}{inner[key]!r}" for key in ("fx", "fy", "fs")
        ]
        lines += [f"Cam{number}_Kappa {k}{separator}{value!r}" for k, value in enumerate(inner["k"], start=1)]
        lines += [f"Cam{number}_P{k}{separator}{value!r}" for k, value in enumerate(inner["p"], start=1)]
        lines += [f"Cam{number}_{key.capitalize()} [pixels]{separator}{inner[key]!r}" for key in ("cx", "cy")]
    lines += [f"T{axis} [mm]{separator}{float(t)!r}" for axis, t in zip("xyz", WAY, strict=True)]
    return "\n".join(
        lines
        + [f"{name} [deg]{separator}{a!r}" for name, a in zip(("Theta", "Phi", "Psi"), ANGLES, strict=True)]
    )


def saved(folder: Path, text: str, name: str = "cal.xml") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def images(sensors: tuple[Sensor, ...], points: Floats) -> list[Floats]:
    return [project(s.intrinsics, s.pose, points) for s in sensors]


def test_every_format_is_found_by_what_it_declares() -> None:
    assert list(all_formats()) == ["DICe", "MatchID", "VIC-3D", "thesis"]


def test_a_pair_of_dice_projects_as_it_says(tmp_path: Path) -> None:
    found = read_calibration([saved(tmp_path, dice(*PAIR))], GIVEN)
    first, second = images(found.calibration.rig.sensors, POINTS)
    assert [(s.name, s.columns, s.rows) for s in found.calibration.rig.sensors] == [
        ("C1", 1920, 1200),
        ("C2", 1920, 1200),
    ]
    # Numbers with 13 digits, times 1e4 px.
    np.testing.assert_allclose(first, seen(0, POINTS, skew=False), atol=1e-7)
    np.testing.assert_allclose(second, seen(1, POINTS @ turn(ANGLES).T + WAY, skew=False), atol=1e-7)


def test_cameras_of_dice_in_a_world_stand_there(tmp_path: Path) -> None:
    outer, own = (170.0, 20.0, -5.0), np.array([10.0, -20.0, 800.0])
    angles = "".join(parameter(n, repr(a)) for n, a in zip(("ALPHA", "BETA", "GAMMA"), outer, strict=True))
    both, way = turn(ANGLES) @ turn(outer), turn(ANGLES) @ own + WAY
    cameras = (
        dice_camera(0, "K1R3_K2R5_K3R7", translated(own) + angles),
        dice_camera(1, "VIC3D_LENS_DISTORTION", translated(way) + matrix_rows(both), FS=INNER[1]["fs"]),
    )
    found = read_calibration([saved(tmp_path, dice(*cameras, relative=False))], GIVEN).calibration
    points = (POINTS - own) @ turn(outer)  # what lies in front of the first camera, in the world
    first, second = images(found.rig.sensors, points)
    np.testing.assert_allclose(first, seen(0, POINTS, skew=False, tangential=False), atol=1e-7)
    np.testing.assert_allclose(second, seen(1, POINTS @ turn(ANGLES).T + WAY, tangential=False), atol=1e-7)
    # The same by the way from the first to the second.
    relative = (cameras[0], dice_camera(1, "VIC3D_DIS", translated(WAY) + matrix_rows(turn(ANGLES)), FS=-0.7))
    again = read_calibration([saved(tmp_path, dice(*relative))], GIVEN).calibration
    np.testing.assert_allclose(images(again.rig.sensors, points)[1], second, atol=1e-7)


def test_a_project_of_vic_3d_projects_as_it_says(tmp_path: Path) -> None:
    outer, own = (179.9, 9.4, -0.06), np.array([-58.2, 0.16, 20.2])
    angles = Rotation.from_matrix(turn(ANGLES) @ turn(outer)).as_euler("xyz", degrees=True)
    poses = [(outer, own), (tuple(angles), turn(ANGLES) @ own + WAY)]
    mask = '<projectaois><polygonmask width="1920" height="1200"/></projectaois>'
    found = read_calibration([saved(tmp_path, vic3d(poses, tail=mask))], GIVEN)
    points = (POINTS - own) @ turn(outer)
    first, second = images(found.calibration.rig.sensors, points)
    # Numbers with ten digits: angles of 180 deg to 1e-7 deg are 1e-5 px.
    np.testing.assert_allclose(first, seen(0, POINTS, tangential=False), atol=3e-5)
    np.testing.assert_allclose(second, seen(1, POINTS @ turn(ANGLES).T + WAY, tangential=False), atol=3e-5)
    assert found.remarks[0] == "image size of all cameras from the area of interest: 1920 x 1200 px"
    low, high = found.calibration.volume.low, found.calibration.volume.high
    assert np.all((points > low) & (points < high))
    with pytest.raises(InvalidInput, match="image size of C1, C2: add `size` C1=COLUMNSxROWS C2=COL"):
        read_calibration([saved(tmp_path, vic3d(poses))], GIVEN)


@pytest.mark.parametrize(("separator", "first"), [(";", 0), ("; ", 1), (": ", 0)])
def test_a_calibration_of_matchid_projects_as_it_says(separator: str, first: int, tmp_path: Path) -> None:
    path = saved(tmp_path, caldat(separator, first), "cal.caldat")
    found = read_calibration([path], SIZED).calibration
    here, there = images(found.rig.sensors, POINTS)
    # All digits are there: roundings at 1e3 px.
    np.testing.assert_allclose(here, seen(0, POINTS), atol=1e-9)
    np.testing.assert_allclose(there, seen(1, POINTS @ turn(ANGLES).T + WAY), atol=1e-9)
    with pytest.raises(InvalidInput, match="is in millimetres"):
        read_calibration([path], replace(SIZED, millimetres_per_unit=1000.0))


def test_the_volume_is_what_the_cameras_see_together(tmp_path: Path) -> None:
    found = read_calibration([saved(tmp_path, dice(*PAIR))], GIVEN)
    volume = found.calibration.volume
    # At 390 mm an image of 1920 x 1200 px is 113 x 71 mm: half its diagonal is 67 mm. Both look at one place
    # there, and what both see is narrower than what one sees.
    assert 300.0 < volume.low[2] < 340.0
    assert 420.0 < volume.high[2] < 480.0
    assert 40.0 < volume.high[0] < 67.0
    assert 30.0 < volume.high[1] < 50.0
    assert found.remarks[-1].startswith("the volume is what the cameras see together, from ")
    parallel = (PAIR[0], dice_camera(1, "NONE", translated(WAY)))
    with pytest.raises(InvalidInput, match="its cameras do not look at one place: add the volume"):
        read_calibration([saved(tmp_path, dice(*parallel))], GIVEN)


def test_what_a_model_of_dice_does_not_use_is_told(tmp_path: Path) -> None:
    cameras = (dice_camera(0, "NONE", "", K4=0.0), PAIR[1])
    found = read_calibration([saved(tmp_path, dice(*cameras))], GIVEN)
    assert not found.calibration.rig.sensors[0].intrinsics.distortion().any()
    assert "since NONE does not use it: K1, K2, K3" in found.remarks[0]


UPSIDE_DOWN = PAIR[1].replace("ROW 0", "ROW 9")
REFUSALS = {
    "two odd models": (
        dice(PAIR[0], dice_camera(1, "K1R1_K2R2_K3R3", "")),
        "is 'K1R1_K2R2_K3R3', but the camera",
    ),
    "prism": (dice(PAIR[0], dice_camera(1, "OPENCV_DIS", "", S1=0.1)), "9 of CAMERA 1 of"),
    "tilted": (dice(PAIR[0], dice_camera(1, "OPENCV_DIS", "", T1=0.1)), "tau_x, is 0.1"),
    "one camera": (dice(PAIR[0]), "a camera system has two cameras or more"),
    "no rotation": (
        dice(PAIR[0], dice_camera(1, "NONE", matrix_rows(1.1 * np.eye(3)))),
        "R R^T differs from 1 by 0.21, allowed is 1e-05",
    ),
    "half a matrix": (dice(PAIR[0], UPSIDE_DOWN), "ROW 0 of rotation_3x3_matrix is missing in CAMERA 1"),
    "both rotations": (
        dice(PAIR[0], dice_camera(1, "NONE", matrix_rows(np.eye(3)), ALPHA=1.0)),
        "has both rotation_3x3_matrix and ALPHA",
    ),
    "no number": (dice(*PAIR).replace("6.600000000000e+03", "wide"), "FX of CAMERA 0 of"),
    "beyond all numbers": (
        dice(*PAIR).replace("6.600000000000e+03", "1e999"),
        "is 1e999, which is beyond all",
    ),
    "a skew in degrees": (
        dice(PAIR[0], dice_camera(1, "VIC3D_DIS", "", FS=5000.0)),
        "is 5000 px, 0.76 of fx, allowed is 0.1",
    ),
    "another list": ("<ParameterList></ParameterList>", "but no camera system file of DICe"),
    "twice": (dice(PAIR[0], PAIR[0]), "'CAMERA 0' stands twice in one list"),
    "truncated": (dice(*PAIR)[:-200], "this is not well-formed XML"),
    "a bomb": (
        vic3d([], '<!DOCTYPE vpml [<!ENTITY a "aaaaaaaa"><!ENTITY b "&a;&a;&a;">]>'),
        "a document type declaration",
    ),
    "an outside file": (
        vic3d([], '<!DOCTYPE vpml SYSTEM "file:///etc/passwd">'),
        "a document type declaration",
    ),
    "one camera of VIC-3D": (vic3d([((0.0,) * 3, WAY)]), "has one camera; a calibration of VIC-3D has two"),
    "too few numbers": (
        vic3d([((0.0,) * 3, WAY)] * 2).replace("<orientation>0.000000000e+00", "<orientation>"),
        "<orientation> of camera 0 of",
    ),
    "another version": (
        vic3d([((0.0,) * 3, WAY)] * 2).replace("<orientation>", "<intrinsics/><orientation>"),
        "has <intrinsics>, as other versions of VIC-3D write it",
    ),
    "one camera of MatchID": (
        "\n".join(line for line in caldat().splitlines() if not line.startswith("Cam1")),
        "has the cameras 0; a calibration of MatchID has two",
    ),
    "no angle": (caldat().replace("Phi [deg]", "Chi"), "Phi is missing in"),
    "other units": (caldat().replace("[deg]", "[rad]"), "Theta should be in deg, not rad"),
    "metres": (caldat().replace("[mm]", "[m]"), "Tx should be in mm, not m"),
    "a comma": (caldat().replace("6600.0", "6600,0"), "should be a number, not '6600,0'"),
    "a focal length of next to nothing": (
        caldat().replace("6600.0", "1e-320"),
        "px, inf of fx, allowed is 0.1 of fx",
    ),
    "no focal length": (caldat().replace("Cam1_Fy", "Cam1_Fz"), "Fy of Cam1 of"),
    "a strange line": (caldat() + "\n<nothing>", "is no line with a name and a number"),
    "twice in MatchID": (caldat() + "\nTx [mm];1.0", "Tx is given twice in one file"),
}


@pytest.mark.parametrize("name", REFUSALS)
def test_a_wrong_file_is_refused_in_one_sentence(name: str, tmp_path: Path) -> None:
    text, said = REFUSALS[name]
    with pytest.raises(ConfigurationError) as refused:
        read_calibration([saved(tmp_path, text, "cal.any")], SIZED)
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


def published(path: str) -> Path:
    found = SHARED / path
    if not found.exists():
        pytest.skip(f"put the published images and calibrations into {SHARED} for this test")
    return found


def published_matches(path: Path) -> tuple[Floats, Floats]:
    """Return the pixels of both cameras, (n, 2) each, that DICe matched."""
    with path.open(encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if float(row["MATCH"]) == 0.0]
    here = np.array([[float(row["COORDINATE_X"]), float(row["COORDINATE_Y"])] for row in rows])
    return here, here + [[float(row["CROSS_CORR_Q"]), float(row["CROSS_CORR_R"])] for row in rows]


def test_published_matches_meet_by_a_calibration_of_vic_3d() -> None:
    folder = published("stereo/gt4")
    found = read_calibration([folder / "cal.xml"], GIVEN).calibration
    here, there = published_matches(folder / "gold" / "DICe_solution_0.txt")
    first, second = ((s.intrinsics, s.pose) for s in found.rig.sensors)
    points, gaps = meet_rays(first, second, here, there)[:2]
    # A gap of 1 mm at 380 mm is 17 px. DICe matched with subsets that neither turn nor shear, to 0.05 px, and
    # 0.13 px are common to all points: the cameras had moved since they were calibrated.
    gap_px = (
        np.abs(gaps) * found.rig.sensors[0].intrinsics.fx / np.linalg.norm(points - first[1].centre(), axis=1)
    )
    assert len(points) == 119
    assert np.median(gap_px) < 0.15
    assert np.sqrt(np.mean(gap_px**2)) < 0.17
    # The sheet is flat to 10 um; the distortion the wrong way makes 11 um of it, a transposed rotation 3 mm.
    flat = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[2] / np.sqrt(len(points))
    assert flat < 0.0105


def test_a_published_camera_system_of_dice_is_read() -> None:
    found = read_calibration([published("dic/stereo_sample3/cal.xml")], GIVEN).calibration
    first, second = found.rig.sensors
    assert (first.columns, second.rows, first.intrinsics.skew) == (1920, 1200, 0.0)
    np.testing.assert_array_equal(first.pose.centre(), np.zeros(3))
    # The second camera stands to the left of the first by 1.2e2 mm, and looks to the right.
    np.testing.assert_allclose(second.pose.centre(), [-122.4, -0.1, 17.3], atol=0.1)
