"""A projector that is a display of this computer: a window that fills it, pixel for pixel.

Pictures are drawn by SDL 2 (package pygame-ce) at their own size, without filter, and handed over with
the display's refresh. When it is opened, a window draws every grey level and reads it back, so that a
graphics driver that alters them is found before anything is measured.
"""

from __future__ import annotations

import os
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import DeviceFault, InvalidInput, LinkLost
from sms_jobs.instruments.clock import Clock
from sms_jobs.instruments.optical_drivers import DriverContext, ProjectorDriver, optional_package
from sms_jobs.instruments.pictures import Levels, grey_levels, pattern_brightness
from sms_jobs.records.measurement import FringeSequence
from sms_jobs.records.optical_instruments import ProjectorInstrument

_KEPT = 128
"""Pictures of the present sequence that are kept, for the next exposure and the next state."""
_CENTRED_ON = 0x2FFF0000
"""SDL's word for the middle of a display, to which the display's number is added."""
_UNSEEN = ("dummy", "offscreen")
"""Drivers of SDL that it falls back to where there is no display."""
_HINTS = {
    "PYGAME_HIDE_SUPPORT_PROMPT": "1",
    "SDL_NO_SIGNAL_HANDLERS": "1",  # a job must still hear that it is to end
    "SDL_VIDEO_MINIMIZE_ON_FOCUS_LOSS": "0",
    "SDL_WINDOWS_DPI_AWARENESS": "permonitorv2",
    "SDL_RENDER_SCALE_QUALITY": "nearest",
}


@dataclass(frozen=True)
class WindowSettings(ProjectorInstrument):
    """A projector on a display of this computer.

    Attributes
    ----------
    display
        Number of the display, from 0 as the system counts them. Projectors behind one video splitter
        have the same.
    settle_ms
        After a picture was handed to the display, until it is light: two refreshes and the projector's own
        delay.
    gamma
        Exponent of the projector's response, which is compensated: brightness = (level / 255)^gamma; 1 shows
        levels that are proportional to the requested brightness.
    """

    driver: Literal["window"]
    display: int = 0
    settle_ms: float = 100.0
    gamma: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.display < 0 or not 0.0 <= self.settle_ms <= 60e3 or not 0.1 <= self.gamma <= 10.0:
            raise InvalidInput(
                f"projector {self.name} is on display {self.display}, settles in {self.settle_ms} ms and has "
                f"a gamma of {self.gamma}: displays count from 0, it may take up to 60000 ms, and gamma is "
                "from 0.1 to 10"
            )


class Screen:
    """A display that is filled by one window.

    Parameters
    ----------
    pygame
        The package.
    number
        Of the display.

    Raises
    ------
    LinkLost
        When there is no such display.
    DeviceFault
        When what it draws is not what it was given.
    """

    def __init__(self, pygame: Any, number: int) -> None:
        from pygame._sdl2 import video

        sizes = pygame.display.get_desktop_sizes()
        if number >= len(sizes):
            raise LinkLost(
                f"there is no display {number}, but {len(sizes)}, counted from 0; connect the projector, "
                "switch it on, and extend the desktop to it"
            )
        self._pygame = pygame
        self.number = number
        self.size: tuple[int, int] = sizes[number]
        try:
            self._window = pygame.Window(
                "fringes", self.size, _CENTRED_ON | number, fullscreen_desktop=True, always_on_top=True
            )
            self._renderer = video.Renderer(self._window, vsync=True)
            self._surface = pygame.Surface(self.size, depth=32)
            self._texture = video.Texture(self._renderer, self.size, depth=32, streaming=True)
        except pygame.error as error:
            raise LinkLost(f"no window can be opened on display {number}: {error}") from error
        pygame.mouse.set_visible(False)
        self._check()
        self.show(np.zeros(self.size[::-1], np.uint8))

    def show(self, levels: Levels) -> None:
        """Show a picture, (rows, columns), and return when it was handed to the display.

        Raises
        ------
        DeviceFault
            When somebody closed or minimised the window.
        """
        pygame = self._pygame
        for event in pygame.event.get():
            if event.type in (pygame.QUIT, pygame.WINDOWCLOSE, pygame.WINDOWMINIMIZED):
                raise DeviceFault(
                    f"the window on display {self.number} was closed or minimised; leave it alone while it "
                    "projects"
                )
        self._draw(levels)
        # The second is not accepted before the display has taken the first.
        self._renderer.present()
        self._paint()
        self._renderer.present()

    def drawn(self) -> Levels:
        """Return what the graphics driver drew last, (rows, columns, red green blue)."""
        pixels: Levels = self._pygame.surfarray.array3d(self._renderer.to_surface()).transpose(1, 0, 2)
        return pixels

    def close(self) -> None:
        """Take the window away."""
        del self._texture, self._renderer  # before the window that they belong to
        with suppress(self._pygame.error):
            self._window.destroy()

    def _draw(self, levels: Levels) -> None:
        pixels = self._pygame.surfarray.pixels2d(self._surface)
        pixels[...] = (levels.astype(np.uint32) * 0x010101).T
        del pixels  # it locks the surface
        self._texture.update(self._surface)
        self._paint()

    def _paint(self) -> None:
        self._renderer.clear()
        self._texture.draw()

    def _check(self) -> None:
        """Draw every level everywhere in turns, and compare what the graphics driver made of it."""
        columns, rows = self.size
        levels = np.add.outer(np.arange(rows), 7 * np.arange(columns)).astype(np.uint8)
        self._draw(levels)
        drawn = self.drawn()
        if drawn.shape != (rows, columns, 3):
            raise DeviceFault(
                f"display {self.number} of {columns} x {rows} pixels is drawn with {drawn.shape[1]} x "
                f"{drawn.shape[0]}: switch scaling off in the system's display settings"
            )
        off = np.abs(drawn.astype(np.int16) - levels[:, :, None]).max()
        if off:
            raise DeviceFault(
                f"display {self.number} draws grey levels that are off by up to {off}: choose another "
                "renderer by SDL_RENDER_DRIVER=software in the environment"
            )


@dataclass
class WindowProjector:
    """A projector that shows what a display shows."""

    settings: WindowSettings
    screen: Screen
    clock: Clock
    about: str
    _sequence: FringeSequence = field(default_factory=FringeSequence)
    _dimming: NDArray[np.float32] | None = None
    _pictures: dict[int, Levels] = field(default_factory=dict)

    def describe(self) -> str:
        """Return on which display it is, and how it is drawn."""
        columns, rows = self.screen.size
        return f"display {self.screen.number}, {columns} x {rows} pixels, {self.about}"

    def load(self, sequence: FringeSequence, dimming: NDArray[np.float32] | None = None) -> None:
        """Make ready for the patterns of a sequence; its pictures are made once."""
        if sequence != self._sequence or dimming is not None or self._dimming is not None:
            self._sequence, self._dimming, self._pictures = sequence, dimming, {}
        for number in range(min(sequence.frames_per_exposure, _KEPT)):
            if number not in self._pictures:
                self._pictures[number] = self._picture(number)

    def show(self, number: int) -> None:
        """Show a pattern; it is on when this returns."""
        picture = self._pictures.get(number)
        self._show(self._picture(number) if picture is None else picture)

    def white(self) -> None:
        """Show full brightness, dimmed as the patterns are."""
        white = np.ones((self.settings.rows, self.settings.columns))
        self._show(grey_levels(self._dimmed(white), self.settings.gamma))

    def dark(self) -> None:
        """Show nothing."""
        self._show(np.zeros((self.settings.rows, self.settings.columns), np.uint8))

    def _show(self, levels: Levels) -> None:
        self.screen.show(levels)
        self.clock.sleep(self.settings.settle_ms / 1e3)

    def _dimmed(self, brightness: NDArray[np.float64]) -> NDArray[np.float64]:
        return brightness if self._dimming is None else brightness * self._dimming

    def _picture(self, number: int) -> Levels:
        columns, rows = self.settings.columns, self.settings.rows
        brightness = self._dimmed(pattern_brightness(self._sequence, number, columns, rows))
        levels: Levels = np.broadcast_to(grey_levels(brightness, self.settings.gamma), (rows, columns))
        return levels


def connect(projector: WindowSettings, context: DriverContext) -> WindowProjector:
    """Open the window of a projector, or share that of another on the same display.

    Raises
    ------
    ConfigurationError
        When pygame-ce is not installed.
    LinkLost
        When there is no display, or not that one.
    DeviceFault
        When the display has another size than the projector, or its pixels are not drawn as they are.
    """
    pygame = context.shared("sdl", lambda: _video(context))

    def make() -> Screen:
        screen = Screen(pygame, projector.display)
        context.ending.callback(screen.close)
        return screen

    screen = context.shared(("display", projector.display), make)
    if screen.size != (projector.columns, projector.rows):
        raise DeviceFault(
            f"display {projector.display} has {screen.size[0]} x {screen.size[1]} pixels, projector "
            f"{projector.name} {projector.columns} x {projector.rows}: set the display to the projector's "
            "own resolution, without scaling, or correct the rig file"
        )
    return WindowProjector(projector, screen, context.clock, f"SDL driver {pygame.display.get_driver()}")


def _video(context: DriverContext) -> Any:
    """Return the package that draws, with its video part open until the rig is let go."""
    for hint, value in _HINTS.items():
        os.environ.setdefault(hint, value)

    def load() -> Any:
        import pygame

        return pygame

    pygame: Any = optional_package(load, DRIVER.name, "projector")
    try:
        pygame.display.init()
    except pygame.error as error:
        raise LinkLost(f"{_NO_DISPLAY}: {error}") from error
    context.ending.callback(pygame.display.quit)
    chosen = pygame.display.get_driver()
    if chosen in _UNSEEN and os.environ.get("SDL_VIDEODRIVER") != chosen:
        raise LinkLost(_NO_DISPLAY)
    return pygame


_NO_DISPLAY = (
    "this process sees no display to project on: start it from the desktop's session, or give it its DISPLAY "
    "and XAUTHORITY"
)

DRIVER = ProjectorDriver("window", WindowSettings, connect)
