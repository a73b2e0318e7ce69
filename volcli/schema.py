"""`Job`: all that a user may write, and the single home of names, defaults, ranges, units and help.

The command line, the reader of job files and the documentation derive from these models. They are
frozen and refuse keys that they do not know. What depends on a volume (a grid's name, the framing
of a camera) is not checked here.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    FiniteFloat,
    Strict,
    field_validator,
    model_validator,
)

Rule = Literal["exact", "midpoint"]
Interpolation = Literal["linear", "nearest"]
MapName = Literal["transmittance", "opacity", "optical_depth", "depth"]
MAPS: tuple[str, ...] = get_args(MapName)

Number = Annotated[FiniteFloat, Strict()]
"""A number that is written as one: neither true nor a number in quotes."""
Vector = tuple[Number, Number, Number]
Positive = Annotated[Number, Field(gt=0)]
Radiance = Annotated[Number, Field(ge=0)]
Colour = tuple[Radiance, Radiance, Radiance]
Pixels = Annotated[int, Strict(), Field(ge=1, le=65536)]

DEFAULT_STEP = 0.5


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=False)


class Density(_Part):
    """What is between the eye and the background."""

    file: Path | None = Field(None, description="Volume file: .vdb, .npy or .npz.")
    grid: str | None = Field(
        None, description="Density grid. Absent: 'density', else the only scalar grid there is."
    )
    scale: Positive = Field(1.0, description="Extinction per unit of density, in 1 / world unit.")
    interpolation: Interpolation = Field(
        "linear", description="Values between voxels: trilinear, or those of the nearest voxel."
    )
    nonfinite: Literal["error", "zero"] = Field(
        "error", description="What NaN and Inf in a grid are: an error, or taken as 0."
    )
    reader: Literal["volcli", "openvdb"] = Field(
        "volcli",
        description="Who reads .vdb files: volcli, or the OpenVDB library of an interpreter that "
        "has it (VOLCLI_OPENVDB_PYTHON names one).",
    )


class Color(_Part):
    """What a particle emits: one of a constant or a grid."""

    constant: Colour | None = Field(
        None, description="One radiance for all, linear R,G,B. Absent, and no grid: 1,1,1."
    )
    grid: str | None = Field(None, description="Vec3 grid of linear radiance, such as Cd.")

    @model_validator(mode="after")
    def _one_source(self) -> Color:
        if self.constant is not None and self.grid is not None:
            raise ValueError("color.constant and color.grid exclude each other; give one")
        return self

    @property
    def value(self) -> Colour:
        """The constant, or its default."""
        return (1.0, 1.0, 1.0) if self.constant is None else self.constant


class Camera(_Part):
    """Where the picture is taken from. What is absent is chosen to frame the volume."""

    type: Literal["perspective", "orthographic"] = Field(
        "perspective", description="Rays that spread from the eye, or parallel ones."
    )
    eye: Vector | None = Field(None, description="Position X,Y,Z in world units.")
    target: Vector | None = Field(None, description="Point X,Y,Z looked at, in world units.")
    up: Vector = Field((0.0, 1.0, 0.0), description="Direction X,Y,Z that is up in the picture.")
    fov: Annotated[Number, Field(gt=0, lt=180)] = Field(
        40.0, description="Vertical field of view of a perspective camera, in degrees."
    )
    width: Positive | None = Field(
        None, description="Width of an orthographic picture, in world units."
    )
    resolution: tuple[Pixels, Pixels] = Field(
        (800, 600), description="Size of the picture WxH, in pixels."
    )

    @field_validator("up")
    @classmethod
    def _up_points_somewhere(cls, up: Vector) -> Vector:
        if not any(up):
            raise ValueError("must not be 0,0,0")
        return up

    @model_validator(mode="after")
    def _width_is_orthographic(self) -> Camera:
        if self.width is not None and self.type != "orthographic":
            raise ValueError('camera.width is for camera.type = "orthographic"')
        return self


class Quadrature(_Part):
    """How light is summed up along a ray."""

    rule: Rule = Field(
        "exact",
        description="exact: optical depth right to rounding; midpoint: a sample in the middle of "
        "each step.",
    )
    step: Positive | None = Field(
        None,
        description="Step of the midpoint rule, in voxels; without it the rule is exact "
        f"(a job that names midpoint and no step takes {DEFAULT_STEP}).",
    )

    @model_validator(mode="after")
    def _step_is_midpoint(self) -> Quadrature:
        if self.step is not None and self.rule != "midpoint":
            raise ValueError('quadrature.step is for quadrature.rule = "midpoint"')
        return self

    @property
    def step_voxels(self) -> float | None:
        """The step of the midpoint rule, None for the exact rule."""
        if self.rule == "exact":
            return None
        return DEFAULT_STEP if self.step is None else self.step


class Background(_Part):
    """What is behind the volume: one of a colour or an image; absent: nothing (transparent)."""

    color: Colour | None = Field(None, description="Linear R,G,B.")
    image: Path | None = Field(None, description="Image file, fitted to the picture's size.")

    @model_validator(mode="after")
    def _one_background(self) -> Background:
        if self.color is not None and self.image is not None:
            raise ValueError("background.color and background.image exclude each other; give one")
        return self


class Output(_Part):
    """What is written."""

    image: Path | None = Field(None, description="Picture: .exr (everything in it) or .png.")
    maps: tuple[MapName, ...] = Field(
        (), description=f"Maps to write beside the picture: {', '.join(MAPS)}."
    )
    bits: Literal[8, 16] = Field(8, description="Bits a channel of a PNG picture: 8 or 16.")


class Job(_Part):
    """One picture of one volume."""

    density: Density = Density()
    color: Color = Color()
    camera: Camera = Camera()
    quadrature: Quadrature = Quadrature()
    background: Background = Background()
    output: Output = Output()


def field(key: str) -> tuple[str, Any]:
    """(help, default) of a field by its dotted name, such as ``density.scale``.

    Raises
    ------
    KeyError
        If there is no such field.
    """
    part, name = key.split(".")
    annotation = Job.model_fields[part].annotation
    assert isinstance(annotation, type) and issubclass(annotation, _Part)
    info = annotation.model_fields[name]
    return info.description or "", info.default
