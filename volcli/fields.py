"""What the fields of a job are made of: numbers with their ranges, colours, tables.

Which fields there are is for `schema` and `sources`.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, Strict

Number = Annotated[FiniteFloat, Strict()]
"""A number that is written as one: neither true nor a number in quotes."""
Vector = tuple[Number, Number, Number]
Positive = Annotated[Number, Field(gt=0)]
NotNegative = Annotated[Number, Field(ge=0)]
Radiance = NotNegative
Colour = tuple[Radiance, Radiance, Radiance]
ColourStop = tuple[Number, Radiance, Radiance, Radiance]
DensityStop = tuple[Number, NotNegative]
Pixels = Annotated[int, Strict(), Field(ge=1, le=65536)]


class Part(BaseModel):
    """A table of a job: frozen, and without keys that it does not know."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=False)
