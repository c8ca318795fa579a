"""Strain of a flat panel in tension: its error against exact truth, and whether it is stated honestly."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sms_jobs.bench.compared_fields import reported_over_observed
from sms_jobs.bench.figures import Condition, Figure, Found, Group, Run
from sms_jobs.kinds.deformation import correlate, strain
from sms_jobs.testing.shelf import reconstructed
from sms_jobs.virtual_rig.campaigns import Size, small_plate, tension_panel

_GAUGE_LENGTH_MM = 20.0
_MICROSTRAIN = 1e6


def warm_up() -> None:
    """Compile what a campaign goes through from frames to strain."""
    shelf, subject = reconstructed(*small_plate("plate"), lambda words: None, 1)
    for kind in (correlate.KIND, strain.KIND):
        shelf.run(kind, subject, kind.parameters())


def measure(run: Run) -> Iterator[Found]:
    """Yield the figures and their conditions."""
    size: Size = "small" if run.quick else "full"
    shelf, subject = reconstructed(*tension_panel("panel", size), run.say, run.threads)
    truth = shelf.truth(subject)
    shelf.run(correlate.KIND, subject, correlate.KIND.parameters())
    shelf.run(strain.KIND, subject, strain.KIND.parameters(gauge_length_mm=_GAUGE_LENGTH_MM))
    found = shelf.records["strain", subject]["strain"]
    valid = found.reason == 0
    error = (found.strain - truth.strain(found.measure))[:, valid]
    rms = float(np.sqrt(np.mean(error**2)))
    honest = reported_over_observed([error / found.sigma[:, valid]])
    yield Figure("panel_rms_microstrain", _MICROSTRAIN * rms, "microstrain", 30.0, "at most")
    for component, each in zip(("xx", "yy", "xy"), np.sqrt(np.mean(error**2, axis=1)), strict=True):
        yield Figure(f"panel_rms_{component}_microstrain", _MICROSTRAIN * float(each), "microstrain")
    yield Figure("reported_over_observed", honest, "1", 1.2, "at most")
    pixels = found.reason.shape[1]
    yield Condition(
        "panel",
        f"flat panel of 290 mm at 2000 microstrain, one camera of {pixels} px and one projector, 12 bit, "
        f"default parameters, gauge length {_GAUGE_LENGTH_MM:g} mm; rms error of xx, yy and xy together over "
        f"all {int(valid.sum())} valid pixels, nothing trimmed; thesis 100 microstrain",
    )
    yield Condition(
        "reported_over_observed", "one over the rms of errors in units of what is stated; wanted 0.8 to 1.2"
    )


GROUP = Group("strain", "error of strain on a panel in tension, against exact truth", warm_up, measure)
