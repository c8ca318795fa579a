"""The parameters of job kinds: what may be chosen."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class Parameters(BaseModel):
    """Base of every kind's parameters: immutable, unknown names refused, units in the names."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
