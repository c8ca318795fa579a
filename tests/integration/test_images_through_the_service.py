"""A flat coupon and one camera, as a person tests it: images, loads and gauges in, strain and report out."""

from __future__ import annotations

import os
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
from PIL import Image
from support.command import answer, inside, service

from sms_jobs.bench.correlated.speckle_pairs import speckle_pair
from sms_jobs.metrology.arrays import Floats

USAGE = 2
SIZE = 128
SCALE = 0.05
BEGIN = datetime(2026, 5, 4, 10, 0, tzinfo=UTC)
ALONG = (0.0, 2e-3, 4e-3)
"""Small strain along the rows at each state; the coupon contracts by a quarter of it across."""
GAUGE = "G1 x=64px y=64px length=60px width=40px angle=90"


def pulled(strain: float) -> Any:
    """Return the displacement of a coupon that is held at its lower end and pulled upwards, y down."""

    def displacement(x: Floats, y: Floats) -> tuple[Floats, Floats]:
        return -0.25 * strain * (x - SIZE / 2), strain * (y - SIZE)

    return displacement


def green(strain: float) -> float:
    return strain + 0.5 * strain**2


def write_images(folder: Path) -> None:
    """Write an image of each state, a minute after the other, and the logs of two other devices."""
    folder.mkdir()
    rng = np.random.default_rng(3)
    rows = np.mgrid[0:SIZE, 0:SIZE][1]
    for number, strain in enumerate(ALONG):
        levels = speckle_pair(SIZE, pulled(strain), seed=2)[1] / 16.0 + rng.normal(0.0, 0.5, (SIZE, SIZE))
        # The coupon ends before the image does.
        levels = np.where((rows >= 12) & (rows < SIZE - 12), levels, 8.0 + rng.normal(0.0, 0.5, levels.shape))
        file = folder / f"coupon_{number:02}.png"
        Image.fromarray(np.clip(np.rint(levels), 0, 255).astype(np.uint8)).save(file)
        at = (BEGIN + timedelta(minutes=number)).timestamp()
        os.utime(file, (at, at))
    log = ["Time;Force"]
    gauges = ["clock,SG1"]
    for second in range(0, 180, 10):
        at = BEGIN + timedelta(seconds=second + 2)
        load = second / 120.0
        log.append(f"{at:%Y-%m-%dT%H:%M:%S};{load:.3f}".replace(".", ","))
        gauges.append(
            f"{at + timedelta(hours=2):%Y-%m-%dT%H:%M:%S}+02:00,{1e6 * green(2e-3 * second / 60):.1f}"
        )
    (folder / "load.csv").write_text("\n".join(log))
    (folder / "gauges.csv").write_text("\n".join(gauges))


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """Import, compute and export; return the home and what was said."""
    home = tmp_path_factory.mktemp("camera") / "home"
    folder = home.parent / "images"
    write_images(folder)
    at = ("--home", str(home))
    assert inside("init", *at).returncode == 0
    said: dict[str, Any] = {
        "images": answer("import", "images", str(folder), "-c", "coupon", "--yes", *at),
        "loads": answer(
            "import", "channels", str(folder / "load.csv"), "-c", "coupon", "--map", "Force=load[kN]",
            "--time-zone", "UTC", "--within", "5", *at,
        ),
        "gauges": answer(
            "import", "gauges", str(folder / "gauges.csv"), "-c", "coupon", "--map", "SG1=G1",
            "--time-column", "clock", "--within", "5", *at,
        ),
    }  # fmt: skip
    with service(home):
        answer(
            "job", "submit", "pipeline", "gauges", "-c", "coupon", "--wait",
            "--set", f"plane.mm_per_px={SCALE}",
            "--set", "correlate.search_range_x_px=8",
            "--set", "correlate.search_range_y_px=8",
            "--set", "strain.gauge_length_mm=2",
            "--set", "export.formats=vtu",
            "--set", f"gauges.gauge={GAUGE}",
            *at,
        )  # fmt: skip
    return home, said


def run(home: Path, *arguments: str) -> Any:
    return answer(*arguments, "--home", str(home))


def found_of(home: Path, query: str) -> Any:
    return run(home, "data", "find", query, "-c", "coupon")


def test_images_loads_and_gauges_come_in_by_name_and_by_time(done: tuple[Path, dict[str, Any]]) -> None:
    home, said = done
    assert [(t["state"], t["view"], t["outcome"]) for t in said["images"]["tuples"]] == [
        (f"{k:02}", "C1", "imported") for k in range(3)
    ]
    assert said["loads"]["states"] == said["gauges"]["states"] == ["00", "01", "02"]
    found = found_of(home, "strain where load_kN > 0.9")
    # Of 0, 0.5 and 1 kN.
    assert [one["subject"] for one in found] == ["coupon/02/C1"]


def test_strain_is_that_of_the_coupon(done: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    home, _ = done
    (found,) = found_of(home, "strain where load_kN > 0.9")
    section = run(
        home, "data", "section", str(found["id"]), "--from", "64,30", "--to", "64,100", "--field", "strain"
    )
    yy = np.array([row[section["columns"].index("strain_yy")] for row in section["rows"]])
    (shown,) = found_of(home, "export where load_kN > 0.9")
    run(home, "data", "export", str(shown["id"]), "-o", str(tmp_path / "coupon.vtu"))
    mesh = meshio.read(tmp_path / "coupon.vtu")
    sigma = np.nanmedian(np.ravel(mesh.point_data["sigma of strain yy [1]"]))
    # Gauges of 40 px overlap along the section: their mean is one gauge's, so five deviations of one.
    assert abs(yy.mean() - green(ALONG[2])) < 5.0 * sigma
    assert sigma < 1e-3
    # Held below and pulled upwards: the exported surface moves as the coupon does, in mm with y up.
    up = np.ravel(mesh.point_data["displacement Y [mm]"])
    expected = ALONG[2] * (SIZE * SCALE + mesh.points[:, 1])
    # 0.01 px of match, and of the image's whole grey levels, times the size of a pixel.
    assert np.sqrt(np.nanmean((up - expected) ** 2)) < 0.02 * SCALE
    # Nothing is told of the background.
    assert mesh.points[:, 0].min() > 10 * SCALE
    assert mesh.points[:, 0].max() < (SIZE - 10) * SCALE


def test_a_gauge_outside_of_the_image_is_refused_before_anything_is_queued(
    done: tuple[Path, dict[str, Any]],
) -> None:
    home, _ = done
    before = run(home, "job", "list", "-c", "coupon")
    image = "and the image of 128 x 128 px reaches from 0 to"
    for gauge, place in (
        ("G9 x=640px y=64px length=60px", f"its x is 640 px, {image} 127 px"),
        ("G9 x=3 y=-4 length=3", f"its y is -4 mm, {image} 6.35 mm"),
    ):
        # With the surface that was made, and with one that is to be made.
        given = ["-c", "coupon", "--set", f"gauges.gauge={GAUGE};{gauge}", "--home", str(home)]
        for kinds in (("gauges",), ("pipeline", "gauges", "--set", f"plane.mm_per_px={SCALE}")):
            refused = inside("job", "submit", *kinds, *given)
            assert refused.returncode == USAGE
            assert f"gauge G9 lies outside of the image of C1: {place}; move it into" in refused.stderr
    # The plane that is to be made has no scale, unless it is given.
    mm = f"gauges.gauge={GAUGE}; G9 x=3 y=4 length=3"
    refused = inside("job", "submit", "pipeline", "gauges", "-c", "coupon", "--set", mm, "--home", str(home))
    assert refused.returncode == USAGE
    assert "gauge G9 is in mm, which mean nothing in the image of C1: it has no scale" in refused.stderr
    assert run(home, "job", "list", "-c", "coupon") == before
    # Where the image cannot be read now nobody knows, and jobs are queued as ever.
    files = home / "archive" / "coupon"
    files.rename(home / "away")
    try:
        assert inside("job", "submit", "gauges", *given, "--dry-run").returncode == 0
    finally:
        (home / "away").rename(files)


def test_the_merged_field_has_sections_too(done: tuple[Path, dict[str, Any]]) -> None:
    home, _ = done
    (merged,) = found_of(home, "merge where load_kN > 0.9")
    wanted = ("data", "section", str(merged["id"]), "--from", "64,30", "--to", "64,100", "--step", "5")
    section = run(home, *wanted)
    assert section["columns"] == [
        "distance_px", "column_px", "row_px", "displacement_X", "displacement_Y", "pixels",
    ]  # fmt: skip
    assert section["units"] == ["px", "px", "px", "mm", "mm", "1"]
    assert "displacement_X [mm]  displacement_Y [mm]" in inside(*wanted, "--home", str(home)).stdout
    for _, _, row, _, up, _ in section["rows"]:
        # Held at the lower end, and pulled upwards: in mm, to a hundredth of a pixel.
        assert up == pytest.approx(ALONG[2] * (SIZE - row) * SCALE, abs=0.02 * SCALE)


def test_two_states_are_compared(done: tuple[Path, dict[str, Any]]) -> None:
    home, _ = done
    (early,) = found_of(home, "merge where load_kN < 0.9")
    (late,) = found_of(home, "merge where load_kN > 0.9")
    found = run(home, "data", "compare", str(late["id"]), "--with", str(early["id"]))
    # Held at the lower end: half the length moves by half of what the states differ by in strain, upwards.
    expected = (ALONG[2] - ALONG[1]) * SIZE / 2 * SCALE
    # A tenth: the rows that could be matched are not quite the image's.
    assert found["mean_Y_mm"] == pytest.approx(expected, rel=0.1)
    assert abs(found["mean_X_mm"]) < 0.02 * SCALE
    assert "rms_Z_mm" not in found


def test_a_virtual_gauge_stands_beside_the_real_one(done: tuple[Path, dict[str, Any]]) -> None:
    home, _ = done
    rows = run(home, "data", "gauges", "-c", "coupon")["gauges"]
    assert [(r["state"], r["gauge"]) for r in rows] == [("01", "G1"), ("02", "G1")]
    for row, strain in zip(rows, ALONG[1:], strict=True):
        assert row["real"] == pytest.approx(green(strain), rel=1e-3)
        # The gauge lies on 40 x 60 px; five of its stated deviations.
        assert abs(row["difference"]) < 5.0 * row["sigma"]
        assert row["sigma"] < 1e-3


def test_the_report_shows_it(done: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    home, _ = done
    page = tmp_path / "report.html"
    run(home, "data", "export", "--kind", "report", "-c", "coupon", "-o", str(page))
    text = page.read_text()
    for words in (
        "Shape, displacement and strain",
        "gauge length of 2 mm (40 px)",
        "yy, median",
        "load [N]",
        "cameras alone",
        "correlate, version",
    ):
        assert words in text
    assert "fringe densities" not in text


def test_what_a_camera_alone_cannot_do_is_said(done: tuple[Path, dict[str, Any]]) -> None:
    home, _ = done
    refused = inside("job", "submit", "reconstruct", "-c", "coupon", "--home", str(home))
    assert refused.returncode == USAGE
    told = " ".join(refused.stderr.split())
    assert "measured by C1 without a projector" in told
    assert "correlate" in told
