"""The parameters of job kinds: what may be chosen, and what is refused."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Self

from pydantic import BaseModel, ConfigDict, ValidationError

from sms_jobs.errors import InvalidInput, did_you_mean, in_words


class Parameters(BaseModel):
    """Base of every kind's parameters: immutable, unknown names refused, units in the names."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @classmethod
    def checked(cls, kind: str, given: Mapping[str, Any]) -> Self:
        """Return what a kind is given, defaults filled in; raise `InvalidInput` for what it does not take."""
        try:
            return cls.model_validate(dict(given))
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            name = ".".join(str(part) for part in first["loc"])
            names = ", ".join(cls.model_fields) or "none"
            why = in_words(first["msg"])
            if not name:
                raise InvalidInput(f"the parameters of {kind} do not fit together: {why}") from error
            if first["type"] == "extra_forbidden":
                meant = did_you_mean(name, cls.model_fields, 0.6)
                raise InvalidInput(
                    f"{kind} has no parameter '{name}'; {meant}its parameters are {names}"
                ) from error
            if first["type"] == "missing":
                what = cls.model_fields[name].description if name in cls.model_fields else None
                raise InvalidInput(
                    f"{kind} needs the parameter '{name}'{f': {what}' if what else ''}"
                ) from error
            raise InvalidInput(
                f"parameter '{name}' of {kind} cannot be {first.get('input')!r}: {why}"
            ) from error
