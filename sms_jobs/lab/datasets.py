"""Records as datasets of xarray, which say what they are and where they come from."""

from __future__ import annotations

import json
from dataclasses import asdict, fields, is_dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sms_jobs.app.holdings.reading import StoredRecord
from sms_jobs.errors import ConfigurationError
from sms_jobs.records.quantity import Quantity, quantities, quantities_of
from sms_jobs.records.reasons import Reason

if TYPE_CHECKING:
    import xarray

MISSING = "{package} is not installed: run \"pip install 'sms-jobs[notebook]'\""
_UNCERTAINTY = ("sigma", "covariance", "bias", "sigma_calibration", "reason")
"""Arrays that say how well the others are known, or why they are not."""


_NO_CALIBRATION = "not known: no calibration, or one that states no covariance; not zero"
_NOT_ALONG_SPECIMEN = "not known along the specimen's axes, only along those of the world; not zero"


def dataset_of(stored: StoredRecord) -> xarray.Dataset:
    """Return a record as a dataset whose attributes say where it comes from."""
    try:
        import xarray
    except ImportError as error:
        raise ConfigurationError(MISSING.format(package="xarray")) from error
    record = stored.record
    declared = {
        name: quantity
        for name, quantity in quantities_of(record).items()
        if isinstance(getattr(record, name), np.ndarray)
    }
    dimensions = _dimensions(declared)
    aside = [name for name in _UNCERTAINTY if name in declared]
    variables = {}
    for name, quantity in declared.items():
        attributes: dict[str, Any] = {"units": quantity.unit, "long_name": quantity.meaning}
        if quantity.unit == "bit":
            attributes |= _flags()
        if name not in aside and aside:
            attributes["ancillary_variables"] = " ".join(aside)
        variables[name] = (dimensions[name], getattr(record, name), attributes)
    labels = {
        dimensions[name][quantity.axes.index("component")]: list(quantity.components)
        for name, quantity in declared.items()
        if quantity.components
    }
    return xarray.Dataset(variables, labels, {**_scalars(record), **_provenance(stored)})


def _dimensions(declared: dict[str, Quantity]) -> dict[str, tuple[str, ...]]:
    """Return the axes of each array; components that differ are named by the first array with them."""
    kinds: dict[tuple[str, ...], str] = {}
    for name, quantity in declared.items():
        if "component" in quantity.axes:
            kinds.setdefault(quantity.components, name)
    alike = len(kinds) <= 1
    return {
        name: tuple(
            f"{kinds[quantity.components]}_component" if axis == "component" and not alike else axis
            for axis in quantity.axes
        )
        for name, quantity in declared.items()
    }


def _flags() -> dict[str, Any]:
    """Return what the bits of a reason mean, as the CF conventions write it."""
    bits = [reason for reason in Reason if reason]
    return {
        "flag_masks": np.array([reason.value for reason in bits], np.uint32),
        "flag_meanings": " ".join(str(reason.name).lower() for reason in bits),
    }


def _scalars(record: Any) -> dict[str, Any]:
    """Return what a record says besides its arrays; what is no number or text, as JSON."""
    arrays = quantities(type(record))
    given = {f.name: getattr(record, f.name) for f in fields(record) if f.name not in arrays}
    said = {
        name: value if type(value) in (str, int, float) else _as_json(value)
        for name, value in given.items()
        if value is not None
    }
    if "sigma_calibration" in arrays and record.sigma_calibration is None:
        along_specimen = getattr(record, "axes", "XYZ") == "xyz"
        said["sigma_calibration"] = _NOT_ALONG_SPECIMEN if along_specimen else _NO_CALIBRATION
    return said


def _provenance(stored: StoredRecord) -> dict[str, Any]:
    file, made = stored.file, stored.provenance
    return {
        "subject": file.subject,
        "record": stored.name,
        "kind": made.kind,
        "kind_version": made.kind_version,
        "job": made.job_id,
        "parameters": _as_json(dict(made.parameters)),
        "inputs": _as_json([asdict(one) for one in made.inputs]),
        "created": made.created_at.isoformat(),
        "program_version": made.program_version,
        "file": file.id,
        "path": file.path,
        "content_hash": file.content_hash,
    }


def _as_json(value: Any) -> str:
    def plain(one: Any) -> Any:
        return asdict(one) if is_dataclass(one) and not isinstance(one, type) else str(one)

    return json.dumps(value, default=plain, ensure_ascii=False)
