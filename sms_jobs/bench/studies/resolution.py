"""Noise against spatial resolution of subsets, on star images as those of the DIC Challenge 2.0."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sms_jobs.bench.correlated import star
from sms_jobs.bench.correlated.lone_camera import DEFORMED, correlated
from sms_jobs.bench.correlated.star import Star
from sms_jobs.bench.study import Cell, Outcome, Study, Table, new_figure
from sms_jobs.kinds.deformation.correlate_parameters import CorrelateParameters
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.deformation.fields.spatial_resolution import KEPT
from sms_jobs.metrology.images.texture_quality import examine_texture, match_sigma
from sms_jobs.records.fields import DisplacementField, ImageMatches

CHOICES = ((5, 1), (8, 1), (10, 1), (16, 1), (10, 2), (16, 2), (24, 2))
"""Radius in px and order of the subsets."""
_THREADS = 1
_STARS = 2
_COLUMNS = (
    "subset, px", "order",
    "match: noise, px", "match: stated, px", "bound, px",
    "match: resolution, px", "theory, px", "match: MEI, px^2", "theory: MEI, px^2",
    "field: noise, px", "field: resolution, px", "field: stated resolution, px", "field: MEI, px^2",
    "field: valid",
)  # fmt: skip


@dataclass(frozen=True)
class Curve:
    """What one choice leaves of the star.

    Attributes
    ----------
    noise
        RMS displacement of a still pair along the rows' direction, in px.
    periods, kept
        Of each column, in px, and what is left of the amplitude there.
    """

    noise: float
    periods: Floats
    kept: Floats

    @property
    def resolution(self) -> float:
        """The spatial resolution in px; NaN where the star does not show it."""
        return star.resolution(self.periods, self.kept)

    @property
    def mei(self) -> float:
        """The metrological efficiency indicator: noise times spatial resolution, in px^2; less is better."""
        return self.noise * self.resolution


@dataclass(frozen=True)
class Judged:
    """A choice of subsets on one star.

    Attributes
    ----------
    match, field
        At the matched points, and at every pixel, where matches are spread over their subsets.
    stated
        RMS standard deviation that those matches of the still pair state whose noise is told, in px.
    bound
        What the texture and its noise allow a shift of such a subset, in px.
    stated_resolution
        Of the field of the still pair, as its record says, in px.
    valid
        Part of the pixels that have a value at periods from the field's resolution to 1.5 times that.
    """

    match: Curve
    field: Curve
    stated: float
    bound: float
    stated_resolution: float
    valid: float


def judge(images: Star, parameters: CorrelateParameters) -> Judged:
    """Correlate a still pair and the star."""
    radius = parameters.subset_radius_px
    still, moved = (
        correlated(images.reference, image, star.NOISE, parameters, _THREADS).records["correlate", DEFORMED]
        for image in (images.still, images.deformed)
    )
    matches: list[Floats] = []
    fields: list[Floats] = []
    inner = np.s_[radius:-radius, radius:-radius]
    for records in (still, moved):
        found: ImageMatches = records["matches"]
        field: DisplacementField = records["displacement"]
        v = np.full((star.ROWS, star.COLUMNS), np.nan)
        known = found.reason == 0
        v[found.y[known].astype(int), found.x[known].astype(int)] = found.v[known]
        matches.append(v[inner])
        fields.append(np.where(field.reason == 0, field.image_displacement[1], np.nan)[inner])
    sigma = _of_whole_subsets(still["matches"], radius)
    texture = examine_texture(images.exact, 0.0, np.inf)
    field_curve = _curve(fields[0], fields[1], radius)
    near = np.abs(field_curve.periods / field_curve.resolution - 1.25) < 0.25
    return Judged(
        _curve(matches[0], matches[1], radius),
        field_curve,
        float(np.sqrt(np.mean(sigma**2))),
        match_sigma(replace(texture, noise=star.NOISE), radius),
        still["displacement"].resolution_px,
        float(np.isfinite(fields[1][:, near]).mean()),
    )


def _of_whole_subsets(found: ImageMatches, radius: int) -> Floats:
    """Return the deviations that matches state whose subsets no border of the image cuts, in px."""
    whole = (np.abs(found.y - star.MIDDLE) <= star.MIDDLE - radius) & (found.x >= radius)
    whole &= found.x < star.COLUMNS - radius
    sigma: Floats = found.sigma_v[whole & (found.reason == 0)].astype(np.float64)
    return sigma


def _curve(still: Floats, moved: Floats, radius: int) -> Curve:
    """Return noise and transfer from (rows, columns) of v, of which some rows and columns have values."""
    rows = np.flatnonzero(np.isfinite(moved).any(axis=1))
    columns = np.flatnonzero(np.isfinite(moved).any(axis=0))
    periods = star.period_at((columns + radius).astype(np.float64))
    kept = star.amplitudes(
        moved[np.ix_(rows, columns)], (rows + radius - star.MIDDLE).astype(np.float64), periods
    )
    return Curve(float(np.sqrt(np.nanmean(still**2))), periods, kept)


def _over_stars(values: Sequence[float]) -> float:
    return float(np.mean(values))


def _row(radius: int, order: int, found: Sequence[Judged]) -> tuple[Cell, ...]:
    side = 2 * radius + 1
    bound = _over_stars([one.bound for one in found]) * star.noise_gain(side, order)
    theory = star.expected_resolution(side, order)
    return (
        side, order,
        _over_stars([one.match.noise for one in found]), _over_stars([one.stated for one in found]), bound,
        _over_stars([one.match.resolution for one in found]), theory,
        _over_stars([one.match.mei for one in found]), bound * theory,
        _over_stars([one.field.noise for one in found]),
        _over_stars([one.field.resolution for one in found]),
        _over_stars([one.stated_resolution for one in found]),
        _over_stars([one.field.mei for one in found]),
        _over_stars([one.valid for one in found]),
    )  # fmt: skip


def run(say: Callable[[str], None]) -> Outcome:
    """Measure noise and resolution of every choice on stars of new seeds."""
    seeds = [int(s) % 1_000_000 for s in np.random.SeedSequence().generate_state(_STARS)]
    found: dict[tuple[int, int], list[Judged]] = {choice: [] for choice in CHOICES}
    for seed in seeds:
        say(f"rendering the star of seed {seed}")
        images = star.star(seed)
        for radius, order in CHOICES:
            say(f"matching with subsets of {2 * radius + 1} px, order {order}")
            parameters = CorrelateParameters(subset_radius_px=radius, shape_order=order)
            found[radius, order].append(judge(images, parameters))
    rows = [_row(radius, order, some) for (radius, order), some in found.items()]
    apart = max(
        abs(curves[0].resolution / curves[1].resolution - 1.0)
        for some in found.values()
        for curves in ([one.match for one in some], [one.field for one in some])
    )
    figure = new_figure(10.0, 4.4)
    kept, plane = figure.subplots(1, 2)
    for (radius, order), some in found.items():
        side, one = 2 * radius + 1, some[0].match
        (line,) = kept.plot(one.periods, one.kept, linewidth=0.8, label=f"{side} px, order {order}")
        kept.plot(one.periods, star.transfer(side, order, one.periods), ":", color=line.get_color())
        plane.loglog(
            [c.match.resolution for c in some], [c.match.noise for c in some], "o", color=line.get_color()
        )
        plane.loglog(
            [c.field.resolution for c in some], [c.field.noise for c in some], "x", color=line.get_color()
        )
    for order in sorted({order for _, order in CHOICES}):
        of_order = [row for row in rows if row[1] == order]
        plane.loglog([row[6] for row in of_order], [row[4] for row in of_order], "k:", linewidth=0.8)
    kept.axhline(KEPT, color="grey", linewidth=0.6)
    kept.set(xlabel="period [px]", ylabel="part of the amplitude", xlim=(10, 300), ylim=(0, 1.1))
    kept.set_title("measured; dotted: theory", fontsize="small")
    kept.legend(fontsize="x-small")
    plane.set(xlabel="spatial resolution [px]", ylabel="noise [px]")
    plane.set_title("o match, x field; dotted: bound and theory", fontsize="small")
    return Outcome(Table(_COLUMNS, rows, _remarks(seeds, apart)), figure)


def _remarks(seeds: Sequence[int], apart: float) -> dict[str, str]:
    return {
        "conditions": f"{_STARS} stars of {star.ROWS} x {star.COLUMNS} px, v = {star.AMPLITUDE_PX} px "
        f"cos(2 pi y / period), periods of {star.SHORTEST_PX:g} to {star.LONGEST_PX:g} px along the columns; "
        f"speckle of Gaussian blobs of 1.8 px, known at every real point, contrast {star.CONTRAST:g} and "
        f"noise {star.NOISE:g} grey levels, both images; seeds {', '.join(map(str, seeds))}; correlate with "
        "its defaults but for radius and order",
        "noise": "rms of v of a still pair, of what is valid and a radius from the border: of the matched "
        "points, and of every pixel; match: stated is the rms of what the same matches state",
        "resolution": f"period at which {KEPT:.0%} of the amplitude is left, the amplitude by least squares "
        "over the rows within one and a half periods of the middle; the stars' figures differ by at most "
        f"{apart:.1%}",
        "bound": "Cramer-Rao bound of a shift, sqrt(2) noise / sqrt(sum Iy^2), rms over subsets, times what "
        "the order adds at the centre where the texture is alike everywhere",
        "stated resolution": "what the record of the displacement says",
        "theory": "least squares of the shape function over the subset at its centre (Savitzky-Golay)",
        "MEI": "noise times spatial resolution, as in the DIC Challenge 2.0 (Reu et al. 2022); the less the "
        "better; its published curves are not at hand as numbers, so theory is what it is compared with",
    }


STUDY = Study(
    "resolution",
    "noise and spatial resolution of subsets on star images, beside theory",
    run,
)
