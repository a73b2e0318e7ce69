"""Sources of light in a job, and functions of a grid's values: colour, emission, ramps, blackbody.

Names, defaults, units and help, as in `schema`, of which these tables are a part. What a ramp or a
blackbody makes of values is in `tables`.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Annotated

from pydantic import Field, Strict, field_validator, model_validator

from volcli.fields import Colour, ColourStop, DensityStop, NotNegative, Number, Part

DEFAULT_MAP = "inferno"
SOURCES = ("constant", "grid", "ramp", "blackbody")
"""The sources of colour, of which a job has one."""


class DensityRamp(Part):
    """Density through a transfer function: show some values of a grid, and not others."""

    stops: tuple[DensityStop, ...] = Field(
        description="[value, density] pairs, ascending; linear between, and beyond the ends as "
        "at the ends.",
    )

    @field_validator("stops")
    @classmethod
    def _stops_ascend(cls, stops: tuple[DensityStop, ...]) -> tuple[DensityStop, ...]:
        _check_stops([value for value, _ in stops])
        return stops


class Ramp(Part):
    """Colour of a scalar grid's values, by a named map or by stops."""

    grid: str | None = Field(None, description="Scalar grid. Absent: the density's.")
    map: str | None = Field(
        None,
        description="Colour map, by matplotlib's name, such as viridis. "
        f"Absent, and no stops: {DEFAULT_MAP}.",
    )
    stops: tuple[ColourStop, ...] | None = Field(
        None,
        description="[value, R, G, B] rows instead of a map, ascending, linear R,G,B; linear "
        "between, and beyond the ends as at the ends.",
    )
    range: tuple[Number, Number] | None = Field(
        None,
        description="Values [LOW, HIGH] that the map's ends stand for. Absent: the smallest and "
        "largest of the grid's active values.",
    )

    @field_validator("stops")
    @classmethod
    def _stops_ascend(cls, stops: tuple[ColourStop, ...] | None) -> tuple[ColourStop, ...] | None:
        if stops is not None:
            _check_stops([value for value, *_ in stops])
        return stops

    @field_validator("range")
    @classmethod
    def _range_is_not_empty(cls, ends: tuple[float, float] | None) -> tuple[float, float] | None:
        if ends is not None and not ends[0] < ends[1]:
            raise ValueError(
                f"must be [low, high] with low below high, not [{ends[0]:g}, {ends[1]:g}]"
            )
        return ends

    @model_validator(mode="after")
    def _map_or_stops(self) -> Ramp:
        for name in ("map", "range"):
            if self.stops is not None and getattr(self, name) is not None:
                raise ValueError(f"{name} is for a map; stops have values of their own: drop one")
        return self


class Blackbody(Part):
    """Colour of a body that glows at a temperature."""

    grid: str = Field(description="Scalar grid of temperatures.")
    scale: Number = Field(1.0, description="Kelvin per unit of the grid.")
    offset: Number = Field(0.0, description="Kelvin where the grid is 0.")
    normalized: Annotated[bool, Strict()] = Field(
        True,
        description="Whether luminance is 1 at every temperature above 0 K; else it is Planck's, "
        "in candela / m2, for a strength to bring down.",
    )


class Color(Part):
    """What a particle emits: one of a constant, a grid, a ramp or a blackbody."""

    constant: Colour | None = Field(
        None, description="One radiance for all, linear R,G,B. Absent, and no other: 1,1,1."
    )
    grid: str | None = Field(None, description="Vec3 grid of linear radiance, such as Cd.")
    ramp: Ramp | None = Field(None, description="Scalar grid through a colour map.")
    blackbody: Blackbody | None = Field(None, description="Temperature grid as Planck's colour.")
    strength: NotNegative = Field(1.0, description="What the colour is multiplied by.")
    file: Path | None = Field(
        None, description="Volume file of the colour's grid. Absent: density.file."
    )

    @model_validator(mode="after")
    def _one_source(self) -> Color:
        given = [name for name in SOURCES if getattr(self, name) is not None]
        if len(given) > 1:
            both = f"color.{given[0]} and color.{given[1]}"
            raise ValueError(f"{both} exclude each other; give one")
        return self

    @property
    def value(self) -> Colour:
        """The constant, or its default, times the strength."""
        r, g, b = (1.0, 1.0, 1.0) if self.constant is None else self.constant
        return r * self.strength, g * self.strength, b * self.strength


class Emission(Part):
    """Light emitted whatever the density, dL = T e ds: one of a grid, a ramp or a blackbody.

    e is radiance per world unit, and 0 outside the voxels of its grid.
    """

    grid: str | None = Field(
        None, description="Grid of emission: Vec3, or scalar, which is multiplied by constant."
    )
    constant: Colour | None = Field(
        None, description="Linear R,G,B where a scalar emission.grid is 1. Absent: 1,1,1."
    )
    ramp: Ramp | None = Field(None, description="Scalar grid through a colour map.")
    blackbody: Blackbody | None = Field(None, description="Temperature grid as Planck's colour.")
    strength: NotNegative = Field(
        1.0, description="What the emission is multiplied by, in 1 / world unit."
    )
    file: Path | None = Field(
        None, description="Volume file of the emission's grid. Absent: density.file."
    )

    @model_validator(mode="after")
    def _one_source(self) -> Emission:
        given = [n for n in ("grid", "ramp", "blackbody") if getattr(self, n) is not None]
        if len(given) > 1:
            both = f"emission.{given[0]} and emission.{given[1]}"
            raise ValueError(f"{both} exclude each other; give one")
        if self.constant is not None and self.grid is None:
            raise ValueError("emission.constant is for a scalar grid; name it as emission.grid")
        return self

    @property
    def wanted(self) -> bool:
        """Whether there is a source, and it is not dark."""
        named = any(n is not None for n in (self.grid, self.ramp, self.blackbody))
        return named and self.strength > 0


def _check_stops(values: list[float]) -> None:
    if not values:
        raise ValueError("must hold at least one stop")
    for before, value in pairwise(values):
        if not before < value:
            raise ValueError(f"must ascend; {value:g} follows {before:g}")
