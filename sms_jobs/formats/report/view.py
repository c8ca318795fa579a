"""What a report shows of one camera at one state: fields over its image, and the numbers beside them.

A `View` knows nothing of the page. Whoever measures something new makes views of it, and has maps with zoom
and values, a turnable surface, still pictures for print, a table and charts over the states.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import ceil

import numpy as np
from numpy.typing import NDArray

from sms_jobs.formats.figures import reduced
from sms_jobs.metrology.arrays import Floats, Labels, Singles
from sms_jobs.records.reasons import Reason

Values = Singles
ImageValues = Floats | Singles | NDArray[np.uint16] | NDArray[np.uint8] | NDArray[np.int32]


VALID = "valid"
"""What a field of reasons says of a pixel that has a value."""


@dataclass(frozen=True)
class Field:
    """A scalar over an image, sampled; make it by `Sampler.field` or `Sampler.reasons`.

    Attributes
    ----------
    name, unit
        As they are shown. The same name in the views of several states is the same quantity: it is charted
        over the states and can be given one range of colours. The unit of a ratio is "".
    values
        (rows, columns) of the samples, NaN where there is none.
    sigma
        Standard deviation of `values` in the same unit, or None where none is known.
    categories
        Where `values` are flags: what each of them means.
    still, still_sigma
        (rows, columns), averaged for print; None for what is not printed.
    outlines
        Labels in the shape of `still` whose borders are drawn on it.
    followed
        Whether the field is charted over the states, at a place where it is large at the last one.
    grain
        What values are worth where they have no standard deviation: the page may round them to it.
    """

    name: str
    unit: str
    values: Values
    sigma: Values | None = None
    categories: Mapping[int, str] | None = None
    still: Values | None = None
    still_sigma: Values | None = None
    outlines: Labels | None = None
    followed: bool = False
    grain: float = 0.0


@dataclass(frozen=True)
class Statistic:
    """One number of a view: a cell of the table of all states.

    Attributes
    ----------
    name, unit
        Together the head of the column.
    value, sigma
        In that unit; sigma None where none is known.
    charted
        Whether it is charted over the states, with its standard deviation as an error bar.
    group
        Heading of the table that it stands in; those of one group stand in one table.
    """

    name: str
    unit: str
    value: float | None
    sigma: float | None = None
    charted: bool = False
    group: str = ""


@dataclass(frozen=True)
class View:
    """What one camera shows at one state: a section of the report.

    Attributes
    ----------
    title
        What is seen, in a few words.
    key
        Of the grid of pixels: a pixel is the same material point in all views of one key.
    size
        (rows, columns) of the whole image.
    step_px
        Every how many pixels the fields are sampled; sample (i, k) is the pixel (i step + step // 2, ...).
    fields
        To choose from; the first is shown when the page is opened.
    statistics
        For the table; of the same names in every state.
    position
        Names of three fields that are the X, Y, Z of the surface in mm: it can then be turned in space.
    movement
        Names of three fields that are its displacement in mm.
    mm_per_px
        Size of a pixel on the specimen, where that is all that is known of positions.
    notes
        Sentences that belong to the view: about doubts, gauge lengths, what is not covered.
    """

    title: str
    key: str
    size: tuple[int, int]
    step_px: int
    fields: tuple[Field, ...]
    statistics: tuple[Statistic, ...] = ()
    position: tuple[str, str, str] | None = None
    movement: tuple[str, str, str] | None = None
    mm_per_px: float | None = None
    notes: tuple[str, ...] = ()

    @property
    def pitch_mm(self) -> float | None:
        """How far samples are apart on the surface, in the middle; None where that is not known."""
        if self.position is None:
            return None if self.mm_per_px is None else self.step_px * self.mm_per_px
        fields = {each.name: each.values for each in self.fields}
        along = np.diff(np.stack([fields[name] for name in self.position]), axis=2)
        apart = np.sqrt(np.sum(along.astype(np.float64) ** 2, axis=0))
        known = apart[np.isfinite(apart)]
        return float(np.median(known)) if known.size else None


def thinned(view: View) -> View:
    """Return a view with every other sample of each row and column, without still pictures."""

    def every_other(values: Values | None) -> Values | None:
        return None if values is None else values[1::2, 1::2]

    fields = (
        replace(
            each,
            values=each.values[1::2, 1::2],
            sigma=every_other(each.sigma),
            still=None,
            still_sigma=None,
        )
        for each in view.fields
    )
    return replace(view, step_px=2 * view.step_px, fields=tuple(fields))


@dataclass(frozen=True)
class Sampler:
    """Makes fields of whole images: sampled for the screen, averaged for print.

    Attributes
    ----------
    size
        (rows, columns) of the images.
    map_px
        Most samples along the longer side.
    still_px
        Width of a printed picture; 0 where none is made.
    """

    size: tuple[int, int]
    map_px: int
    still_px: int

    @property
    def step_px(self) -> int:
        """Every how many pixels is sampled."""
        return max(1, ceil(max(self.size) / self.map_px))

    def field(
        self,
        name: str,
        unit: str,
        values: ImageValues,
        sigma: ImageValues | None = None,
        *,
        scale: float = 1.0,
        still: bool = False,
        still_sigma: bool = False,
        followed: bool = False,
        grain: float = 0.0,
    ) -> Field:
        """Return a field: `scale` times values (rows, columns) and their deviations are in `unit`."""
        return Field(
            name,
            unit,
            self.samples(values, scale),
            None if sigma is None else self.samples(sigma, scale),
            still=self._printed(values, scale) if still else None,
            still_sigma=self._printed(sigma, scale) if still_sigma and sigma is not None else None,
            followed=followed,
            grain=grain,
        )

    def outlined(self, field: Field, labels: Labels | None) -> Field:
        """Return a field with the borders of labels (rows, columns) on it where it is printed."""
        if labels is None or field.still is None:
            return field
        return replace(field, outlines=reduced(labels, self.still_px))

    def _printed(self, values: ImageValues, scale: float) -> Values | None:
        if not self.still_px:
            return None
        return (scale * reduced(np.asarray(values, np.float32), self.still_px)).astype(np.float32)

    def reasons(self, name: str, reason: NDArray[np.uint32]) -> Field:
        """Return a field of why pixels have no value, (rows, columns) of `Reason` bits."""
        step = self.step_px
        sampled = reason[step // 2 :: step, step // 2 :: step]
        present = {int(bits): in_words(int(bits)) for bits in np.unique(sampled)}
        return Field(name, "", sampled.astype(np.float32), categories=present)

    def samples(self, values: ImageValues, scale: float = 1.0) -> Values:
        """Return `scale` times the samples of images (..., rows, columns)."""
        step = self.step_px
        return (scale * values[..., step // 2 :: step, step // 2 :: step]).astype(np.float32)


def in_words(bits: int) -> str:
    """Write `Reason` bits as words."""
    if not bits:
        return VALID
    return ", ".join(
        (flag.name or str(flag.value)).lower().replace("_", " ") for flag in Reason if flag.value & bits
    )
