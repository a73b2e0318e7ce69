"""What a batch file may hold besides jobs: the single home of its names, defaults, ranges and help.

The tables of a job are those of `volcli.schema.Job`; they are checked once a job is whole.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, Strict, field_validator

from volcli.schema import Number, Vector

Count = Annotated[int, Strict(), Field(ge=1, le=1_000_000)]


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=False)


class Orbit(_Part):
    """A turntable: the camera goes around its target."""

    frames: Count | None = Field(
        None,
        description="Pictures of the whole way. Absent, with a sequence of files: one each.",
    )
    axis: Literal["x", "y", "z"] | Vector = Field(
        "y", description="What the camera turns about, counter-clockwise: x, y, z or [X, Y, Z]."
    )
    degrees: Number = Field(
        360.0, description="How far it turns. The last picture is one step short of it."
    )

    @field_validator("axis")
    @classmethod
    def _axis_points_somewhere(cls, axis: Any) -> Any:
        if not isinstance(axis, str) and not any(axis):
            raise ValueError("must not be 0,0,0")
        return axis

    @property
    def vector(self) -> Vector:
        """The axis as X,Y,Z."""
        if not isinstance(self.axis, str):
            return self.axis
        x, y, z = (float(self.axis == name) for name in "xyz")
        return x, y, z


class Expansion(_Part):
    """What makes many jobs of one: at the top of the file for all jobs, or in one [[job]]."""

    frames: str | None = Field(
        None,
        description="Frames of files named with ####, %04d or $F4: ranges such as 1-100x2,150. "
        "Absent: those that there are.",
    )
    sweep: dict[str, tuple[Any, ...]] = Field(
        {},
        description="Fields with a list of values each, such as quadrature.step = [0.5, 1]; a job "
        "for each combination.",
    )
    orbit: Orbit | None = Field(None, description="A turntable: the camera goes around.")

    @field_validator("sweep", mode="before")
    @classmethod
    def _sweep_is_flat(cls, sweep: Any) -> Any:
        """``quadrature.step = [...]`` without quotes is a table in a table; both are meant."""
        if not isinstance(sweep, Mapping):
            return sweep
        flat: dict[str, Any] = {}
        for name, values in sweep.items():
            inner = values.items() if isinstance(values, Mapping) else [(None, values)]
            flat |= {name if key is None else f"{name}.{key}": v for key, v in inner}
        for name, values in flat.items():
            if "." not in name or not isinstance(values, list) or not values:
                raise ValueError(
                    f"{name}: write PART.FIELD with a list of values, such as "
                    '"density.scale" = [1, 2]'
                )
        return flat


class Batch(Expansion):
    """A batch file."""

    retries: Annotated[int, Strict(), Field(ge=0, le=100)] = Field(
        1, description="How often a job that failed is tried again, at the end of the batch."
    )
    manifest: Path | None = Field(
        None,
        description="File that records what is done. Absent: NAME.manifest.jsonl in the folder "
        "that all outputs lie in.",
    )
    defaults: dict[str, Any] = Field({}, description="A job: what all jobs start from.")
    job: tuple[dict[str, Any], ...] = Field(
        (), description="Jobs: what each has besides the defaults. Absent: one, the defaults."
    )


EXPANSIONS = tuple(Expansion.model_fields)
"""Keys of a [[job]] that are no tables of a job."""


def described(name: str) -> tuple[str, Any]:
    """(help, default) of a key of the batch file."""
    info = Batch.model_fields[name]
    return info.description or "", info.default
