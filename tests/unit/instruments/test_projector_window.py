"""What a projector's window shows, read from the memory of an X server: every pixel of it."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from math import pi
from pathlib import Path

import numpy as np
import pytest
from support.display import COLUMNS, ROWS, Display, display

from sms_jobs.errors import ConfigurationError, DeviceFault, InvalidInput, LinkLost
from sms_jobs.instruments.clock import SimulatedClock
from sms_jobs.instruments.optical_drivers import DriverContext
from sms_jobs.instruments.pictures import grey_levels
from sms_jobs.instruments.projectors.window import WindowProjector, WindowSettings, connect
from sms_jobs.records.measurement import FringeSequence

SETTINGS = WindowSettings("P1", COLUMNS, ROWS, "window")
SEQUENCE = FringeSequence((7, 3), 4, (0.0, pi / 2, 0.3))


@pytest.fixture(scope="module")
def hidden(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Display]:
    with display(tmp_path_factory.mktemp("screen")) as started:
        yield started


@pytest.fixture
def context(hidden: Display, monkeypatch: pytest.MonkeyPatch) -> Iterator[DriverContext]:
    monkeypatch.setenv("DISPLAY", hidden.name)
    monkeypatch.setenv("SDL_VIDEODRIVER", "x11")
    with ExitStack() as ending:
        yield DriverContext(SimulatedClock(), ending)


@pytest.fixture
def projector(context: DriverContext) -> WindowProjector:
    return connect(SETTINGS, context)


def test_every_pattern_is_shown_pixel_for_pixel(projector: WindowProjector, hidden: Display) -> None:
    projector.load(SEQUENCE)
    for number, (orientation, density, step) in enumerate(SEQUENCE.patterns()):
        projector.show(number)
        seen = hidden.grab()
        # docs/conventions.md: the phase is 0 in the middle of the image.
        along, down = np.arange(COLUMNS) + 0.5 - COLUMNS / 2, (np.arange(ROWS) + 0.5 - ROWS / 2)[:, None]
        span = COLUMNS * np.cos(orientation) + ROWS * np.sin(orientation)
        turns = density * (along * np.cos(orientation) + down * np.sin(orientation)) / span
        wanted = 127.5 * (1.0 + np.cos(2.0 * pi * (turns + step / SEQUENCE.steps)))
        # Levels are whole: half of one off, and the last digits of two ways to write a cosine.
        assert np.abs(seen - wanted[:, :, None]).max() <= 0.5 + 1e-9
    assert len(np.unique(seen)) > 10  # a fringe, and no uniform field


def test_random_pictures_arrive_unchanged(
    projector: WindowProjector, hidden: Display, rng: np.random.Generator
) -> None:
    # Whatever filters or scales would smooth neighbours that have nothing to do with each other.
    for _ in range(3):
        levels = rng.integers(0, 256, (ROWS, COLUMNS), dtype=np.uint8)
        projector.screen.show(levels)
        np.testing.assert_array_equal(hidden.grab(), np.repeat(levels[:, :, None], 3, axis=2))


def test_white_dark_and_the_first_picture(context: DriverContext, hidden: Display) -> None:
    projector = connect(SETTINGS, context)
    assert (hidden.grab() == 0).all()
    projector.white()
    assert (hidden.grab() == 255).all()
    projector.dark()
    assert (hidden.grab() == 0).all()


def test_a_dimmed_projector_shows_so_much_less_of_every_pattern_and_of_white(
    projector: WindowProjector, hidden: Display
) -> None:
    dimming = np.linspace(0.2, 1.0, ROWS * COLUMNS, dtype=np.float32).reshape(ROWS, COLUMNS)
    shown = []
    for factor in (None, dimming):
        projector.load(SEQUENCE, factor)
        pictures = []
        for number in range(SEQUENCE.frames):
            projector.show(number)
            pictures.append(hidden.grab()[..., 0].astype(float))
        projector.white()
        shown.append([*pictures, hidden.grab()[..., 0].astype(float)])
    for plain, dimmed in zip(*shown, strict=True):
        # Both are rounded to whole levels.
        assert np.abs(dimmed - dimming * plain).max() <= 1.0
    projector.load(SEQUENCE)
    projector.white()
    assert (hidden.grab() == 255).all()


def test_a_picture_is_on_when_it_has_settled(context: DriverContext) -> None:
    projector = connect(replace(SETTINGS, settle_ms=250.0), context)
    begun = context.clock.monotonic()
    projector.load(SEQUENCE)
    projector.show(0)
    projector.white()
    assert context.clock.monotonic() == pytest.approx(begun + 0.5)


def test_a_response_is_compensated() -> None:
    wanted = np.linspace(0.0, 1.0, 1001)
    for gamma in (0.5, 1.0, 2.2):
        shown = (grey_levels(wanted, gamma) / 255.0) ** gamma
        # Half a level, by the steepest slope of the response: gamma at full brightness, and below one the
        # first level's own brightness.
        assert np.abs(shown - wanted).max() <= max(0.5 / 255.0 * gamma, (0.5 / 255.0) ** gamma)


def test_projectors_behind_a_splitter_share_a_display(context: DriverContext, hidden: Display) -> None:
    first, second = connect(SETTINGS, context), connect(replace(SETTINGS, name="P2"), context)
    assert first.screen is second.screen
    second.white()
    assert (hidden.grab() == 255).all()


def test_it_says_where_it_is(projector: WindowProjector) -> None:
    assert projector.describe() == f"display 0, {COLUMNS} x {ROWS} pixels, SDL driver x11"


def test_a_display_is_opened_again_and_again(hidden: Display, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DISPLAY", hidden.name)
    monkeypatch.setenv("SDL_VIDEODRIVER", "x11")
    for _ in range(3):
        with ExitStack() as ending:
            connect(SETTINGS, DriverContext(SimulatedClock(), ending)).white()
            assert (hidden.grab() == 255).all()
        assert not (hidden.grab() == 255).all()


def test_a_display_of_another_size_is_refused(context: DriverContext) -> None:
    with pytest.raises(DeviceFault, match=r"display 0 has 320 x 200 pixels, projector P1 1920 x 1080: set"):
        connect(replace(SETTINGS, columns=1920, rows=1080), context)


def test_a_display_that_is_not_there(context: DriverContext) -> None:
    with pytest.raises(LinkLost, match="there is no display 3, but 1, counted from 0; connect the projector"):
        connect(replace(SETTINGS, display=3), context)


def test_a_window_that_was_closed_is_told(projector: WindowProjector) -> None:
    import pygame

    projector.load(SEQUENCE)
    pygame.event.post(pygame.event.Event(pygame.WINDOWCLOSE))
    with pytest.raises(DeviceFault, match="window on display 0 was closed or minimised"):
        projector.show(0)


@pytest.mark.parametrize("wanted", [None, "x11"])
def test_without_a_display_nothing_is_projected_into_the_void(
    wanted: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Left to itself SDL would draw into memory, or ask a terminal's graphics card.
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER"):
        monkeypatch.delenv(name, raising=False)
    if wanted is not None:
        monkeypatch.setenv("SDL_VIDEODRIVER", wanted)
    with ExitStack() as ending, pytest.raises(LinkLost, match="this process sees no display to project on"):
        connect(SETTINGS, DriverContext(SimulatedClock(), ending))


def test_without_the_package_its_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pygame", None)
    with (
        ExitStack() as ending,
        pytest.raises(ConfigurationError, match=r"pip install 'sms-jobs\[projector\]'"),
    ):
        connect(SETTINGS, DriverContext(SimulatedClock(), ending))


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="signal masks are read from /proc")
def test_a_job_that_projects_can_still_be_terminated(context: DriverContext) -> None:
    # What ran in this process before may have left a handler; a job's process has none.
    before = signal.signal(signal.SIGTERM, signal.SIG_DFL)
    try:
        connect(SETTINGS, context).white()
        status = Path("/proc/self/status").read_text(encoding="ascii")
        caught = int(status.partition("SigCgt:")[2].split()[0], 16)
        assert not caught >> 14 & 1  # SIGTERM, number 15, has its own effect
    finally:
        signal.signal(signal.SIGTERM, before)


def test_where_there_is_no_x_server_pixels_are_read_back(
    monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator
) -> None:
    # SDL's own display in memory, asked for by name; it has this size.
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    columns, rows = 1024, 768
    with ExitStack() as ending:
        context = DriverContext(SimulatedClock(), ending)
        projector = connect(replace(SETTINGS, columns=columns, rows=rows), context)
        levels = rng.integers(0, 256, (rows, columns), dtype=np.uint8)
        projector.screen.show(levels)
        np.testing.assert_array_equal(projector.screen.drawn(), np.repeat(levels[:, :, None], 3, axis=2))


@pytest.mark.parametrize("wrong", [{"display": -1}, {"settle_ms": -5.0}, {"gamma": 0.0}, {"columns": 0}])
def test_settings_that_cannot_be(wrong: dict[str, float]) -> None:
    with pytest.raises(InvalidInput, match="P1"):
        replace(SETTINGS, **wrong)
