"""The report of many states in a real browser: its values are the archive's, and it unpacks what is shown."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.browser import Browser, browser_or_skip
from support.report_results import campaign, records_for, run_on_results

from sms_jobs.formats.drawing.assets import drawing_script
from sms_jobs.formats.report.surface import MICROSTRAIN
from sms_jobs.kinds.kind import Port
from sms_jobs.kinds.products import MERGED
from sms_jobs.kinds.reporting import report
from sms_jobs.records.fields import MergedField, StrainField
from sms_jobs.records.subject import Subject

EVIL = "</script><img src=x onerror=\"document.title='broken into'\">"
STATES = 40
SIZE = (45, 60)
CHOSEN = "document.querySelector('.state.chosen')"
SPY = """window.looked = []; const real = document.getElementById;
document.getElementById = function (id) { window.looked.push(id); return real.call(document, id); };"""


@pytest.fixture(scope="module")
def started(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """A browser for all tests of this file, which notes what blocks of a page are read."""
    with Browser(browser_or_skip(), tmp_path_factory.mktemp("profile")) as browser:
        browser.call("Page.addScriptToEvaluateOnNewDocument", source=SPY)
        yield browser


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the report of a long test, whose specimen has an evil material."""
    folder = tmp_path_factory.mktemp("long")
    of = campaign(STATES + 1, virtual=False, material=EVIL)
    run_on_results(folder, report.KIND, of, Subject("plate"), most_states=1, figure_width_px=240)
    return folder


@pytest.fixture
def page(started: Browser, folder: Path) -> Iterator[Browser]:
    """The long report, at the maps of its last state."""
    started.screen(1280, 900)
    started.open(folder / "plate-report.html")
    started.run("document.querySelector('.steps').scrollIntoView()")
    drawn(started)
    yield started
    assert started.complaints == []


def drawn(page: Browser) -> None:
    page.wait_for(f"{CHOSEN}.querySelector('.readout')?.textContent.length > 9")


def looked_at(page: Browser) -> set[str]:
    """Return the states whose blocks have been read since this was asked last."""
    told = page.run(
        "window.looked.splice(0).map((id) => document.querySelector(`[id='${id}']`).closest('.state')?.id)"
    )
    return {one for one in told if one}


def chosen(page: Browser) -> str:
    return str(page.run(f"{CHOSEN}.id"))


def test_a_state_is_unpacked_when_it_is_shown_and_not_before(page: Browser) -> None:
    last = f"state-S{STATES}"
    # Two blocks, a field and its deviations; of the positions nobody has asked.
    assert looked_at(page) == {last}
    assert page.run("[...document.querySelectorAll('.state')].filter((s) => s.offsetHeight).length") == 1
    page.click("[aria-label='state before']")
    drawn(page)
    assert looked_at(page) == {f"state-S{STATES - 1}"}
    # Nothing was kept of the last.
    page.click("[aria-label='state after']")
    drawn(page)
    page.wait_for("window.looked.length > 0")
    assert looked_at(page) == {last}


def test_a_point_is_followed_over_states_that_are_not_shown(page: Browser) -> None:
    page.click(".state.chosen canvas")
    page.wait_for(f"{CHOSEN}.querySelectorAll('.followed svg circle').length === {STATES}")
    assert looked_at(page) == {f"state-S{place:02}" for place in range(1, STATES + 1)}
    # Few enough to be read.
    labels = (
        f"[...{CHOSEN}.querySelectorAll('.followed svg > text')].filter((t) => /^S\\d+$/.test(t.textContent))"
    )
    assert page.run(f"{labels}.length") <= 12


def test_steps_keep_the_field_and_go_by_keyboard_and_link(page: Browser) -> None:
    page.run(
        f"(() => {{ const s = {CHOSEN}.querySelector('select');"
        " s.value = [...s.options].find((o) => o.text.startsWith('strain xx')).value;"
        " s.dispatchEvent(new Event('change')); })()"
    )
    page.run("document.querySelector('.steps input').focus()")
    page.call("Input.dispatchKeyEvent", type="keyDown", key="ArrowLeft", windowsVirtualKeyCode=37)
    page.call("Input.dispatchKeyEvent", type="keyUp", key="ArrowLeft", windowsVirtualKeyCode=37)
    page.wait_for(f"{CHOSEN}.id === 'state-S{STATES - 1}'")
    drawn(page)
    assert "strain xx" in page.run(f"{CHOSEN}.querySelector('.live select').selectedOptions[0].text")
    page.click("a[href='#state-S07']")
    page.wait_for(f"{CHOSEN}.id === 'state-S07'")
    assert (
        page.run("document.querySelector('.state-choice').selectedOptions[0].text") == "State S07, 8641.5 N"
    )


def test_only_what_has_pictures_is_printed(page: Browser) -> None:
    page.call("Emulation.setEmulatedMedia", media="print")
    shown = page.run(
        "[...document.querySelectorAll('.state')].filter((s) => s.offsetHeight).map((s) => s.id)"
    )
    page.call("Emulation.setEmulatedMedia", media="")
    assert shown == [f"state-S{STATES}"]


def test_what_people_wrote_is_words_in_a_long_report_too(page: Browser) -> None:
    assert page.run("document.title") == "Campaign plate"
    assert page.run("document.querySelectorAll('img[onerror], [src=x]').length") == 0
    assert page.run("[...document.querySelectorAll('td')].some((c) => c.textContent.includes('onerror'))")
    handlers = "[...e.attributes].some((a) => a.name.startsWith('on'))"
    assert not page.run(f"[...document.querySelectorAll('*')].some((e) => {handlers})")


def test_values_are_those_of_the_archive_within_the_step_that_is_told(
    started: Browser, tmp_path: Path, rng: np.random.Generator
) -> None:
    """Read every field of two states with the page's own script, and compare each sample."""
    merged, strain = _noisy(rng)
    of = campaign(2, virtual=False)
    instead = {MERGED.of("C1").stored_as: merged, "strain": strain}
    run_on_results(tmp_path, report.KIND, of, Subject("plate"), instead=instead, map_px=64)
    started.open(tmp_path / "plate-report.html")
    script = (tmp_path / "plate-report.html").read_text(encoding="utf-8")
    assert drawing_script() in script
    found = started.run(
        f"(async () => {{ {drawing_script()}\n"
        "const shown = JSON.parse(document.querySelector('#state-S01 script.about').textContent);"
        "const fields = new Fields(shown, EMBEDDED), told = {};"
        "for (const f of shown.fields) told[f.name] = { step: f.step, within: f.within ?? null,"
        " values: Array.from(await fields.values(f)), sigma: f.sigma && Array.from(await fields.sigma(f)) };"
        "return told; })()"
    )
    expected = _expected(merged, strain)
    assert set(expected) <= set(found)
    for name, (values, sigma) in expected.items():
        told = np.array(found[name]["values"], np.float64).reshape(SIZE)
        assert np.array_equal(np.isnan(told), np.isnan(values)), name
        # Half a step, and the rounding of the values to single precision before they are packed.
        rounding = 2.0**-24 * np.nanmax(np.abs(values))
        assert np.nanmax(np.abs(told - values)) <= 0.5 * found[name]["step"] * (1.0 + 1e-6) + rounding, name
        if sigma is not None:
            assert found[name]["step"] <= float(np.nanmedian(sigma)) / 10.0, name
            of_sigma = np.array(found[name]["sigma"], np.float64).reshape(SIZE)
            # Half a step of 8 % of the logarithm.
            np.testing.assert_allclose(of_sigma, sigma, rtol=float(np.expm1(0.04)) + 1e-5)
    assert found["position X"]["within"] == "displacement"


def _noisy(rng: np.random.Generator) -> tuple[MergedField, StrainField]:
    """Return a displacement with noise that has no value in some pixels of the surface, and such a strain."""
    subject = Subject("plate", "S01", "C1P1")
    of_state = Port("", "merge", ()).of(replace(subject, view=None))
    merged = records_for(of_state, SIZE)[MERGED.of("C1").stored_as]
    strain = records_for(Port("", "strain", ()).of(subject), SIZE)["strain"]
    lost = np.where(rng.random(SIZE) < 0.1, np.nan, 1.0)
    spread = (1e-4 * np.exp(0.5 * rng.standard_normal(SIZE)) * lost).astype(np.float32)
    covariance = np.zeros((6, *SIZE), np.float32)
    covariance[[0, 3, 5]] = spread
    hole = np.where(np.isfinite(merged.displacement), 1.0, np.nan) * lost
    moved = merged.displacement + 0.01 * rng.standard_normal((3, *SIZE))
    return (
        replace(merged, displacement=moved * lost, position=merged.position * hole, covariance=covariance),
        replace(strain, strain=(strain.strain + 3e-5 * rng.standard_normal((3, *SIZE))) * lost),
    )


def _expected(merged: MergedField, strain: StrainField) -> dict[str, tuple[np.ndarray, Any]]:
    """Return the values and the deviations of what the page shows of the state, by name."""
    deviations = np.sqrt(merged.covariance[[0, 3, 5]].astype(np.float64))
    found: dict[str, tuple[np.ndarray, Any]] = {
        f"displacement {axis}": (merged.displacement[k], deviations[k]) for k, axis in enumerate("XYZ")
    }
    found["displacement"] = (np.linalg.norm(merged.displacement, axis=0), None)
    found |= {f"position {axis}": (merged.position[k], None) for k, axis in enumerate("XYZ")}
    for k, name in enumerate(("xx", "yy", "xy")):
        found[f"strain {name}"] = (MICROSTRAIN * strain.strain[k], MICROSTRAIN * strain.sigma[k])
    found["von Mises strain"] = (MICROSTRAIN * strain.von_mises, None)
    return found
