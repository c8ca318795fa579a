"""Assess: compare the results of a tuple on the virtual rig with the exact truth."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, replace
from math import isfinite

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.kinds.kind import (
    MEASUREMENT,
    DatasetOutput,
    Inputs,
    Kind,
    Need,
    Output,
    Port,
    Progress,
    Scope,
    is_deformed,
    tuples,
)
from sms_jobs.kinds.parameters import Parameters
from sms_jobs.kinds.port_names import MOVED, SHAPE
from sms_jobs.kinds.products import ASSESSMENT, DISPLACEMENT, MEASURED, STRAIN, SURFACE
from sms_jobs.kinds.surface_ports import position_covariance, surface_port, textured_by
from sms_jobs.metrology.arrays import Floats, Mask, Singles
from sms_jobs.records.assessment import Assessment, Errors
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.fields import StrainField
from sms_jobs.records.quantity import SYMMETRIC
from sms_jobs.records.reasons import Reason
from sms_jobs.records.scene import Simulation
from sms_jobs.records.statistic_names import ErrorsOf, of_errors
from sms_jobs.records.subject import Subject
from sms_jobs.virtual_rig.truth import Truth, exact_shape, exact_truth

_DIAGONAL = [SYMMETRIC.index(name) for name in ("XX", "YY", "ZZ")]


class AssessParameters(Parameters):
    """There is one truth, and nothing to choose."""


def simulated_tuples(campaign: Campaign) -> tuple[Subject, ...]:
    """Return every tuple of a campaign on the virtual rig; none of any other, whose truth nobody knows."""
    return () if campaign.scene is None else tuples(campaign)


_FRAMES = Port("measurement", MEASUREMENT, (MEASURED,))
_SHAPE = surface_port(SHAPE)
_REFERENCE = Port("reference", MEASUREMENT, (MEASURED,))
_MOVED = Port(MOVED, "correlate", (DISPLACEMENT,))
_STRAINED = Port("strain", "strain", (STRAIN,))


def needs(campaign: Campaign, subject: Subject, parameters: AssessParameters) -> Iterable[Need]:
    """Return the results that are compared, and the measurements that say what was simulated."""
    yield _FRAMES.of(textured_by(subject))
    yield _SHAPE.of(campaign, subject)
    if is_deformed(campaign, subject):
        yield _REFERENCE.of(textured_by(replace(subject, state=campaign.reference.label)))
        yield _MOVED.of(subject)
        yield _STRAINED.of(subject)


def run(inputs: Inputs, parameters: AssessParameters, progress: Progress) -> Iterator[Output]:
    """Compare the shape, and for a deformed state displacement and strain, with the truth."""
    state = _simulation(inputs, _FRAMES)
    surface = inputs.read(_SHAPE.port, SURFACE)
    exact = exact_shape(state, inputs.view.partners, threads=inputs.threads)
    progress(0.3, "comparing the shape")
    shape, shape_error = vector_errors(
        surface.position - exact.xyz, position_covariance(surface), surface.reason, exact.seen & exact.lit
    )
    if not inputs.has(_REFERENCE):
        yield _output(inputs.subject, Assessment(shape, None, None, shape_error))
        return
    reference = _simulation(inputs, _REFERENCE)
    strained = inputs.read(_STRAINED, STRAIN)
    truth = exact_truth(
        reference, state, inputs.view.partners, x_axis=strained.x_axis, threads=inputs.threads
    )
    expected = truth.shape.seen & truth.shape.lit & truth.lit_and_seen_at_end
    progress(0.6, "comparing displacement and strain")
    moved, moved_error = _displacement_errors(inputs, truth, expected)
    strain, strain_error = _strain_errors(strained, truth, expected)
    yield _output(inputs.subject, Assessment(shape, moved, strain, shape_error, moved_error, strain_error))


def _simulation(inputs: Inputs, port: Port) -> Simulation:
    simulation = inputs.read(port, MEASURED).simulation
    if simulation is None:
        raise InvalidInput(
            f"the {port.name} of {inputs.subject} was not simulated, so its truth is unknown; "
            "assess campaigns of the virtual rig only"
        )
    return simulation


def _displacement_errors(inputs: Inputs, truth: Truth, expected: Mask) -> tuple[Errors, Singles]:
    field = inputs.read(_MOVED, DISPLACEMENT)
    return vector_errors(field.displacement - truth.displacement, field.covariance, field.reason, expected)


def _strain_errors(field: StrainField, truth: Truth, expected: Mask) -> tuple[Errors, Singles]:
    return strain_errors(field.strain - truth.strain(field.measure), field.sigma, field.reason, expected)


def vector_errors(
    error: Floats, covariance: Singles, reason: NDArray[np.uint32], expected: Mask
) -> tuple[Errors, Singles]:
    """Sum up the errors of positions or displacements.

    Parameters
    ----------
    error
        (3, rows, columns), measured minus true, mm; NaN where there is no truth.
    covariance
        (6, rows, columns), predicted, mm^2.
    reason
        (rows, columns), valid where 0.
    expected
        (rows, columns), where a value can be had.

    Returns
    -------
    The errors, and their length as an image in mm.

    Notes
    -----
    The score of a pixel is its squared error over the trace of its covariance: an error lies along the
    camera's ray, so that the covariance has no inverse.
    """
    variance = covariance[_DIAGONAL].sum(axis=0, dtype=np.float64)
    length = np.sqrt(np.sum(error**2, axis=0))
    used = (reason == Reason.VALID) & np.isfinite(length)
    mean = error[:, used].mean(axis=1) if used.any() else np.full(3, np.nan)
    return _summed_up(
        length[used] ** 2, float(np.linalg.norm(mean)), variance[used], reason, used, expected
    ), np.where(used, length, np.nan).astype(np.float32)


def strain_errors(
    error: Floats, sigma: Singles, reason: NDArray[np.uint32], expected: Mask
) -> tuple[Errors, Singles]:
    """Sum up the errors of strains, xx, yy and xy pooled.

    Parameters
    ----------
    error
        (3, rows, columns), measured minus true; NaN where there is no truth.
    sigma
        (3, rows, columns), predicted standard deviations.
    reason
        (rows, columns), valid where 0.
    expected
        (rows, columns), where a value can be had.

    Returns
    -------
    The errors, and the error of each component as images.
    """
    used = (reason == Reason.VALID) & np.isfinite(error).all(axis=0)
    mean = error[:, used].mean(axis=1) if used.any() else np.full(3, np.nan)
    variance = sigma[:, used].astype(np.float64) ** 2
    return _summed_up(
        error[:, used].ravel() ** 2,
        float(np.sqrt(np.mean(mean**2))),
        variance.ravel(),
        reason,
        used,
        expected,
    ), np.where(used, error, np.nan).astype(np.float32)


def _summed_up(
    squared: Floats,
    bias: float,
    variance: Floats,
    reason: NDArray[np.uint32],
    used: Mask,
    expected: Mask,
) -> Errors:
    valid = reason == Reason.VALID
    with np.errstate(divide="ignore", invalid="ignore"):
        score = squared / variance
    nothing = float("nan")
    return Errors(
        count=int(used.sum()),
        rms=float(np.sqrt(squared.mean())) if squared.size else nothing,
        bias=bias,
        largest=float(np.sqrt(squared.max())) if squared.size else nothing,
        score_rms=float(np.sqrt(score.mean())) if score.size else nothing,
        expected_count=int(expected.sum()),
        valid_fraction=float(valid[expected].mean()) if expected.any() else nothing,
        false_valid_count=int((valid & ~used).sum()),
    )


def _output(subject: Subject, assessment: Assessment) -> DatasetOutput:
    statistics: dict[str, float] = {}
    every: Mapping[ErrorsOf, Errors | None] = {
        "shape": assessment.shape,
        "displacement": assessment.displacement,
        "strain": assessment.strain,
    }
    for of, errors in every.items():
        # What is not known is left out.
        known = {} if errors is None else {key: v for key, v in asdict(errors).items() if isfinite(v)}
        statistics |= {of_errors(of, key): float(value) for key, value in known.items()}
    return DatasetOutput(subject, {ASSESSMENT: assessment}, statistics)


KIND = Kind(
    name="assess",
    summary="compare a tuple's results on the virtual rig with the exact truth",
    version=1,
    scope=Scope.TUPLE,
    parameters=AssessParameters,
    inputs=(_FRAMES, *_SHAPE.all, _REFERENCE, _MOVED, _STRAINED),
    outputs=(ASSESSMENT,),
    needs=needs,
    run=run,
    subjects=simulated_tuples,
)
