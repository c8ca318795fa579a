"""Calibrations go out and come back bit for bit; OpenCV reads them; other programs' files are understood."""

from __future__ import annotations

import re
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
import pytest

from sms_jobs.errors import ConfigurationError, InvalidInput, OtherFormat, SmsError
from sms_jobs.formats.interchange.calibration_files import (
    calibration_text,
    read_calibration,
)
from sms_jobs.formats.interchange.styles import Style
from sms_jobs.metrology.geometry.camera import Pose, project, ray_directions
from sms_jobs.metrology.geometry.lens import Intrinsics
from sms_jobs.metrology.geometry.transforms import rotation_matrix
from sms_jobs.records.scene import AT_ORIGIN
from sms_jobs.records.sensors import Box, Calibration, Rig, Sensor
from sms_jobs.records.supplements import Supplement
from sms_jobs.records.views import Role

WRONG = Path(__file__).parent / "wrong_calibrations"
BOX = Box((-100.0, -80.0, 700.0), (100.0, 80.0, 1100.0))
SINCE = datetime(2026, 5, 4, 8, 0, 0, 123456, tzinfo=UTC)
GIVEN = Supplement(rig="desk", valid_from=SINCE, volume=BOX)
SUFFIX: dict[Style, str] = {
    "opencv-yaml": "yml",
    "opencv-xml": "xml",
    "opencv-json": "json",
    "thesis-xml": "xml",
}
OPENCV: list[Style] = ["opencv-yaml", "opencv-xml", "opencv-json"]


def pose(rng: np.random.Generator) -> Pose:
    """Return one from which `BOX` is seen."""
    return Pose.from_arrays(rotation_matrix(rng.normal(0.0, 0.1, 3)), rng.normal(0.0, 100.0, 3))


@pytest.fixture
def calibration(rng: np.random.Generator) -> Calibration:
    """Two cameras and a projector with every parameter in use."""
    sensors = tuple(
        Sensor(
            name,
            role,
            columns,
            rows,
            Intrinsics(2100.0 + rng.normal(), 2099.0 + rng.normal(), 640.1, 511.7, *rng.normal(0.0, 0.01, 6)),
            pose(rng),
        )
        for name, role, columns, rows in (
            ("C1", Role.CAMERA, 1280, 1024),
            ("C12", Role.CAMERA, 1280, 1024),
            ("P1", Role.PROJECTOR, 1920, 1080),
        )
    )
    return Calibration(Rig("hall-3", sensors), BOX, SINCE, 'by "hand": 20 °C, a\\b # {no} [list]')


def written(calibration: Calibration, style: Style, folder: Path) -> Path:
    path = folder / f"rig.{SUFFIX[style]}"
    path.write_text(calibration_text(calibration, style, 0.005)[0], encoding="utf-8")
    return path


@pytest.mark.parametrize("style", OPENCV)
def test_a_calibration_comes_back_bit_for_bit(style: Style, calibration: Calibration, tmp_path: Path) -> None:
    found = read_calibration([written(calibration, style, tmp_path)], Supplement())
    assert found.calibration == calibration
    assert found.remarks == ()


@pytest.mark.parametrize("style", OPENCV)
def test_programs_with_opencv_read_what_is_written(
    style: Style, calibration: Calibration, tmp_path: Path, rng: np.random.Generator
) -> None:
    storage = cv2.FileStorage(str(written(calibration, style, tmp_path)), cv2.FILE_STORAGE_READ)
    names = storage.getNode("sensors")
    assert [names.at(k).string() for k in range(names.size())] == ["C1", "C12", "P1"]
    assert storage.getNode("rig").string() == "hall-3"
    points = rng.uniform(BOX.low, BOX.high, (20, 3))
    for sensor in calibration.rig.sensors:
        node = storage.getNode(sensor.name)
        assert node.getNode("image_width").real() == sensor.columns
        assert node.getNode("image_height").real() == sensor.rows
        turned = cv2.Rodrigues(node.getNode("R").mat())[0]
        seen, _ = cv2.projectPoints(
            points,
            turned,
            node.getNode("T").mat(),
            node.getNode("camera_matrix").mat(),
            node.getNode("distortion_coefficients").mat(),
        )
        k, lens = node.getNode("camera_matrix").mat(), sensor.intrinsics
        assert k[0, 1] == lens.fx * lens.skew
        # OpenCV's own functions leave the skew out: K has it for those who multiply by K.
        ours = project(replace(lens, skew=0.0), sensor.pose, points)
        ahead = np.isfinite(ours[:, 0])
        # Frames and pixel centres are the same, so only the roundings of Rodrigues' formula remain.
        np.testing.assert_allclose(seen[ahead, 0], ours[ahead], rtol=1e-9, atol=1e-7)
    storage.release()


def test_the_thesiss_parameters_come_back_to_the_misfit(
    calibration: Calibration, tmp_path: Path, rng: np.random.Generator
) -> None:
    # Without tangential terms and skew, which the thesis does not have.
    sensors = tuple(
        replace(s, intrinsics=replace(s.intrinsics, p1=0.0, p2=0.0, skew=0.0))
        for s in calibration.rig.sensors
    )
    radial = replace(calibration, rig=Rig("hall-3", sensors))
    found = read_calibration([written(radial, "thesis-xml", tmp_path)], Supplement())
    assert (found.calibration.volume, found.calibration.valid_from) == (BOX, SINCE)
    assert found.calibration.origin == calibration.origin
    assert len(found.remarks) == 3
    for before, after, remark in zip(sensors, found.calibration.rig.sensors, found.remarks, strict=True):
        assert (after.name, after.role, after.columns, after.rows) == (
            before.name,
            before.role,
            before.columns,
            before.rows,
        )
        said = re.search(r"within (\S+) px", remark)
        assert said is not None
        pixels = rng.uniform(0.0, 1000.0, (100, 2))
        off = ray_directions(after.intrinsics, after.pose, pixels) - ray_directions(
            before.intrinsics, before.pose, pixels
        )
        # A pixel is an angle of 1 / fx. There and back cost the stated misfit each, of 2 digits; angles in
        # degrees and millimetres on the chip are rounded.
        assert np.abs(off).max() * before.intrinsics.fx < 2.2 * float(said[1]) + 1e-9
        np.testing.assert_allclose(after.pose.centre(), before.pose.centre(), rtol=1e-12, atol=1e-9)


def test_a_skew_is_told_where_programs_leave_it_out(calibration: Calibration) -> None:
    said = calibration_text(calibration, "opencv-yaml", 0.005)[1]
    assert said == ("C1, C12, P1: OpenCV's own functions leave the skew in camera_matrix out",)
    first, *_ = calibration.rig.sensors
    straight = replace(first, intrinsics=replace(first.intrinsics, skew=0.0))
    alone = replace(calibration, rig=Rig("hall-3", (straight,)))
    assert calibration_text(alone, "opencv-yaml", 0.005)[1] == ()


def test_the_skew_of_a_camera_matrix_is_taken(tmp_path: Path) -> None:
    matrix = [[1750.0, 0.7, 640.0], [0.0, 1751.0, 512.0], [0.0, 0.0, 1.0]]
    values = {
        "image_width": 1280,
        "image_height": 1024,
        "camera_matrix": matrix,
        "distortion_coefficients": D1,
    }
    (camera,) = read_calibration([saved(tmp_path / "left.yml", values)], GIVEN).calibration.rig.sensors
    lens = camera.intrinsics
    assert lens.skew == 0.7 / 1750.0
    text = calibration_text(one_camera(lens), "opencv-json", 0.005)[0]
    own = tmp_path / "own.json"
    own.write_text(re.sub(r'("skew": )[^\s,]+', r"\g<1>5.0e-04", text), encoding="utf-8")
    with pytest.raises(ConfigurationError, match=r"C1 in .* says two skews: 0.0005 of fx, and 0.0004 of fx"):
        read_calibration([own], Supplement())


def one_camera(lens: Intrinsics) -> Calibration:
    return Calibration(
        Rig("desk", (Sensor("C1", Role.CAMERA, 1280, 1024, lens, AT_ORIGIN),)), BOX, SINCE, "by hand"
    )


def test_tangential_distortion_is_not_lost_in_silence(calibration: Calibration) -> None:
    first, *others = calibration.rig.sensors
    bent = replace(first, intrinsics=replace(first.intrinsics, p1=0.01))
    with pytest.raises(
        ConfigurationError, match=r"distortion of C1 .* cannot be carried over: .* allowed are 1 px"
    ):
        calibration_text(replace(calibration, rig=Rig("hall-3", (bent, *others))), "thesis-xml", 0.005)


def test_the_printed_pixel_pitch_can_be_said(calibration: Calibration, tmp_path: Path) -> None:
    sensor = replace(calibration.rig.sensors[0], intrinsics=Intrinsics(2000.0, 2000.0, 640.0, 500.0))
    path = written(replace(calibration, rig=Rig("hall-3", (sensor,))), "thesis-xml", tmp_path)
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace(">L/N<", ">L/(N-1)<"), encoding="utf-8")
    again = read_calibration([path], Supplement()).calibration.rig.sensors[0].intrinsics
    # 1279 instead of 1280 pitches to the same width, counted from the first pixel's centre; rounding.
    assert again.fx == pytest.approx(2000.0 * 1279 / 1280, rel=1e-13)
    assert again.cx == pytest.approx((640.0 + 0.5) * 1279 / 1280, rel=1e-13)


K1, D1 = [[1750.0, 0, 640.0], [0, 1751.0, 512.0], [0, 0, 1]], [-0.07, 0.1, 1e-4, -2e-4, 0.05]
K2, D2 = [[2500.0, 0, 990.0], [0, 2501.0, 547.0], [0, 0, 1]], [-0.04, 0.2, 0.0, 0.0]
R, T = rotation_matrix(np.array([0.01, 0.3, -0.02])), np.array([-110.0, -5.0, -15.0])

VIEWS = {
    "stereo_calib": ("M1 D1 M2 D2 R T", ["C1", "C2"]),
    "SLMaster": ("M1 D1 M4 D4 Rlp Tlp", ["C1", "P1"]),
    "SLStudio": ("Kc kc Kp kp Rp Tp", ["C1", "P1"]),
    "Moreno and Taubin": ("cam_K cam_kc proj_K proj_kc R T", ["C1", "P1"]),
    "procam": ("cam_int cam_dist proj_int proj_dist roration translation", ["C1", "P1"]),
    "numbered": ("camera_matrix_1 dist_coeffs_1 camera_matrix_2 dist_coeffs_2 R T", ["C1", "C2"]),
    "camel": ("cameraMatrix1 distCoeffs1 cameraMatrix2 distCoeffs2 R T", ["C1", "C2"]),
    "short": ("K1 D1 K2 D2 R T", ["C1", "C2"]),
    "mixed": ("M1 dist1 M2 dist2 R T", ["C1", "C2"]),
    "from nought": ("K_0 D_0 K_1 D_1 R T", ["C1", "C2"]),
    "sides": ("cameraMatrixL distCoeffsL cameraMatrixR distCoeffsR R T", ["C1", "C2"]),
}


def saved(path: Path, values: dict[str, object]) -> Path:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in values.items():
        storage.write(name, np.array(value) if isinstance(value, list) else value)
    storage.release()
    return path


def first_five(lens: Intrinsics) -> list[float]:
    """Return the coefficients that OpenCV writes first."""
    return [lens.k1, lens.k2, lens.p1, lens.p2, lens.k3]


@pytest.mark.parametrize("suffix", ["yml", "xml", "json"])
@pytest.mark.parametrize("program", VIEWS)
def test_a_pair_of_another_program_is_understood(program: str, suffix: str, tmp_path: Path) -> None:
    keys, names = VIEWS[program]
    path = saved(tmp_path / f"view.{suffix}", dict(zip(keys.split(), [K1, D1, K2, D2, R, T], strict=True)))
    sizes = {names[0]: (1280, 1024), names[1]: (1920, 1080)}
    found = read_calibration([path], replace(GIVEN, sizes=sizes)).calibration
    first, second = found.rig.sensors
    assert [first.name, second.name] == names
    assert (first.columns, second.rows) == (1280, 1080)
    np.testing.assert_array_equal(first.intrinsics.matrix(), K1)
    np.testing.assert_array_equal(first_five(first.intrinsics), D1)
    np.testing.assert_array_equal(first_five(second.intrinsics), [*D2, 0.0])
    np.testing.assert_array_equal(first.pose.matrix(), np.eye(3))
    # The second sensor sees X at R X + T, as cv2.stereoCalibrate defines it.
    np.testing.assert_array_equal(second.pose.matrix(), R)
    np.testing.assert_array_equal(second.pose.translation, T)
    assert found.origin.startswith(f"imported from view.{suffix}, sha256 ")


RATIONAL = [0.9, 0.1, 2e-4, -3e-4, 0.003, 1.2, 0.28, 0.015]
FISHEYE = [0.03, -0.01, 0.004, -0.001]


def test_opencvs_rational_lens_is_read(tmp_path: Path) -> None:
    path = saved(tmp_path / "wide.yml", {"M1": K1, "D1": RATIONAL, "M2": K2, "D2": D2, "R": R, "T": T})
    found = read_calibration([path], replace(GIVEN, sizes={"C1": (1280, 1024), "C2": (1920, 1080)}))
    first, second = (s.intrinsics for s in found.calibration.rig.sensors)
    assert (first.model, second.model) == ("rational", "plain")
    assert [getattr(first, name) for name in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")] == RATIONAL


@pytest.mark.parametrize(
    "said", [{"fisheye_model": 1}, {"distortion_model": "equidistant"}, {"camera_model": "fisheye"}]
)
def test_opencvs_fisheye_is_read(said: dict[str, object], tmp_path: Path) -> None:
    pair = {"M1": K1, "D1": FISHEYE, "M2": K2, "D2": FISHEYE, "R": R, "T": T}
    path = saved(tmp_path / "wide.yml", {**said, **pair})
    found = read_calibration([path], replace(GIVEN, sizes={"C1": (1280, 1024), "C2": (1920, 1080)}))
    lens = found.calibration.rig.sensors[0].intrinsics
    assert lens.model == "fisheye"
    assert [lens.k1, lens.k2, lens.k3, lens.k4] == FISHEYE
    apart = float(np.linalg.norm(T))
    (remark,) = found.remarks
    assert remark == (
        f"{path} says no unit of length: taken for mm, C1 and C2 are {apart:.4g} mm apart; `unit_mm` gives "
        "another"
    )


def test_a_rotation_vector_of_more_than_half_a_turn_is_refused(tmp_path: Path) -> None:
    vector = cv2.Rodrigues(R)[0]
    pair = {"M1": K1, "D1": D1, "M2": K2, "D2": D2, "T": T}
    given = replace(GIVEN, sizes={"C1": (1280, 1024), "C2": (1920, 1080)})
    found = read_calibration([saved(tmp_path / "rad.yml", {**pair, "R": vector})], given)
    np.testing.assert_allclose(found.calibration.rig.sensors[1].pose.matrix(), R, atol=1e-12)
    with pytest.raises(ConfigurationError, match="more than half a turn: is it in degrees"):
        read_calibration([saved(tmp_path / "deg.yml", {**pair, "R": np.degrees(vector)})], given)


@pytest.mark.parametrize("style", OPENCV)
def test_wide_lenses_come_back_bit_for_bit(style: Style, calibration: Calibration, tmp_path: Path) -> None:
    first, second, third = calibration.rig.sensors
    names = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    rational = Intrinsics(900.0, 901.0, 640.0, 500.0, **dict(zip(names, RATIONAL, strict=True)))
    bent = dict(zip(("k1", "k2", "k3", "k4"), FISHEYE, strict=True))
    fisheye = Intrinsics(900.0, 901.0, 640.0, 500.0, **bent, fisheye=1.0)
    sensors = (replace(first, intrinsics=rational), replace(second, intrinsics=fisheye), third)
    wide = replace(calibration, rig=Rig("hall-3", sensors))
    path = written(wide, style, tmp_path)
    assert read_calibration([path], Supplement()).calibration == wide
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    coefficients = [storage.getNode(s.name).getNode("distortion_coefficients").mat() for s in sensors]
    assert [c.size for c in coefficients] == [8, 4, 5]
    points = np.array([[100.0, -50.0, 200.0], [-300.0, 100.0, 400.0]])
    seen, _ = cv2.fisheye.projectPoints(
        points[None], np.zeros(3), np.zeros(3), fisheye.matrix(), coefficients[1].ravel()
    )
    upright = Pose.from_arrays(np.eye(3), np.zeros(3))
    # One formula twice, of pixels up to 1e3.
    np.testing.assert_allclose(seen[0], project(fisheye, upright, points), rtol=0.0, atol=1e-9)
    storage.release()


def test_two_files_complete_each_other_and_units_are_converted(tmp_path: Path) -> None:
    inner = saved(tmp_path / "intrinsics.yml", {"M1": K1, "D1": D1, "M2": K2, "D2": D2})
    outer = saved(tmp_path / "extrinsics.yml", {"R": R, "T": T / 1000.0, "Q": np.eye(4)})
    given = replace(
        GIVEN,
        names=("C3", "P1"),
        sizes={"C3": (1280, 1024), "P1": (1920, 1080)},
        millimetres_per_unit=1000.0,
    )
    found = read_calibration([inner, outer], given)
    assert [s.name for s in found.calibration.rig.sensors] == ["C3", "P1"]
    assert found.calibration.rig.sensors[1].role is Role.PROJECTOR
    np.testing.assert_allclose(found.calibration.rig.sensors[1].pose.translation, T, rtol=1e-15)
    assert found.remarks == (f"not taken over from {inner}, {outer}: Q",)
    with pytest.raises(ConfigurationError, match="R is missing; if it is in a second file"):
        read_calibration([inner], given)
    with pytest.raises(ConfigurationError, match=r"repeats settings of another file: D1, D2, M1, M2"):
        read_calibration([inner, inner], given)


def test_a_camera_alone_stands_in_the_world_by_its_r_and_t(tmp_path: Path) -> None:
    values = {"image_width": 640, "image_height": 480, "camera_matrix": K1, "distortion_coefficients": D1}
    alone = read_calibration([saved(tmp_path / "left.yml", dict(values))], GIVEN).calibration.rig.sensors[0]
    assert (alone.name, alone.columns, alone.rows) == ("C1", 640, 480)
    np.testing.assert_array_equal(alone.pose.centre(), np.zeros(3))
    with pytest.raises(InvalidInput, match=r"left\.yml has no camera, but P1: nothing can be measured"):
        read_calibration([tmp_path / "left.yml"], replace(GIVEN, names=("P1",)))
    vector = cv2.Rodrigues(R)[0]
    placed = read_calibration([saved(tmp_path / "placed.yml", {**values, "R": vector, "T": T})], GIVEN)
    # Rodrigues there and back: a few roundings.
    np.testing.assert_allclose(placed.calibration.rig.sensors[0].pose.matrix(), R, atol=1e-14)


def test_a_rotation_of_few_digits_becomes_an_exact_one(tmp_path: Path) -> None:
    path = saved(
        tmp_path / "view.yml",
        dict(zip(["Kc", "kc", "Kp", "kp", "Rp", "Tp"], [K1, D1, K2, D2, R.round(6), T], strict=True)),
    )
    sizes = {"C1": (1280, 1024), "P1": (1920, 1080)}
    rotation = read_calibration([path], replace(GIVEN, sizes=sizes)).calibration.rig.sensors[1].pose.matrix()
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-15 * 4)  # rounding
    np.testing.assert_allclose(rotation, R, atol=1e-6)  # half a digit, and what that turns the others by


def test_higher_coefficients_are_taken_only_where_they_are_zero(tmp_path: Path) -> None:
    values = {"image_width": 640, "image_height": 480, "camera_matrix": K1}
    zeros = saved(tmp_path / "zeros.yml", {**values, "distortion_coefficients": [*D1, 0.0, 0.0, 0.0]})
    found = read_calibration([zeros], GIVEN).calibration.rig.sensors[0]
    np.testing.assert_array_equal(first_five(found.intrinsics), D1)


@pytest.mark.parametrize(
    ("matrix", "size", "said"),
    [
        (K1, (1280, 1024), None),
        (K1, (640, 512), "lies 50% of a side from the middle of an image of 640 x 512 px"),
        (K1, (1024, 1280), "px lies 1"),
        (np.divide(K1, [[100.0], [100.0], [1.0]]), (1280, 1024), "are its numbers not in pixels?"),
        (np.multiply(K1, [[1.0], [0.5], [1.0]]), (1280, 512), "are those of pixels that are no squares"),
    ],
    ids=["as it is", "binned", "sides exchanged", "millimetres", "lines left out"],
)
def test_a_camera_of_other_images_is_remarked(
    matrix: object, size: tuple[int, int], said: str | None, tmp_path: Path
) -> None:
    values = {"image_width": size[0], "image_height": size[1], "camera_matrix": np.array(matrix)}
    path = saved(tmp_path / "left.yml", {**values, "distortion_coefficients": [0.0] * 5})
    remarks = read_calibration([path], GIVEN).remarks
    assert len(remarks) == (said is not None)
    assert said is None or said in remarks[0]


CONTRADICTIONS: list[tuple[Supplement, str]] = [
    (replace(GIVEN, rig=None, volume=None), "is incomplete: add the `rig` and the `volume`"),
    (replace(GIVEN, valid_from=datetime(2026, 5, 4)), "needs a zone"),  # noqa: DTZ001
    (replace(GIVEN, rig="../etc"), "'../etc' cannot be the name of a rig"),
    (replace(GIVEN, volume=Box(BOX.high, BOX.low)), "is empty: give the lower corner first"),
    (replace(GIVEN, names=("C1",)), "has 2 sensors, but 1 are named: C1"),
    (replace(GIVEN, names=("P1", "C1")), "P1 cannot be the name of a camera"),
    (replace(GIVEN, names=("C1", "X1")), "'X1' cannot be the name of a sensor"),
    (replace(GIVEN, names=("C1", "C1")), "two sensors of"),
    (GIVEN, "does not say the image size of P1: add `size` P1=COLUMNSxROWS"),
    (replace(GIVEN, sizes={"P2": (1, 1)}), "a size is given for P2, but the sensors"),
    (replace(GIVEN, sizes={"C1": (640, 480), "P1": (9, 9)}), "the size given for C1 is 640 x 480 px, but"),
    (replace(GIVEN, millimetres_per_unit=-1.0), "has more than 0 mm"),
]


@pytest.mark.parametrize(("given", "message"), CONTRADICTIONS, ids=[m[:40] for _, m in CONTRADICTIONS])
def test_what_a_person_adds_is_checked(given: Supplement, message: str, tmp_path: Path) -> None:
    values = dict(
        zip(["M1", "D1", "M4", "D4", "Rlp", "Tlp", "S"], [K1, D1, K2, D2, R, T, [1280, 1024]], strict=True)
    )
    with pytest.raises(InvalidInput) as refused:
        read_calibration([saved(tmp_path / "view.yml", values)], given)
    assert message in str(refused.value)


def test_a_volume_that_no_sensor_sees_is_refused(tmp_path: Path) -> None:
    values = dict(
        zip(["M1", "D1", "M4", "D4", "Rlp", "Tlp", "S"], [K1, D1, K2, D2, R, T, [1280, 1024]], strict=True)
    )
    path, sized = saved(tmp_path / "view.yml", values), replace(GIVEN, sizes={"P1": (1920, 1080)})
    assert not any("of the volume" in remark for remark in read_calibration([path], sized).remarks)
    behind = Box((-100.0, -80.0, -1100.0), (100.0, 80.0, -700.0))
    with pytest.raises(InvalidInput, match=r"of .*view\.yml sees anything of the volume from -100"):
        read_calibration([path], replace(sized, volume=behind))


def test_a_sensor_that_sees_nothing_of_the_volume_is_remarked(
    calibration: Calibration, tmp_path: Path
) -> None:
    away = replace(calibration, volume=Box((-1e5, -80.0, 700.0), (-9e4, 80.0, 1100.0)))
    (remark,) = read_calibration([written(away, "opencv-yaml", tmp_path)], Supplement()).remarks
    assert "C1, C12, P1: nothing of the volume from -100000, -80, 700 to -90000, 80, 1100 mm is in" in remark


def test_a_file_that_says_everything_needs_no_names(calibration: Calibration, tmp_path: Path) -> None:
    path = written(calibration, "opencv-yaml", tmp_path)
    with pytest.raises(InvalidInput, match="names its sensors itself"):
        read_calibration([path], Supplement(names=("C1", "C2", "P1")))
    with pytest.raises(InvalidInput, match="is in millimetres"):
        read_calibration([path], Supplement(millimetres_per_unit=1000.0))
    other = read_calibration([path], GIVEN).calibration
    assert (other.rig.name, other.rig.sensors) == ("desk", calibration.rig.sensors)


@pytest.mark.parametrize("letters", ["\\u0000", "\\ud800"])
def test_letters_that_no_catalogue_holds_are_refused(letters: str, tmp_path: Path) -> None:
    text = (WRONG / "sensor_that_is_missing.json").read_text(encoding="utf-8")
    path = tmp_path / "rig.json"
    path.write_text(text.replace("by hand", letters).replace('["C1"]', "[]"), encoding="utf-8")
    with pytest.raises(ConfigurationError, match=r"origin of .* has letters that no text has"):
        read_calibration([path], Supplement())


REFUSALS = {
    "anchors.yml": "line 23: '&size [ 1280, 1024 ]' is YAML that OpenCV does not write",
    "another_root.xml": "its outermost element is <rig>, not <opencv_storage>",
    "billion_laughs.xml": "line 2: a document type declaration",
    "brackets.yml": "the brackets that are opened in line 23 do not close",
    "campaign.toml": "is no file of OpenCV",
    "empty.yml": "has no camera matrices",
    "fisheye.yml": "M1 in",
    "folded.yml": "the distortion of C1 in",
    "huge_image.yml": "sides are whole numbers from 1 to 20000 px",
    "mirrored.yml": "is no right-handed rotation matrix",
    "newer.json": "has the format 99, this program reads up to 1",
    "no_focal_length.yml": "the focal lengths of M4",
    "no_rotation.yml": "R R^T differs from 1 by 0.1, allowed is 1e-05",
    "no_translation.yml": "Tlp is missing",
    "not_a_number.yml": "holds nan, which is not finite",
    "not_closed.json": "line 2: this is not JSON",
    "not_closed.xml": "line 3: this is not well-formed XML (mismatched tag)",
    "nothing_known.yml": "under names that are known here: it has fruit",
    "omnidirectional.yml": "the model 'omnidirectional', but the camera model here is the pin-hole",
    "one_place.yml": "C1 and P1 stand at one point in",
    "outside_entity.xml": "line 2: a document type declaration",
    "prism.yml": "distortion coefficient 9 of M1",
    "python_object.yml": "S in",
    "sensor_that_is_missing.json": "C1 is missing",
    "shape_that_lies.yml": "has 300000 x 3 numbers, which cannot be",
    "size_of_half_a_pixel.yml": "says 1280.5 x 1024.0 px",
    "skew.yml": "the skew of M1",
    "thesis_attribute.xml": "line 14, element sms/calibration/sensors/sensor[1]/phi_deg: has no attribute",
    "thesis_distortion.xml": "cannot be carried over",
    "thesis_negative_chip.xml": "sensor[1]/length_mm: should be greater than 0, not -8.71",
    "thesis_no_focal_length.xml": "line 5, element sms/calibration/sensors/sensor[1]: c_mm is missing",
    "thesis_overflow.xml": "goes beyond all numbers",
    "thesis_word.xml": "phi_deg: should be a valid number, not 'steep'",
    "three_coefficients.yml": "M1 in",
    "time_without_zone.json": "should be a time with its zone",
    "too_few_numbers.yml": "should hold 3 x 3 numbers, but has 8",
    "twice.yml": "line 23: 'M1' stands twice in one table",
    "words.yml": "should contain only numbers, not 'wide'",
}


@pytest.mark.parametrize("name", REFUSALS)
def test_a_wrong_file_is_refused_in_one_sentence(name: str) -> None:
    sizes = {"P1": (1920, 1080)} if name.endswith(".yml") else {}
    with pytest.raises(SmsError) as refused:
        read_calibration([WRONG / name], replace(GIVEN, sizes=sizes))
    assert isinstance(refused.value, ConfigurationError | OtherFormat)
    assert REFUSALS[name] in str(refused.value)
    assert name in str(refused.value)
    assert "\n" not in str(refused.value)


def test_every_wrong_file_has_its_refusal() -> None:
    assert sorted(p.name for p in WRONG.iterdir()) == sorted(REFUSALS)
