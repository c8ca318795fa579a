"""Shape and displacement along the specimen's own axes, with their covariances turned along."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.arrays import Floats, Singles
from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.metrology.geometry.transforms import turn_covariance
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.field_names import DISPLACEMENT_IN_SPECIMEN, DISPLACEMENT_XYZ
from sms_jobs.records.fields import DisplacementField, MergedField, Mesh, StrainField, Surface

_SAME_AXIS = 1e-9  # rounding; a turn of a millionth of a degree is more


def in_specimen_frame(record: Any, campaign: Campaign) -> Any:
    """Return a record with its vectors along the specimen's axes x, y, z, and places from its origin.

    Strain lies in the surface's plane along the specimen's x axis anyway, and stays as it is.

    Parameters
    ----------
    record
        A surface, a displacement, a merged field or mesh, or strain, along X, Y, Z of the world.
    campaign
        Whose specimen it is of.

    Raises
    ------
    InvalidInput
        Nobody has found the frame, the record lies in the plane of an image or in no frame, or its strain
        lies along another axis.

    Notes
    -----
    What the calibration adds to sigma is known along X, Y and Z alone, not how these go together: along other
    axes it is not known.
    """
    if campaign.frame is None and campaign.scene is None:
        raise InvalidInput(
            f"the specimen's frame of campaign {campaign.name} is not set; 'sms campaign frame "
            f"{campaign.name} --help' shows how"
        )
    turned = _TURNED.get(type(record))
    if turned is None:
        raise InvalidInput(
            f"a {type(record).__name__} has no frame; choose a surface, a displacement, "
            "a merged result or strain, or leave out the frame"
        )
    if not _in_space(record):
        raise InvalidInput(
            "what lies in the plane of an image has no place in the specimen's frame; leave out the frame"
        )
    return turned(record, campaign.placement)


def _in_space(record: Any) -> bool:
    first = getattr(record, "displacement", getattr(record, "position", None))
    if isinstance(record, Mesh):
        return record.has_depth
    return first is None or len(first) == 3


def _vectors(placement: Pose, values: Floats) -> Floats:
    """Return vectors (3, ...) of the world along the specimen's axes."""
    return np.asarray(np.tensordot(placement.matrix().T, values, axes=1))


def _places(placement: Pose, values: Floats) -> Floats:
    """Return places (3, ...) of the world from the specimen's origin, along its axes."""
    shift = np.array(placement.translation).reshape(3, *([1] * (values.ndim - 1)))
    return _vectors(placement, values - shift)


def _covariance(placement: Pose, packed: NDArray[np.floating]) -> Singles:
    return turn_covariance(placement.matrix().T, packed).astype(np.float32)


def _surface(record: Surface, placement: Pose) -> Surface:
    return replace(
        record,
        position=_places(placement, record.position),
        covariance=None if record.covariance is None else _covariance(placement, record.covariance),
        sigma_calibration=None,
        axes="xyz",
    )


def _displacement(record: DisplacementField, placement: Pose) -> DisplacementField:
    return replace(
        record,
        displacement=_vectors(placement, record.displacement),
        covariance=_covariance(placement, record.covariance),
        bias=None if record.bias is None else _covariance(placement, record.bias),
        sigma_calibration=None,
        axes="xyz",
    )


def _merged(record: MergedField, placement: Pose) -> MergedField:
    return replace(
        record,
        displacement=_vectors(placement, record.displacement),
        position=_places(placement, record.position),
        covariance=_covariance(placement, record.covariance),
        sigma_calibration=None,
        axes="xyz",
    )


def _mesh(record: Mesh, placement: Pose) -> Mesh:
    _refuse_other_axis(record.strain_axis, placement)
    names, values = list(record.value_names), record.values.copy()
    if set(DISPLACEMENT_XYZ) <= set(names):
        rows = [names.index(name) for name in DISPLACEMENT_XYZ]
        values[rows] = _vectors(placement, record.values[rows])
        for row, name in zip(rows, DISPLACEMENT_IN_SPECIMEN, strict=True):
            names[row] = name
    return replace(
        record,
        vertices=np.ascontiguousarray(_places(placement, record.vertices.T).T),
        value_names=tuple(names),
        values=values,
        strain_axis=None if record.strain_axis is None else (1.0, 0.0, 0.0),
        axes="xyz",
    )


def _strain(record: StrainField, placement: Pose) -> StrainField:
    _refuse_other_axis(record.x_axis, placement)
    return replace(record, x_axis=None if record.x_axis is None else (1.0, 0.0, 0.0))


def _refuse_other_axis(axis: tuple[float, float, float] | None, placement: Pose) -> None:
    """Raise `InvalidInput` for strain along another axis of the world than the specimen's x."""
    if axis is None:
        return
    off = np.linalg.norm(np.array(axis) - placement.matrix()[:, 0])
    if off > _SAME_AXIS:
        raise InvalidInput(
            f"its strain lies along an axis that is {np.degrees(off):.3g} degrees off the specimen's x axis, "
            "since the frame was changed after it was computed: submit strain and merge again"
        )


_TURNED: dict[type, Callable[[Any, Pose], Any]] = {
    Surface: _surface,
    DisplacementField: _displacement,
    MergedField: _merged,
    Mesh: _mesh,
    StrainField: _strain,
}
