"""Images of a camera without a projector: one a state, of one size, entered once."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.archives import Clock, registered, run_jobs
from support.command import inside
from support.homes import initialised
from typer.testing import CliRunner

from sms_jobs import bootstrap
from sms_jobs.archive import Archive, Provenance
from sms_jobs.catalogue import campaigns
from sms_jobs.cli.importing.group import app
from sms_jobs.errors import InvalidInput, SmsError
from sms_jobs.formats.importers.image_names import guess_image_pattern
from sms_jobs.jobs.archiving.importing import imported_files, measured_tuples
from sms_jobs.jobs.planning.graph import Request
from sms_jobs.jobs.running.recovery import register_worker
from sms_jobs.records.measurement import Measurement
from tests.support.foreign_frames import save


@pytest.fixture
def home(tmp_path: Path) -> Path:
    initialised(tmp_path / "home")
    return tmp_path / "home"


def images(folder: Path, home: Path, *options: str, code: int = 0) -> Any:
    done = CliRunner().invoke(
        app, ["images", str(folder), "-c", "coupon", "--home", str(home), "--json", "--yes", *options]
    )
    if isinstance(done.exception, SmsError):
        raise done.exception
    assert done.exit_code == code, (done.exception, done.stderr)
    return json.loads(done.stdout)


def outcomes(told: Any) -> list[tuple[str, str, str]]:
    return [(t["state"], t["view"], t["outcome"]) for t in told["tuples"]]


@pytest.fixture
def levels(rng: np.random.Generator) -> np.ndarray:
    return rng.integers(0, 256, (4, 16, 20)).astype(np.uint8)


def test_images_arrive_as_they_are_and_once(home: Path, tmp_path: Path, levels: np.ndarray) -> None:
    save(tmp_path / "test", levels, "load_{}.tif", first=8)
    told = images(tmp_path / "test", home, "--reference", "9")
    assert outcomes(told) == [(s, "C1", "imported") for s in ("9", "8", "10", "11")]
    with bootstrap.services(home) as services:
        for one, shown in zip(told["tuples"], levels[[1, 0, 2, 3]], strict=True):
            with services.archive.open_unrecorded(one["detail"]) as dataset:
                measurement = dataset.read("measurement", Measurement)
                np.testing.assert_array_equal(measurement.texture, shown)
                assert measurement.full_scale == 255
        with services.catalogue.reading() as session:
            campaign = campaigns.definition(campaigns.campaign_row(session, "coupon"))
    assert campaign.reference.label == "9"
    assert campaign.views == ("C1",)
    again = images(tmp_path / "test", home)
    assert {o for _, _, o in outcomes(again)} == {"already there"}
    save(tmp_path / "test", 255 - levels[:1], "load_{}.tif", first=12)
    with pytest.raises(InvalidInput, match="no state 12: set `add_states`"):
        images(tmp_path / "test", home)
    assert outcomes(images(tmp_path / "test", home, "--add-states"))[-1] == ("12", "C1", "imported")


def test_a_file_is_shown_with_the_digest_that_others_find(
    home: Path, tmp_path: Path, levels: np.ndarray
) -> None:
    save(tmp_path / "test", levels, "load_{}.tif")
    images(tmp_path / "test", home)
    shown = inside("data", "show", "1", "--home", str(home)).stdout
    facts = dict(line.split(None, 1) for line in shown.splitlines() if len(line.split(None, 1)) == 2)
    assert facts["sha256"] == hashlib.sha256(Path(facts["path"]).read_bytes()).hexdigest()


def test_images_that_saturate_are_remarked_on(home: Path, tmp_path: Path, levels: np.ndarray) -> None:
    few, many = levels // 2, levels // 2
    few[1, 0, :3] = 255  # 3 of 320 px: glints
    many[1, 0, :3], many[2, :4] = 255, 255
    save(tmp_path / "few", few, "s{}.png")
    assert not [said for said in images(tmp_path / "few", home, "--dry-run")["remarks"] if "saturate" in said]
    save(tmp_path / "many", many, "s{}.png")
    (said,) = (one for one in images(tmp_path / "many", home, "--dry-run")["remarks"] if "saturate" in one)
    assert "1 of 4 images saturate: 25% of s2.png is at grey level 255" in said


def test_images_that_show_nothing_are_remarked_on(home: Path, tmp_path: Path, levels: np.ndarray) -> None:
    blank = levels // 2
    save(tmp_path / "whole", blank, "s{}.png")
    assert not [said for said in images(tmp_path / "whole", home, "--dry-run")["remarks"] if "blank" in said]
    blank[2] = 40
    save(tmp_path / "blank", blank, "s{}.png")
    (said,) = (one for one in images(tmp_path / "blank", home, "--dry-run")["remarks"] if "blank" in one)
    assert "1 of 4 images is blank: every pixel of s2.png is 40, and nothing can be matched" in said


def test_images_of_one_content_are_remarked_on(home: Path, tmp_path: Path, levels: np.ndarray) -> None:
    save(tmp_path / "whole", levels, "s{}.png")
    assert not [said for said in images(tmp_path / "whole", home, "--dry-run")["remarks"] if "same" in said]
    levels[3] = levels[1]
    save(tmp_path / "copied", levels, "s{}.png")
    (said,) = (one for one in images(tmp_path / "copied", home, "--dry-run")["remarks"] if "same" in one)
    assert "s1.png and s3.png have the same content" in said


def test_images_of_a_state_that_is_there_already_are_remarked_on(
    home: Path, tmp_path: Path, levels: np.ndarray
) -> None:
    save(tmp_path / "test", levels, "s{}.png")
    assert not [said for said in images(tmp_path / "test", home)["remarks"] if "same" in said]
    assert not [said for said in images(tmp_path / "test", home)["remarks"] if "same" in said]
    save(tmp_path / "later", levels[2:3], "s{}.png", first=7)
    given = ("--pattern", "s{state}.png", "--add-states")
    (said,) = (one for one in images(tmp_path / "later", home, *given)["remarks"] if "same" in one)
    assert "s7.png and s2.png of coupon/2/C1, imported before, have the same content" in said


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Files of the archive that were opened for how they came about."""
    paths: list[str] = []
    provenance = Archive.provenance

    def seen(archive: Archive, path: str) -> Provenance | None:
        paths.append(path)
        return provenance(archive, path)

    monkeypatch.setattr(Archive, "provenance", seen)
    return paths


def test_of_images_that_can_be_no_copies_nobody_asks_what_was_imported(
    home: Path, tmp_path: Path, levels: np.ndarray, opened: list[str]
) -> None:
    save(tmp_path / "test", levels, "s{}.png")
    told = images(tmp_path / "test", home)
    opened.clear()
    given = ("--pattern", "s{state}.png", "--add-states", "--dry-run")
    save(tmp_path / "later", levels[2:3], "s{}.png", first=7)
    images(tmp_path / "later", home, *given)
    assert opened == [one["detail"] for one in told["tuples"]]
    opened.clear()
    save(tmp_path / "blank", np.full_like(levels[:1], 40), "s{}.png", first=8)
    images(tmp_path / "blank", home, *given)
    assert opened == []


def test_what_jobs_recorded_was_made_of_no_files_and_is_not_opened(home: Path, opened: list[str]) -> None:
    with bootstrap.services(home) as services:
        known, clock = (services.catalogue, services.archive), Clock()
        registered(*known, clock)
        with services.catalogue.writing() as session:
            register_worker(session, "w1", "here", 1, ["cpu", "io", "acquisition"], 2, clock())
        run_jobs(*known, clock, [Request("simulate")])
        with services.catalogue.reading() as session:
            campaign = campaigns.definition(campaigns.campaign_row(session, "plate"))
            assert measured_tuples(session, campaign) == {("S00", "C1P1"), ("S01", "C1P1")}
        opened.clear()
        assert list(imported_files(*known, "plate")) == []
    assert opened == []


def test_a_campaign_keeps_its_reference_and_its_rig(home: Path, tmp_path: Path, levels: np.ndarray) -> None:
    save(tmp_path / "test", levels, "s{}.png")
    images(tmp_path / "test", home, "--rig", "bench")
    with pytest.raises(InvalidInput, match="has the reference 0, which stays"):
        images(tmp_path / "test", home, "--reference", "2")
    with pytest.raises(InvalidInput, match="is measured by rig bench, which stays"):
        images(tmp_path / "test", home, "--rig", "desk")
    again = images(tmp_path / "test", home, "--reference", "0")
    assert {o for _, _, o in outcomes(again)} == {"already there"}


def test_images_of_two_depths_have_each_their_full_scale_and_noise(
    home: Path, tmp_path: Path, levels: np.ndarray
) -> None:
    save(tmp_path / "test", levels[:2], "s{}.png")
    save(tmp_path / "test", levels[2:] * 15.0, "s{}.png", first=2, dtype=np.uint16)
    told = images(tmp_path / "test", home)
    assert [one for one in told["remarks"] if "s1.png has 8 bits and s3.png 16" in one], told["remarks"]
    found = []
    with bootstrap.services(home) as services:
        for one in told["tuples"]:
            with services.archive.open_unrecorded(one["detail"]) as dataset:
                found.append(dataset.read("measurement", Measurement))
    assert [one.full_scale for one in found] == [255, 255, 4095, 4095]
    np.testing.assert_allclose([one.gain for one in found], [0.0255, 0.0255, 0.4095, 0.4095])
    np.testing.assert_allclose([one.read_noise for one in found], [0.504, 0.504, 1.12, 1.12], rtol=1e-2)


def test_a_full_scale_that_unused_bits_leave_open_is_asked_for(
    home: Path, tmp_path: Path, levels: np.ndarray
) -> None:
    """Ten bits that are padded to twelve look like fourteen at the upper end of sixteen, hardly lit."""
    padded = 4.0 * np.maximum(levels, 65.0)  # up to 1020, or a multiple of that
    save(tmp_path / "low", 3.0 * padded, "s{}.png", dtype=np.uint16)
    with pytest.raises(InvalidInput, match=r"lowest 2 bits .* can be 4092 or 65532.*give `full_scale`"):
        images(tmp_path / "low", home, "--dry-run")
    given = images(tmp_path / "low", home, "--dry-run", "--full-scale", "4092")
    assert not [said for said in given["remarks"] if "full scale" in said]
    save(tmp_path / "high", 8.0 * padded, "s{}.png", dtype=np.uint16)
    assert "full scale 65504" in str(images(tmp_path / "high", home, "--dry-run")["remarks"])
    saturated = 4.0 * padded
    saturated[0, :2] = 16380.0
    save(tmp_path / "last", saturated, "s{}.png", dtype=np.uint16)
    assert "full scale 16380" in str(images(tmp_path / "last", home, "--dry-run")["remarks"])


def test_a_raw_file_that_was_described_otherwise_is_another_image(home: Path, tmp_path: Path) -> None:
    (tmp_path / "test").mkdir()
    (tmp_path / "test" / "s0.raw").write_bytes(bytes(range(240)) * 2)

    def outcome(raw: str, *options: str, code: int = 0) -> str:
        told = images(tmp_path / "test", home, "--pattern", "s{state}.raw", "--raw", raw, *options, code=code)
        ((_, _, found),) = outcomes(told)
        return found

    assert outcome("12x20x16") == "imported"
    assert outcome("12x20x16") == "already there"
    assert outcome("20x12x16", code=6) == "refused"
    assert outcome("12x20x16be", code=6) == "refused"
    assert outcome("20x12x16", "--newer") == "imported"


def test_an_image_that_does_not_fit_is_left_out(home: Path, tmp_path: Path, levels: np.ndarray) -> None:
    for camera in ("C1", "C2"):
        save(tmp_path / "test" / camera, levels, "s{}.png")
    save(tmp_path / "test" / "C1", levels[2:3, :9], "s{}.png", first=2)
    whole = (tmp_path / "test" / "C2" / "s1.png").read_bytes()
    (tmp_path / "test" / "C2" / "s1.png").write_bytes(whole[:-30])
    told = images(tmp_path / "test", home, "--alone", "--pattern", "{camera}/s{state}.png", code=6)
    refused = [(s, c) for s, c, outcome in outcomes(told) if outcome == "refused"]
    assert refused == [("1", "C2"), ("2", "C1")]
    assert "20 x 9 px and the others of C1 20 x 16 px" in told["tuples"][4]["detail"]


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (("--pattern", "s*.png"), r"has to have \{state\}"),
        (("--pattern", "{state}{number}.png"), r"may have \{camera\}"),
        (("--camera", "X"), "'X' is no camera"),
        (("--reference", "99"), "no image shows the reference 99"),
        (("--pattern", "x{state}.png"), "no file of"),
        (("--raw", "nonsense"), "described as in"),
    ],
)
def test_what_cannot_be_is_refused(
    home: Path, tmp_path: Path, levels: np.ndarray, options: tuple[str, ...], complaint: str
) -> None:
    save(tmp_path / "test", levels, "s{}.png")
    with pytest.raises(InvalidInput, match=complaint):
        images(tmp_path / "test", home, *options)
    with bootstrap.services(home) as services:
        assert not list(services.archive.files())


@pytest.mark.parametrize(
    ("names", "pattern"),
    [
        (["oht_cfrp_00.tiff", "oht_cfrp_01.tiff"], "oht_cfrp_{state}.tiff"),
        (["cam0_f1.png", "cam0_f2.png"], "cam0_f{state}.png"),
        (["r1/a_1.png", "r2/a_2.png", "r2/a_3.png"], "r*/a_{state}.png"),
    ],
)
def test_what_varies_last_is_the_state(names: list[str], pattern: str) -> None:
    assert guess_image_pattern(names) == pattern


def test_names_that_do_not_vary_are_no_states() -> None:
    with pytest.raises(InvalidInput, match=r"no part of the name a\.png varies"):
        guess_image_pattern(["a.png"])
