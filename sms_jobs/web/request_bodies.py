"""What is asked for: types that addresses share, each with its limits, which the description names."""

from __future__ import annotations

from typing import Annotated

from fastapi import Path, Query
from pydantic import AwareDatetime, BaseModel, ConfigDict, Field

MOST_LETTERS = 1000
_MOST_NAMES = 1000
TEXT = r"^[^\x00]*$"
_LARGEST = 2**31 - 1

Text = Annotated[str, Field(pattern=TEXT, max_length=MOST_LETTERS)]
LongText = Annotated[str, Field(pattern=TEXT, max_length=1 << 20)]
Texts = Annotated[list[Text], Field(max_length=_MOST_NAMES)]
Moment = Annotated[AwareDatetime, Field(strict=False)]
Priority = Annotated[int, Field(ge=-100, le=100, description="Higher runs earlier.")]
Limit = Annotated[int, Query(ge=1, le=10_000, description="How many at most.")]
Number = Annotated[int, Path(ge=1, le=_LARGEST)]
FileNumber = Annotated[int, Field(ge=1, le=_LARGEST)]
Name = Annotated[str, Path(pattern=TEXT, max_length=MOST_LETTERS)]

Jobs = Annotated[Texts, Field(description="Ids of jobs, or their beginnings.")]
Campaign = Annotated[Text | None, Field(description="All jobs of a campaign, instead of named ones.")]


class RequestBody(BaseModel):
    """A body as it has to be: a name that is not known, or a value of another type, is refused."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)
