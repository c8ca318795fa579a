"""The page of a field in a real browser, on results that a worker has computed and a server serves."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.browser import Browser, browser_or_skip
from support.command import answer, service
from support.homes import stored
from support.serving import serving

from sms_jobs import bootstrap
from sms_jobs.app.holdings import reading
from sms_jobs.jobs.archiving.registration import register_campaign
from sms_jobs.records.campaign import LoadState
from sms_jobs.records.fields import StrainField
from sms_jobs.records.scene import UniaxialStrain
from sms_jobs.virtual_rig.campaigns import HOLD, small_plate

SIZE = 128
MAP = "document.querySelector('#m0')"
TOLD = "document.querySelector('#told').textContent"


@dataclass(frozen=True)
class Served:
    """A home whose service runs, and the address of its console."""

    home: Path
    address: str

    def file(self, kind: str, subject: str) -> int:
        with bootstrap.services(self.home) as services:
            return reading.newest(services, subject, kind).file.id

    def strain(self, state: str) -> StrainField:
        with bootstrap.services(self.home) as services:
            record = reading.newest(services, f"plate/{state}/C1P1", "strain").record
        assert isinstance(record, StrainField)
        return record


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """The small plate at three states, computed."""
    home = tmp_path_factory.mktemp("home")
    bootstrap.initialise(home)
    with bootstrap.services(home) as services:
        calibration, plate = small_plate("plate")
        first, second = plate.states
        assert second.load_n is not None
        assert second.time is not None
        third = LoadState("S02", 2400.0, 1.5, second.time + HOLD, deformation=(UniaxialStrain(0.01, 0.3),))
        plate = replace(plate, states=(first, second, third))
        register_campaign(services.catalogue, services.archive, plate, calibration, datetime.now(UTC))
    with service(home):
        kinds = ("simulate", "reconstruct", "correlate", "strain", "merge")
        answer("job", "submit", *kinds, "-c", "plate", "--wait", "--home", str(home))
        with serving(home) as address:
            yield Served(home, address)


@pytest.fixture(scope="module")
def started(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """A browser for all tests of this file."""
    with Browser(browser_or_skip(), tmp_path_factory.mktemp("profile")) as browser:
        yield browser


@pytest.fixture
def page(started: Browser, served: Served) -> Iterator[Browser]:
    """The strain of a state; nothing may be complained of in the end, a policy that was broken neither."""
    started.screen(1280, 1000)
    show(started, f"{served.address}/field/{served.file('strain', 'plate/S01/C1P1')}")
    yield started
    assert started.complaints == []


def show(page: Browser, address: str) -> None:
    page.visit(address)
    page.wait_for(f"{MAP}.querySelector('.readout')?.textContent.length > 9")
    page.run(f"{MAP}.querySelector('canvas').scrollIntoView({{ block: 'center' }})")


def place_of(page: Browser, column: float, row: float) -> tuple[float, float]:
    """Return where a pixel is shown; the whole image lies in the middle of the canvas."""
    x, y, width, height = page.run(
        f"(() => {{ const b = {MAP}.querySelector('canvas').getBoundingClientRect();"
        " return [b.x, b.y, b.width, b.height]; })()"
    )
    pitch = min(width, height) / SIZE
    return x + width / 2 + (column + 0.5 - SIZE / 2) * pitch, y + height / 2 + (row + 0.5 - SIZE / 2) * pitch


def choose(page: Browser, tool: str) -> None:
    page.run(f"document.querySelector('input[value={tool}]').click()")


def select(page: Browser, field: str) -> None:
    page.run(
        f"(() => {{ const s = {MAP}.querySelector('select');"
        f" s.value = [...s.options].find((o) => o.text.startsWith({field!r})).value;"
        " s.dispatchEvent(new Event('change')); })()"
    )


def told(page: Browser, wanted: str) -> str:
    page.wait_for(f"{TOLD}.includes({wanted!r})")
    return str(page.run(TOLD))


def readout(page: Browser, column: int, row: int) -> str:
    page.wait_for(f"{MAP}.querySelector('.readout').textContent.includes('at x {column}, y {row} px')")
    return str(page.run(f"{MAP}.querySelector('.readout').textContent"))


def picture(page: Browser, which: str = "#m0 canvas") -> np.ndarray:
    address = page.run(f"document.querySelector('{which}').toDataURL()")
    return np.asarray(Image.open(io.BytesIO(page.decoded(address))).convert("RGB"), np.int16)


def test_values_are_those_of_the_archive_under_the_pointer_and_the_keys(
    page: Browser, served: Served
) -> None:
    field = served.strain("S01")
    page.point(*place_of(page, 60, 70))
    first = readout(page, 60, 70)
    page.run(f"{MAP}.querySelector('canvas').focus()")
    page.key("ArrowRight")
    for words, column in ((first, 60), (readout(page, 61, 70), 61)):
        found = re.match(r"strain xx: (\S+) ± (\S+) µε at ", words)
        assert found, words
        sigma = 1e6 * float(field.sigma[0, 70, column])
        # Rounded to an eighth of sigma, and written to two digits of it; sigma itself in steps of 4 %.
        assert float(found[1]) == pytest.approx(1e6 * field.strain[0, 70, column], abs=0.12 * sigma)
        assert float(found[2]) == pytest.approx(sigma, rel=0.07)
    assert page.run(f"{MAP}.querySelector('.readout').getAttribute('aria-live')") == "polite"


def test_a_pixel_without_a_value_says_why(page: Browser) -> None:
    page.point(*place_of(page, 2, 2))
    assert re.match(r"strain xx: no value \(status: \w+", readout(page, 2, 2))


def test_a_picked_point_is_followed_over_the_loads(page: Browser, served: Served) -> None:
    page.press(*place_of(page, 60, 70))
    page.wait_for("document.querySelectorAll('#chart circle').length === 2")
    shown = page.run("[...document.querySelectorAll('#chart title')].map((t) => t.textContent)")
    for words, state in zip(shown, ("S01", "S02"), strict=True):
        field = served.strain(state)
        sigma = 1e6 * float(field.sigma[0, 70, 60])
        value = float(re.match(rf"{state}: (\S+) ", words)[1])  # type: ignore[index]
        # As archived: but for the two digits of sigma that it is written to.
        assert value == pytest.approx(1e6 * field.strain[0, 70, 60], abs=0.051 * sigma)
    assert "load [N]" in page.run("document.querySelector('#chart').textContent")


def test_a_clicked_gauge_reads_what_a_job_does(page: Browser, served: Served) -> None:
    choose(page, "gauge")
    page.press(*place_of(page, 45, 70))
    told(page, "second point")
    page.press(*place_of(page, 75, 60))
    words = told(page, "pixels of C1P1")
    page.wait_for("document.querySelectorAll('#chart circle').length === 2")
    gauge = page.run("document.querySelector('#gauge-text').value")
    strain, sigma = map(float, re.search(r": (\S+) ± (\S+) µε", words).groups())  # type: ignore[union-attr]
    wanted = ("--set", f"gauges.gauge={gauge}", "--home", str(served.home))
    answer("job", "submit", "gauges", "-c", "plate", "--wait", *wanted)
    rows = answer("data", "gauges", "-c", "plate", "--view", "C1P1", "--home", str(served.home))["gauges"]
    (row,) = (row for row in rows if row["state"] == "S01")
    assert strain == pytest.approx(1e6 * row["virtual"], abs=0.051 * sigma)
    assert sigma == pytest.approx(1e6 * row["sigma"], rel=0.05)
    assert f"from {row['pixels']} pixels" in words


def test_a_clicked_section_is_that_of_the_command(page: Browser, served: Served) -> None:
    choose(page, "section")
    page.press(*place_of(page, 40, 60))
    told(page, "second point")
    page.press(*place_of(page, 80, 70))
    told(page, "pieces have a value")
    ends = [page.run(f"document.querySelector('#{name}').value").replace(" ", "") for name in ("from", "to")]
    file = str(served.file("strain", "plate/S01/C1P1"))
    lines = ("--from", ends[0], "--to", ends[1], "--step", "2", "--width", "4")
    found = answer("data", "section", file, *lines, "--home", str(served.home))
    cells = page.run(
        "[...document.querySelectorAll('#table tbody tr')].map((r) => [...r.cells].map((c) => c.textContent))"
    )
    assert len(cells) == len(found["rows"]) > 10
    place = found["columns"].index("strain_xx")
    for shown, row in zip(cells, found["rows"], strict=True):
        assert float(shown[0]) == row[0]
        # Written to two digits of the scatter.
        assert float(shown[1]) == pytest.approx(1e6 * row[place], abs=max(0.06 * float(shown[2] or 0), 1.0))
        assert int(shown[3]) == row[-1]
    assert page.run("document.querySelectorAll('#chart .band').length") >= 1


def test_colours_show_the_range_that_was_asked_for(page: Browser) -> None:
    first = picture(page)
    page.run(
        f"(() => {{ const [low, high] = {MAP}.querySelectorAll('input[type=number]');"
        " low.value = 4000; high.value = 4001;"
        " high.dispatchEvent(new Event('change')); })()"
    )
    page.wait_for(f"{MAP}.querySelector('.scale').getAttribute('aria-label').includes('from 4000 to 4001')")
    assert np.abs(picture(page) - first).max() > 50


def test_reasons_are_a_map_with_a_legend_and_the_surface_turns(page: Browser) -> None:
    select(page, "status")
    page.wait_for(f"{MAP}.querySelector('.legend')?.textContent.includes('valid')")
    page.run(f"{MAP}.querySelector('[title^=turn]').click()")
    page.wait_for(f"{MAP}.querySelector('canvas.space')?.style.height")
    seen = picture(page, "#m0 canvas.space")
    assert len(np.unique(seen.reshape(-1, 3), axis=0)) > 10


def test_two_results_stand_side_by_side_with_their_difference(page: Browser, served: Served) -> None:
    first, second = (served.file("merge", f"plate/{state}") for state in ("S02", "S01"))
    show(page, f"{served.address}/field/{first}?with={second}#displacement%20X")
    page.wait_for("document.querySelector('#differs td')")
    page.wait_for("document.querySelector('#difference .readout')?.textContent.length > 9")
    page.point(*place_of(page, 60, 70))
    maps = "['m0', 'm1', 'difference'].map((i) => document.querySelector(`#${i} .readout`).textContent)"
    # Each asks for its own positions first.
    page.wait_for(f"{maps}.every((words) => words.includes('at x 60, y 70 px'))")
    read = page.run(maps)
    values = [float(re.match(r"displacement X: (\S+) ± ", words)[1]) for words in read]  # type: ignore[index]
    assert values[2] == pytest.approx(values[0] - values[1], abs=0.002)
    assert abs(values[2]) > 0.05
    facts = answer("data", "compare", str(first), "--with", str(second), "--home", str(served.home))
    shown = page.run("[...document.querySelectorAll('#differs td')].map((c) => Number(c.textContent))")
    # But for the numbers of the files and the schema.
    assert shown == pytest.approx(
        [v for k, v in facts.items() if k not in ("schema", "file", "other")], rel=1e-4
    )


def test_states_are_gone_through_with_the_chosen_quantity(page: Browser, served: Served) -> None:
    select(page, "strain yy")
    links = "[...document.querySelectorAll('nav a[data-keep]')]"
    link = page.run(f"{links}.find((a) => a.textContent.includes('after')).href")
    show(page, link)
    assert page.run("location.pathname") == f"/field/{served.file('strain', 'plate/S02/C1P1')}"
    page.point(*place_of(page, 60, 70))
    assert readout(page, 60, 70).startswith("strain yy")


def test_a_link_that_was_cut_off_shows_the_first_quantity(page: Browser, served: Served) -> None:
    address = f"{served.address}/field/{served.file('strain', 'plate/S01/C1P1')}"
    page.visit("about:blank")
    show(page, f"{address}#strain%20y%")
    page.point(*place_of(page, 60, 70))
    assert readout(page, 60, 70).startswith("strain xx")


def test_what_is_refused_or_not_answered_is_told_without_what_was_read_before(
    page: Browser, served: Served
) -> None:
    rows = "document.querySelectorAll('#table tbody tr').length"
    for unanswered, words in (
        ("Promise.reject(new TypeError('Failed to fetch'))", "The server does not answer; try again"),
        ("Promise.resolve(new Response('<html>', {status: 502}))", "The server answered 502; try again"),
    ):
        page.press(*place_of(page, 60, 70))
        told(page, "as archived")
        page.wait_for(f"{rows} === 2 && document.querySelector('#chart svg')")
        page.run(f"window.asking = fetch; window.fetch = () => {unanswered}")
        page.press(*place_of(page, 61, 70))
        told(page, words)
        assert page.run(f"{rows} + document.querySelectorAll('#chart svg').length") == 0
        page.run("window.fetch = window.asking")


def test_what_could_not_be_fetched_is_asked_for_again(page: Browser) -> None:
    page.run("window.asking = fetch; window.fetch = () => Promise.reject(new TypeError('Failed to fetch'))")
    choose(page, "place")
    page.press(*place_of(page, 60, 70))
    told(page, "The server does not answer")
    select(page, "strain yy")
    page.wait_for(f"{MAP}.querySelector('.readout').textContent.includes('does not answer')")
    page.run("window.fetch = window.asking; new Promise(done => setTimeout(done, 1500))")
    page.complaints.clear()  # what the pointer passes is not read, either
    select(page, "strain xx")
    select(page, "strain yy")
    page.point(*place_of(page, 61, 70))
    assert readout(page, 61, 70).startswith("strain yy")
    page.press(*place_of(page, 60, 70))
    told(page, "pixels of C1P1")


def test_what_is_enlarged_is_shown_pixel_by_pixel(page: Browser, served: Served) -> None:
    size, every = 1500, 3  # 640 samples at most
    row, column = np.mgrid[0:size, 0:size].astype(np.float64)
    strain = 1e-6 * np.stack([row, column, row + column])
    sigma, reason = np.full((3, size, size), 1e-8, np.float32), np.zeros((size, size), np.uint32)
    field = StrainField("small", "mm", 20.0, strain, sigma, strain[:2].copy(), strain[0].copy(), reason)
    with bootstrap.services(served.home) as services:
        number = stored(services, "strain", "plate/S02/C1P2", {"strain": field})
    show(page, f"{served.address}/field/{number}")
    page.run(f"{MAP}.querySelector('canvas').focus()")
    for _ in range(4):
        page.key("+", "+")
    x, y, width, height = page.run(
        f"(() => {{ const b = {MAP}.querySelector('canvas').getBoundingClientRect();"
        " return [b.x, b.y, b.width, b.height]; })()"
    )
    found = None
    for step in range(200):
        page.point(x + width / 2 + step % 20, y + height / 2)
        words = page.run(f"{MAP}.querySelector('.readout').textContent")
        found = re.match(r"strain xx: (\S+) ± \S+ µε at x (\d+), y (\d+) px", words)
        if found and int(found[2]) % every != every // 2:
            break
    assert found
    assert int(found[2]) % every != every // 2, "the window did not come"
    assert float(found[1]) == pytest.approx(int(found[3]), abs=0.01)


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_it_is_light_or_dark_and_fits_a_tablet(page: Browser, theme: str) -> None:
    page.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": theme}])
    page.screen(820, 1180)
    colour = page.run("getComputedStyle(document.body).backgroundColor")
    assert (max(map(int, re.findall(r"\d+", colour))) < 60) == (theme == "dark")
    assert page.run("document.documentElement.scrollWidth") <= 820
