"""Displacement of the thesis's top hat, bent: its error against exact truth."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sms_jobs.bench.compared_fields import reported_over_observed
from sms_jobs.bench.figures import Condition, Figure, Found, Group, Run
from sms_jobs.bench.groups.strain import warm_up
from sms_jobs.kinds.deformation import correlate
from sms_jobs.testing.shelf import reconstructed
from sms_jobs.virtual_rig.campaigns import top_hat_bending


def measure(run: Run) -> Iterator[Found]:
    """Yield the figures and their conditions."""
    calibration, campaign = top_hat_bending("hat", "small" if run.quick else "full")
    shelf, subject = reconstructed(calibration, campaign, run.say, run.threads)
    truth = shelf.truth(subject)
    shelf.run(correlate.KIND, subject, correlate.KIND.parameters())
    found = shelf.records["correlate", subject]["displacement"]
    error = found.displacement - truth.displacement
    known = (found.reason == 0) & np.isfinite(error).all(axis=0)
    squared = np.sum(error[:, known] ** 2, axis=0)
    rms = float(np.sqrt(squared.mean()))
    honest = reported_over_observed([error[:, known] / np.sqrt(found.covariance[[0, 3, 5]][:, known])])
    diagonal = calibration.volume.diagonal_mm
    yield Figure("top_hat_rms_over_diagonal", rms / diagonal, "1", 1.0 / 25_000.0, "at most")
    yield Figure("top_hat_rms_mm", rms, "mm")
    yield Figure("top_hat_largest_mm", float(np.sqrt(squared.max())), "mm")
    yield Figure("reported_over_observed", honest, "1", 1.2, "at most")
    yield Condition(
        "top_hat",
        f"thesis section 5.3: a top hat of 500 mm pushed out by 10 mm, view {subject.view} alone, camera of "
        f"{found.reason.shape[1]} px, 12 bit, default parameters; rms length of the error over all "
        f"{int(known.sum())} valid pixels, nothing trimmed; volume diagonal {diagonal:.0f} mm; "
        f"that is 1/{diagonal / rms:.0f}, the thesis has 1/12,000",
    )
    yield Condition(
        "reported_over_observed",
        "one over the rms of errors in units of what is stated; wanted 0.8 to 1.2",
    )


GROUP = Group("displacement", "error of displacement on the top hat, against exact truth", warm_up, measure)
