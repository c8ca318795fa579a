"""Relative: displacement without the motion that a chosen region makes as a rigid body.

Thesis section 6.3.2: the support frame of a specimen moves, is seen beside it, and is subtracted.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import TypeAlias

import numpy as np
from pydantic import Field, field_validator

from sms_jobs.errors import InvalidInput
from sms_jobs.kinds.calibration_factors import RelativeSigma, relative_sigma, states_of
from sms_jobs.kinds.kind import (
    DatasetOutput,
    Inputs,
    Kind,
    Need,
    Output,
    Port,
    Progress,
    Scope,
    deformed_views,
)
from sms_jobs.kinds.parameters import Parameters
from sms_jobs.kinds.port_names import AT_REST, MOVED
from sms_jobs.kinds.products import CALIBRATION_FACTOR, DISPLACEMENT, MOTION, RELATIVE, SURFACE
from sms_jobs.kinds.surface_ports import surface_port
from sms_jobs.metrology.arrays import Floats, Ints
from sms_jobs.metrology.deformation.fields.rigid_motion import RigidMotion, rigid_motion, with_motion
from sms_jobs.metrology.geometry.planes import covariance_in_plane, covariance_in_space, in_space, trace
from sms_jobs.metrology.geometry.specimen_frame import tiles_of
from sms_jobs.metrology.geometry.transforms import rotation_vector
from sms_jobs.metrology.images.region_of_interest import inside_outlines, parse_outlines
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.fields import DisplacementField
from sms_jobs.records.reasons import Reason
from sms_jobs.records.rigid_motion import RegionMotion
from sms_jobs.records.scene import Vector
from sms_jobs.records.statistic_names import maximum_displacement
from sms_jobs.records.subject import Subject

Pixels: TypeAlias = tuple[Ints, Ints]

_MOST = 20_000  # pixels of a region; neighbours share their errors, and more tell nothing more


class RelativeParameters(Parameters):
    """Which region is taken to be rigid."""

    region: str = Field(
        min_length=1,
        description="of the reference image, whose rigid motion is taken out of the displacement: 'rectangle "
        "LEFT TOP RIGHT BOTTOM' and 'polygon X Y X Y X Y' in px, less what follows a minus",
    )

    @field_validator("region", mode="before")
    @classmethod
    def _outlines_can_be_read(cls, given: object) -> object:
        """Join what commas have parted, and refuse what is no region."""
        text = " ".join(map(str, given)) if isinstance(given, list | tuple) else given
        if isinstance(text, str) and text:
            parse_outlines(text)
        return text


_MOVED = Port(MOVED, "correlate", (DISPLACEMENT, CALIBRATION_FACTOR))
_REFERENCE = surface_port(AT_REST)


def _needs(campaign: Campaign, subject: Subject, parameters: RelativeParameters) -> Iterable[Need]:
    yield _MOVED.of(subject)
    yield _REFERENCE.of(campaign, replace(subject, state=campaign.reference.label))


def run(inputs: Inputs, parameters: RelativeParameters, progress: Progress) -> Iterator[Output]:
    """Fit a rigid motion to the stored displacement of the region, and subtract it everywhere."""
    moved = inputs.read(_MOVED, DISPLACEMENT)
    surface = inputs.read(_REFERENCE.port, SURFACE)
    pixels = _pixels(moved, parameters.region)
    position, displacement = in_space(surface.position), in_space(moved.displacement)
    variance = trace(moved.covariance)
    motion = rigid_motion(
        position[:, pixels[0], pixels[1]].T,
        displacement[:, pixels[0], pixels[1]].T,
        variance[pixels],
        tiles_of(*pixels),
    )
    progress(0.5, f"fitted the motion of {len(pixels[0])} pixels")
    states = states_of(inputs, _MOVED)
    used = pixels[0][motion.used], pixels[1][motion.used]
    part = None if states is None else relative_sigma(states, surface, moved, motion, used)
    field = _without(moved, position, motion, part)
    stated = _stated(moved, parameters.region, motion, part)
    progress(1.0, "subtracted the motion")
    yield DatasetOutput(inputs.subject, {RELATIVE: field, MOTION: stated}, _statistics(stated, field))


def _pixels(moved: DisplacementField, region: str) -> Pixels:
    """Return rows and columns of the region's pixels that have a displacement, 20 000 at most."""
    rows, columns = moved.reason.shape
    inside = inside_outlines(parse_outlines(region), (rows, columns))
    found = np.nonzero(inside & (moved.reason == Reason.VALID))
    if not len(found[0]):
        raise InvalidInput(
            f"the region '{region}' has no pixel of {moved.view} with a displacement, whose image has "
            f"{columns} x {rows} px; choose one on the measured surface"
        )
    some = slice(None, None, -(-len(found[0]) // _MOST))
    return found[0][some], found[1][some]


def _without(
    moved: DisplacementField, position: Floats, motion: RigidMotion, part: RelativeSigma | None
) -> DisplacementField:
    """Return a displacement without a motion, whose own uncertainty all pixels share."""
    left = in_space(moved.displacement) - motion.displacement(position)
    own = motion.covariance_at(np.where(moved.reason == Reason.VALID, position, np.nan))
    bias = None if moved.bias is None else covariance_in_space(moved.bias)
    covariance = with_motion(covariance_in_space(moved.covariance), own)
    shared = with_motion(bias, own)
    flat = len(moved.displacement) == 2
    return replace(
        moved,
        displacement=left[:2] if flat else left,
        covariance=covariance_in_plane(covariance) if flat else covariance,
        bias=covariance_in_plane(shared) if flat else shared,
        sigma_calibration=None if part is None else part.field,
    )


def _stated(
    moved: DisplacementField, region: str, motion: RigidMotion, part: RelativeSigma | None
) -> RegionMotion:
    sigma = np.sqrt(np.diag(motion.covariance))
    return RegionMotion(
        moved.view,
        moved.reference_state,
        region,
        moved.unit,
        _three(motion.middle),
        _three(motion.shift),
        _three(rotation_vector(motion.rotation)),
        _three(sigma[3:]),
        _three(sigma[:3]),
        None if part is None else _three(part.motion[3:]),
        None if part is None else _three(part.motion[:3]),
        motion.rms,
        len(motion.used),
        float(motion.used.mean()),
        motion.covariance,
    )


def _three(values: Floats) -> Vector:
    x, y, z = (float(value) for value in values)
    return (x, y, z)


def _statistics(stated: RegionMotion, field: DisplacementField) -> dict[str, float]:
    """Return what people search by: what was taken out, and what is left at most."""
    valid = field.reason == Reason.VALID
    length = np.linalg.norm(field.displacement[:, valid], axis=0)
    unit = stated.unit
    return {
        "region_rotation_rad": float(np.linalg.norm(stated.rotation_rad)),
        "region_sigma_rotation_rad": float(np.linalg.norm(stated.sigma_rotation_rad)),
        f"region_translation_{unit}": float(np.linalg.norm(stated.translation)),
        f"region_sigma_translation_{unit}": float(np.linalg.norm(stated.sigma_translation)),
        f"region_rms_{unit}": stated.rms,
        maximum_displacement(unit): float(length.max()),
    }


KIND = Kind(
    name="relative",
    summary="displacement without the rigid motion of a region, which is stated with its deviations",
    version=1,
    scope=Scope.TUPLE,
    parameters=RelativeParameters,
    inputs=(_MOVED, *_REFERENCE.all),
    outputs=(RELATIVE, MOTION),
    needs=_needs,
    run=run,
    subjects=deformed_views,
    in_pipeline=False,
)
