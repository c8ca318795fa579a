"""The parameters of job kinds: what may be chosen, and what is refused."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, ConfigDict, ValidationError

from sms_jobs.errors import InvalidInput

if TYPE_CHECKING:
    from sms_jobs.kinds.kind import Kind


class Parameters(BaseModel):
    """Base of every kind's parameters: immutable, unknown names refused, units in the names."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


def checked_parameters(kind: Kind[Any], given: Mapping[str, Any]) -> Parameters:
    """Return the parameters of a kind, defaults filled in; raise `InvalidInput` for what it does not take."""
    try:
        checked = kind.parameters.model_validate(dict(given))
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        name = ".".join(str(part) for part in first["loc"])
        names = ", ".join(kind.parameters.model_fields) or "none"
        raise InvalidInput(
            f"parameter '{name}' of {kind.name} cannot be {first.get('input')!r}: {first['msg']}; "
            f"its parameters are {names}"
        ) from error
    assert isinstance(checked, Parameters)
    return checked
