"""What other programs are given is the case, and what they give back is judged as ours is."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sms_jobs.bench.peers import PEERS, peers_folder
from sms_jobs.bench.two_cameras.peers import Case, Outcome, prepare
from sms_jobs.virtual_rig.stereo_campaigns import stereo_campaign


def case() -> Case:
    truth = np.full((3, 40, 50), np.nan)
    truth[:, 10:30, 10:30] = np.array([1.0, -1.0, 0.0])[:, None, None]
    image = np.arange(2000, dtype=np.uint8).reshape(40, 50)
    calibration, _ = stereo_campaign("two")
    return Case(((image, image + 1), (image + 2, image + 3)), calibration, truth, 8)


def test_the_case_is_written_as_it_is(home: Path) -> None:
    one = case()
    prepare(one.given, home / "case")
    np.testing.assert_array_equal(np.array(Image.open(home / "case" / "1_0.tiff")), one.images[0][1])
    np.testing.assert_array_equal(np.array(Image.open(home / "case" / "0_1.tiff")), one.images[1][0])
    assert np.count_nonzero(np.array(Image.open(home / "case" / "roi.png"))) == 400
    written = json.loads((home / "case" / "case.json").read_text(encoding="utf-8"))
    first, second = (one.calibration.rig.sensor(name) for name in ("C1", "C2"))
    # From the frame of the first camera into that of the second.
    point = np.array([3.0, -7.0, 400.0])
    seen = [camera.pose.matrix() @ point + camera.pose.translation for camera in (first, second)]
    np.testing.assert_allclose(written["rotation"] @ seen[0] + written["translation"], seen[1])
    assert written["states"] == 2
    assert written["matrices"][1][0][0] == second.intrinsics.fx
    assert written["search_px"] == 8


def test_points_beside_the_specimen_and_without_displacement_do_not_count() -> None:
    one = case()
    y, x = np.mgrid[0:40:5, 0:50:5].reshape(2, -1).astype(float)
    moved = np.broadcast_to(np.array([1.0, -1.0, 0.3])[:, None], (3, len(x))).copy()
    moved[:, (x == 10) & (y == 10)] = np.nan
    found = Outcome(np.stack([x, y]), moved[None], 2.0, 5)
    np.testing.assert_allclose(found.errors_mm(one), 0.3)
    # 4 x 4 points lie on the specimen, and one has failed.
    assert found.valid_part(one) == pytest.approx(15 / 16)
    assert found.points_per_cpu_s() == pytest.approx((len(x) - 1) / 2.0)


def test_without_a_folder_there_are_no_others(monkeypatch: pytest.MonkeyPatch, home: Path) -> None:
    monkeypatch.delenv(PEERS, raising=False)
    assert peers_folder() is None
    # What is misspelt is told before anything is rendered, not after minutes by a file that is not there.
    monkeypatch.setenv(PEERS, str(home))
    assert peers_folder() is None
    (home / "bin").mkdir(parents=True)
    (home / "bin" / "python").touch()
    assert peers_folder() == home
