"""The numbers that the thesis publishes of what it measured in sections 4.6 to 7.3, and ours beside them.

Counted are results: what was set (loads, sizes, numbers of fringes) is none, and a number that is printed
twice is one. Of those that nothing here can give, the reason is told.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import isnan
from typing import Literal, TypeAlias

from sms_jobs.virtual_rig.wing_campaigns import TABLE_5

Sense: TypeAlias = Literal["at most", "at least", "near"]


@dataclass(frozen=True)
class Published:
    """One number of the thesis.

    Attributes
    ----------
    place
        Figure or section.
    what
        What it is a number of, with its unit.
    value
        As it is printed; None where it has not survived in the text at hand.
    sense
        An error is as good when it is at most as large; "near" is a property of the specimen, which ours has
        for itself.
    study
        Which one gives ours; empty where none does, for the reason `why_not`.
    tolerance
        By how much what is near may be off what is exactly true: the error that the thesis states for it.
    """

    place: str
    what: str
    value: float | None
    sense: Sense = "at most"
    study: str = ""
    why_not: str = ""
    tolerance: float = 0.0

    @property
    def chapter(self) -> int:
        """The chapter that it stands in."""
        kind, number = self.place.split()[:2]
        if kind == "section":
            return int(number.split(".")[0])
        first_of_chapter = {"Fig.": (46, 54, 74, 90), "Table": (4, 4, 5, 6)}[kind]
        return max(c for c, first in enumerate(first_of_chapter, start=4) if int(number) >= first)


@dataclass(frozen=True)
class Judged:
    """What we get for a number of the thesis.

    Attributes
    ----------
    key
        Of `PUBLISHED`.
    measured
        NaN where nothing was.
    exact
        What is true of the virtual specimen, None of an error.
    sigma
        Standard deviation that is stated of it, None where nothing is.
    """

    key: str
    measured: float
    exact: float | None = None
    sigma: float | None = None

    @property
    def published(self) -> Published:
        """The number of the thesis."""
        return PUBLISHED[self.key]

    @property
    def z(self) -> float | None:
        """The error in units of its standard deviation; None where one of them is not known."""
        if self.exact is None or not self.sigma:
            return None
        return (self.measured - self.exact) / self.sigma

    @property
    def verdict(self) -> str:
        """Whether it is as good as the thesis's: 'met', 'missed', or 'not measured'."""
        if isnan(self.measured):
            return "not measured"
        about = self.published
        if about.sense == "near":
            assert self.exact is not None
            met = abs(self.measured - self.exact) <= about.tolerance
        else:
            assert about.value is not None
            met = self.measured <= about.value if about.sense == "at most" else self.measured >= about.value
        return "met" if met else "missed"

    def row(self) -> tuple[str, str, float | None, float | None, float, float | None, str]:
        """Return place, what, the thesis's number, the exact one, ours, z and verdict."""
        about = self.published
        number = about.value
        return (about.place, about.what, number, self.exact, self.measured, self.z, self.verdict)


COLUMNS = ("thesis", "of what", "thesis says", "exact", "measured", "z", "verdict")
"""Of `Judged.row`."""

_CALIBRATED = "the campaigns are measured with the exact calibration; 'sms bench calibration' calibrates"
_NOT_AT_HAND = "the columns of this gauge are shuffled in the text at hand"
_REAL_PART = "a real part, of which there is no model"


def _rigid_motion() -> Iterator[tuple[str, Published]]:
    def of(
        place: str, what: str, value: float, sense: Sense = "at most", tolerance: float = 0.0
    ) -> Published:
        return Published(place, what, value, sense, "rigid-motion", tolerance=tolerance)

    yield "motion-regions", of("Fig. 49", "continuous regions of the plate", 2.0, "near")
    yield "motion-between", of("Fig. 51", "displacement of base and step, difference at 10.16 mm, mm", 0.05)
    yield "motion-largest", of("Fig. 53", "mean displacement, largest error, mm", 0.1)
    yield "motion-scatter", of("Fig. 53", "displacement, largest standard deviation, mm", 0.15)
    yield "motion-resolution", of("Fig. 53", "displacement, mean standard deviation, mm", 0.03)
    yield (
        "motion-points",
        Published(
            "Fig. 50", "points of the reference", 797_224.0, why_not="follows from how much of the image the "
            "specimen fills, which is not told",
        ),
    )  # fmt: skip
    for way, width in (("regions", 1.0), ("plain", 20.0)):
        yield (
            f"motion-edge-{way}",
            Published("Fig. 52", f"edge, {way}, px", width, why_not="'sms study edges' has another measure"),
        )


def _top_hat() -> Iterator[tuple[str, Published]]:
    def of(
        place: str, what: str, value: float, sense: Sense = "at most", tolerance: float = 0.0
    ) -> Published:
        return Published(place, what, value, sense, "top-hat", tolerance=tolerance)

    yield "hat-maximum", of("Fig. 63", "largest displacement at 5 mm, mm", 5.0, "near", 0.13)
    yield "hat-pairs", of("Fig. 65", "displacement, pairs of one camera, rms difference at 5 mm, mm", 0.1)
    yield "hat-pairs-shape", of("Fig. 65", "coordinates, pairs of one camera, rms difference, mm", 0.1)
    yield "hat-point-least", of("Fig. 69", "loaded point, all pairs, least error, mm", 0.02)
    yield "hat-point-largest", of("Fig. 69", "loaded point, all pairs, largest error, mm", 0.13)
    yield "hat-point-rms", of("Fig. 69", "loaded point, all pairs, rms error of ten states, mm", 0.07)
    yield "hat-point-apart", of("Fig. 69", "loaded point, C1P1 less C2P2, rms of ten states, mm", 0.07)
    yield "hat-stereo-first", of("Fig. 73", "two cameras less fringes, good data, rms at 1 mm, mm", 0.05)
    yield "hat-stereo-last", of("Fig. 73", "two cameras less fringes, good data, rms at 10 mm, mm", 0.5)
    yield "hat-calibration", Published("section 5.3.1", "calibration, rms, mm", 0.08, why_not=_CALIBRATED)
    yield (
        "hat-time",
        Published("section 5.4.2", "displacement of all pixels, s", 600.0, why_not="see docs/performance.md"),
    )


def _wing_panel() -> Iterator[tuple[str, Published]]:
    for load_n, *strains in TABLE_5:
        for gauge, strain in enumerate(strains, start=1):
            yield (
                f"wing-{load_n / 1e3:g}-{gauge}",
                Published(
                    "Table 5", f"gauge {gauge} at {load_n / 1e3:g} kN, microstrain", 1e6 * strain, "near",
                    "wing-panel", tolerance=100.0,
                ),
            )  # fmt: skip
        for component in ("xx", "yy", "xy"):
            yield (
                f"wing-{load_n / 1e3:g}-3-{component}",
                Published(
                    "Table 5", f"gauge 3, {component}, at {load_n / 1e3:g} kN", None, why_not=_NOT_AT_HAND
                ),
            )
    for what in ("1 xx", "2 xx", "3 xx", "3 yy", "3 xy"):
        yield (
            f"wing-0-{what}",
            Published("Table 5", f"gauge {what} at 0 kN", None, why_not="the gauges' own zero"),
        )
    yield (
        "wing-largest",
        Published("Fig. 81", "strain less gauges, largest, microstrain", 100.0, study="wing-panel"),
    )
    yield (
        "wing-offset",
        Published("Fig. 81", "strain less gauges, mean, microstrain", 50.0, study="wing-panel"),
    )
    yield (
        "wing-points",
        Published("Fig. 77", "points of three views", 3e6, why_not="follows from the number of pixels"),
    )
    yield "wing-calibration", Published("section 6.2.2", "calibration, rms, mm", 0.035, why_not=_CALIBRATED)


def _buckling() -> Iterator[tuple[str, Published]]:
    yield (
        "buckling-regions",
        Published("Fig. 86", "continuous regions of the view", 19.0, "near", "buckling-panel", tolerance=0.0),
    )
    yield (
        "buckling-calibration",
        Published("section 6.3.2", "calibration, rms, mm", 0.03, why_not=_CALIBRATED),
    )


def _ranging() -> Iterator[tuple[str, Published]]:
    def of(what: str, value: float, sense: Sense = "at most") -> Published:
        return Published("Fig. 111", what, value, sense, "plate-mirror")

    for method in ("unwrapping", "original", "improved"):
        for what in ("mean", "standard deviation", "time"):
            yield (
                f"table-6-{method}-{what}",
                Published("Table 6", f"{method}, {what}", None, why_not="lost in the text at hand"),
            )
    yield "plate-once", of("lit once, ranging, rms off the plane, mm", 0.405)
    yield "plate-once-unwrapped", of("lit once, unwrapping, rms off the plane, mm", 0.417)
    yield "plate-twice", of("lit twice, ranging, rms off the plane, mm", 0.538)
    yield "plate-twice-unwrapped", of("lit twice, unwrapping, rms off the plane, mm", 2.726)
    yield "plate-better", of("lit twice, unwrapping over ranging", 5.0, "at least")
    for number, k in enumerate((6.90, 3.45), start=1):
        yield (
            f"peak-{number}",
            Published("Fig. 96", f"two returns, s = 32, peak {number}, bins", k, "near", "plate-mirror",
                      tolerance=0.005),
        )  # fmt: skip
    yield (
        "plate-amplitudes",
        Published(
            "Fig. 105", "stronger over weaker return", 2.0, why_not="follows from the mirror, not told"
        ),
    )
    yield "plate-calibration", Published("section 7.3.1", "calibration, rms, mm", 0.06, why_not=_CALIBRATED)
    yield "rib", Published("Fig. 114", "wing rib, part measured", 0.75, why_not=_REAL_PART)


_ALL: tuple[Callable[[], Iterator[tuple[str, Published]]], ...] = (
    _rigid_motion, _top_hat, _wing_panel, _buckling, _ranging
)  # fmt: skip

PUBLISHED: dict[str, Published] = {key: one for each in _ALL for key, one in each()}
"""Every number by its key, in the order of the thesis."""


def in_chapters(first: int, last: int) -> list[Published]:
    """Return the published numbers of some chapters."""
    return [one for one in PUBLISHED.values() if first <= one.chapter <= last]
