"""The report as people see it: opened from a file in a real browser, pointed at, turned and printed."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.browser import Browser, browser_or_skip
from support.report_results import campaign, run_on_results

from sms_jobs.archive import Archive, FolderStore
from sms_jobs.kinds.products import MERGED
from sms_jobs.kinds.reporting import report
from sms_jobs.records.fields import MergedField
from sms_jobs.records.quantity import SYMMETRIC
from sms_jobs.records.subject import Subject

EVIL = "</script><img src=x onerror=\"document.title='broken into'\">"
SIZE = (90, 120)
STEP = 2  # 120 px in 64 samples
MAP = "document.querySelector('#v3')"  # of C1 at S01: two cameras at rest before it


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the report of three states, and the archive that it was made of."""
    folder = tmp_path_factory.mktemp("report")
    of = campaign(3, material=EVIL, views=("C1P1", "C2P1"))
    run_on_results(folder, report.KIND, of, Subject("plate"), size=SIZE, map_px=64, figure_width_px=240)
    return folder


@pytest.fixture(scope="module")
def started(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """A browser for all tests of this file."""
    with Browser(browser_or_skip(), tmp_path_factory.mktemp("profile")) as browser:
        yield browser


@pytest.fixture
def page(started: Browser, folder: Path) -> Iterator[Browser]:
    """The report, open at the map of the first deformed state; nothing may be complained of in the end."""
    started.screen(1280, 900)
    started.open(folder / "plate-report.html")
    bring_up(started)
    yield started
    assert started.complaints == []


def bring_up(page: Browser) -> None:
    page.run(f"{MAP}.scrollIntoView()")
    page.wait_for(f"{MAP}.querySelector('.readout').textContent.length > 9")


def picture(page: Browser, which: str = "canvas") -> np.ndarray:
    address = page.run(f"{MAP}.querySelector('{which}').toDataURL()")
    return np.asarray(Image.open(io.BytesIO(page.decoded(address))).convert("RGB"), np.int16)


def point_at(page: Browser, column_px: int, row_px: int) -> tuple[float, float]:
    """Point at a pixel of the camera's image, which fills the canvas."""
    box = page.run(
        f"(() => {{ const b = {MAP}.querySelector('canvas').getBoundingClientRect();"
        " return [b.x, b.y, b.width, b.height]; })()"
    )
    x = box[0] + (column_px + 0.5) / SIZE[1] * box[2]
    y = box[1] + (row_px + 0.5) / SIZE[0] * box[3]
    page.point(x, y)
    return x, y


def readout(page: Browser, wanted: str) -> str:
    page.wait_for(f"{MAP}.querySelector('.readout').textContent.includes({wanted!r})")
    return str(page.run(f"{MAP}.querySelector('.readout').textContent"))


def choose(page: Browser, field: str) -> None:
    page.run(
        f"(() => {{ const s = {MAP}.querySelector('select');"
        f" s.value = [...s.options].find((o) => o.text.startsWith({field!r})).value;"
        " s.dispatchEvent(new Event('change')); })()"
    )


def merged(folder: Path, state: str) -> MergedField:
    archive = Archive(FolderStore(folder / "archive"))
    (path,) = (folder / "archive" / "plate" / state).glob("merge-*.h5")
    with archive.open_unrecorded(str(path.relative_to(folder / "archive"))) as dataset:
        return dataset.read(MERGED.of("C1").stored_as, MergedField)


def test_the_page_asks_for_nothing_and_runs_no_stranger(page: Browser, folder: Path) -> None:
    own = (folder / "plate-report.html").as_uri()
    assert {r for r in page.requests if not r.startswith("data:")} == {own}
    assert page.run("document.title") == "Campaign plate"
    assert page.run("document.querySelectorAll('img[onerror], [src=x]').length") == 0
    assert page.run("[...document.querySelectorAll('td')].some((c) => c.textContent.includes('onerror'))")
    # What would still get in could do nothing: the policy names the two pieces that may run.
    added = "const s = document.createElement('script'); s.textContent = 'window.stranger = 1'"
    assert page.run(
        f"(() => {{ {added}; document.body.append(s); return window.stranger === undefined; }})()"
    )
    assert page.run("fetch('data:text/plain,x').then(() => 'fetched', () => 'refused')") == "refused"
    page.run("new Promise((done) => setTimeout(done, 0))")
    assert all("Content Security Policy" in complaint for complaint in page.complaints)
    page.complaints.clear()


def test_pointing_shows_what_the_archive_holds(page: Browser, folder: Path) -> None:
    field = merged(folder, "S01")
    choose(page, "displacement X")
    for column, row in ((61, 45), (101, 81)):  # sampled pixels: each second, from 1 on
        point_at(page, column, row)
        words = readout(page, f"at x {column}, y {row} px")
        found = re.match(r"displacement X: (\S+) ± (\S+) mm at .*; X (\S+), Y (\S+), Z (\S+) mm", words)
        assert found, words
        value, sigma, *place = (float(number) for number in found.groups())
        true_sigma = float(np.sqrt(field.covariance[SYMMETRIC.index("XX"), row, column]))
        # Rounded to a twelfth of sigma in the page, and written to two digits of it, at worst to a tenth.
        assert value == pytest.approx(field.displacement[0, row, column], abs=true_sigma * (1 / 24 + 1 / 20))
        # A step of 8 %, and two digits of a number that begins with 1.
        assert sigma == pytest.approx(true_sigma, rel=0.04 + 0.05)
        # 300 mm in 65,533 steps, written to a thousandth.
        assert place == pytest.approx(list(field.position[:, row, column]), abs=300 / 65_533 / 2 + 0.0005)


def test_a_pixel_without_a_value_says_why(page: Browser) -> None:
    point_at(page, 3, 3)
    assert "no value (status of the displacement: low modulation" in readout(page, "at x 3, y 3 px")


def test_the_keyboard_reads_and_zooms_too(page: Browser) -> None:
    page.run(f"{MAP}.querySelector('canvas').focus()")
    page.key("ArrowRight")
    # The middle of 60 x 45 samples, and one to the right.
    readout(page, f"at x {31 * STEP + 1}, y {22 * STEP + 1} px")
    whole = picture(page)
    page.key("+", "+")
    assert np.abs(picture(page) - whole).max() > 50
    page.key("0", "0")
    assert np.array_equal(picture(page), whole)


def test_another_field_is_another_picture(page: Browser) -> None:
    first = picture(page)
    choose(page, "strain xx")
    page.wait_for(f"{MAP}.querySelector('canvas').getAttribute('aria-label').includes('strain xx')")
    second = picture(page)
    assert np.abs(second - first).max() > 50
    page.run(f"{MAP}.querySelector('[aria-pressed]').click()")
    page.wait_for(f"{MAP}.querySelector('.scale').getAttribute('aria-label').includes('standard deviation')")


def test_a_clicked_point_is_followed_over_the_states(page: Browser, folder: Path) -> None:
    choose(page, "displacement X")
    page.press(*point_at(page, 61, 45))
    page.wait_for(f"{MAP}.querySelectorAll('.followed svg circle').length === 2")
    told = page.run(f"[...{MAP}.querySelectorAll('.followed svg title')].map((t) => t.textContent)")
    for words, state in zip(told, ("S01", "S02"), strict=True):
        found = re.fullmatch(rf"{state}: (\S+) ± (\S+) mm", words)
        assert found, words
        value, sigma = float(found[1]), float(found[2])
        # As above.
        assert value == pytest.approx(merged(folder, state).displacement[0, 45, 61], abs=0.15 * sigma)


def test_the_surface_is_seen_in_space(page: Browser) -> None:
    page.run(f"{MAP}.querySelector('[title^=turn]').click()")
    page.wait_for(f"{MAP}.querySelector('canvas.space') && {MAP}.querySelector('canvas.space').style.height")
    before = picture(page, "canvas.space")
    background = before[0, 0]
    seen = np.abs(before - background).max(axis=-1) > 8
    # The plate, which fills the circle of view by about a third, in colours.
    assert 0.1 < seen.mean() < 0.9
    assert len(np.unique(before[seen] // 16, axis=0)) > 10
    page.run(f"{MAP}.querySelector('canvas.space').focus()")
    page.key("ArrowLeft")
    assert np.abs(picture(page, "canvas.space") - before).max() > 50
    page.run(f"{MAP}.querySelector('[title^=turn]').click()")
    assert page.run("document.querySelectorAll('canvas.space').length") == 0


def test_it_is_printed_with_still_pictures(page: Browser, folder: Path) -> None:
    pdf = page.print()
    pages = len(re.findall(rb"/Type /Page\b", pdf))
    # 2 x 3 pictures at rest and 4 x 4 of the states, of which two lines fill a page, and the tables.
    assert 5 <= pages <= 14
    # One that is shown twice is kept once.
    stills = set(re.findall(r'src="(data:image/png[^"]*)"', (folder / "plate-report.html").read_text()))
    assert len(re.findall(rb"/Subtype /Image\b", pdf)) >= len(stills) >= 2 + 4 * 2


def test_nothing_sticks_out_of_a_telephone(page: Browser) -> None:
    page.screen(390, 844, mobile=True)
    bring_up(page)
    assert page.run("document.documentElement.scrollWidth") <= 390
    box = page.run(f"{MAP}.querySelector('canvas').getBoundingClientRect().width")
    assert 300 <= box <= 390
