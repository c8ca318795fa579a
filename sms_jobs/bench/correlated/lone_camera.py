"""Two images of one camera, correlated by the kinds that a campaign goes through."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray

from sms_jobs.kinds.deformation import correlate
from sms_jobs.kinds.deformation.correlate_parameters import CorrelateParameters
from sms_jobs.kinds.kind import MEASUREMENT
from sms_jobs.kinds.shape import plane
from sms_jobs.records.campaign import Campaign, LoadState, Specimen
from sms_jobs.records.measurement import ArrayStack, FringeSequence, Measurement
from sms_jobs.records.subject import Subject
from sms_jobs.testing.shelf import Shelf

FULL_SCALE = 4095
DEFORMED = Subject("pair", "S01", "C1")
_AT = datetime(2026, 1, 1, tzinfo=UTC)


def correlated(
    reference: NDArray[np.uint16],
    deformed: NDArray[np.uint16],
    read_noise: float,
    parameters: CorrelateParameters,
    threads: int,
) -> Shelf:
    """Correlate a pair of images of 12 bits with noise in grey levels; its results are of `DEFORMED`."""
    states = (LoadState("S00", 0.0, time=_AT), LoadState("S01", 1.0, time=_AT))
    specimen = Specimen("plate", "unknown", "computed")
    shelf = Shelf(Campaign("pair", specimen, "computed", states, ("C1",), FringeSequence(), None), threads)
    at_rest = Subject("pair", "S00", "C1")
    for own, image in ((at_rest, reference), (DEFORMED, deformed)):
        recorded = Measurement(
            _AT, FringeSequence(), FULL_SCALE, 0.0, read_noise, image, ArrayStack(image[None])
        )
        shelf.records[MEASUREMENT, own] = {"measurement": recorded}
    shelf.run(plane.KIND, at_rest, plane.KIND.parameters())
    shelf.run(correlate.KIND, DEFORMED, parameters)
    return shelf
