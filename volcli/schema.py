"""`Job`: all that a user may write, and the single home of names, defaults, ranges, units and help.

The command line, the reader of job files and the documentation derive from these models. They are
frozen and refuse keys that they do not know. What depends on a volume (a grid's name, the framing
of a camera) is not checked here.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from pydantic import AfterValidator, BaseModel, Field, Strict, field_validator, model_validator

from volcli.fields import Colour, NotNegative, Number, Part, Pixels, Positive, Vector
from volcli.sources import Color, DensityRamp, Emission

Rule = Literal["exact", "midpoint"]
Interpolation = Literal["linear", "nearest"]
MapName = Literal[
    "transmittance", "opacity", "optical_depth", "depth", "error_bound", "error_estimate"
]
MAPS: tuple[str, ...] = get_args(MapName)

FINEST_ERROR = 1e-6
"""The smallest error that may be asked for: a pixel's float32 is off by 6e-8 already."""

DEFAULT_STEP = 0.5
DEFAULT_FOV = 40.0
DEFAULT_SIZES = {"perspective": (800, 600), "orthographic": (800, 600), "panorama": (1024, 512)}

Focal = Annotated[Number, Field(ge=1e-6)]

_LENS = {
    "fov": "perspective",
    "focal": "perspective",
    "principal": "perspective",
    "width": "orthographic",
}
"""Fields of a camera that only one type of camera has."""


class Density(Part):
    """What is between the eye and the background."""

    file: Path | None = Field(None, description="Volume file: .vdb, .npy or .npz.")
    grid: str | None = Field(
        None, description="Density grid. Absent: 'density', else the only scalar grid there is."
    )
    scale: NotNegative = Field(
        1.0,
        description="Extinction per unit of density, in 1 / world unit; 0: nothing is absorbed, "
        "and no density is read.",
    )
    interpolation: Interpolation = Field(
        "linear", description="Values between voxels: trilinear, or those of the nearest voxel."
    )
    nonfinite: Literal["error", "zero"] = Field(
        "error", description="What NaN and Inf in a grid are: an error, or taken as 0."
    )
    tint: Colour | None = Field(
        None,
        description="Factors R,G,B of the extinction, for smoke that filters colour. Absent: "
        "1,1,1.",
    )
    ramp: DensityRamp | None = Field(
        None, description="Transfer function from the grid's values to densities, before scale."
    )
    level_set: Literal["fog"] | None = Field(
        None,
        description="fog: a level set is taken as fog, from 0 at its surface to 1 within, by "
        "OpenVDB's sdfToFogVolume. Absent: a level set is refused.",
    )
    reader: Literal["volcli", "openvdb"] = Field(
        "volcli",
        description="Who reads .vdb files: volcli, or the OpenVDB library of an interpreter that "
        "has it (VOLCLI_OPENVDB_PYTHON names one).",
    )

    @field_validator("tint")
    @classmethod
    def _tint_filters_something(cls, tint: Colour | None) -> Colour | None:
        if tint is not None and not any(tint):
            raise ValueError("must not be 0,0,0; density.scale = 0 absorbs nothing")
        return tint


class Camera(Part):
    """Where the picture is taken from. What is absent is chosen to frame the volume."""

    type: Literal["perspective", "orthographic", "panorama"] = Field(
        "perspective",
        description="Rays that spread from the eye; parallel ones; or all around it, 360 x 180 "
        "degrees (equirectangular, the target in the middle).",
    )
    eye: Vector | None = Field(
        None,
        description="Position X,Y,Z in world units. Absent: where all of the volume is seen; for a "
        "panorama, in its middle.",
    )
    target: Vector | None = Field(None, description="Point X,Y,Z looked at, in world units.")
    up: Vector = Field((0.0, 1.0, 0.0), description="Direction X,Y,Z that is up in the picture.")
    fov: Annotated[Number, Field(gt=0, lt=180)] | None = Field(
        None,
        description="Vertical field of view of a perspective camera, in degrees. Absent: "
        f"{DEFAULT_FOV:g}.",
    )
    width: Positive | None = Field(
        None, description="Width of an orthographic picture, in world units."
    )
    focal: tuple[Focal, Focal] | None = Field(
        None,
        description="Focal lengths of a perspective camera across and down, in pixels; instead of "
        "fov, and with eye and target.",
    )
    principal: tuple[Number, Number] | None = Field(
        None,
        description="Where focal's axis meets the picture: pixels from its left and from its top. "
        "Absent: the middle.",
    )
    transforms: Path | None = Field(
        None,
        description="A NeRF transforms.json with cameras, instead of all the above; in the "
        "volume's world units, as they are stored.",
    )
    frame: int | Literal["all"] | None = Field(
        None,
        description='Which camera of transforms: its number from 0, or "all", a picture each, '
        "OUT.0000.exr and so on. Absent: 0.",
    )
    resolution: tuple[Pixels, Pixels] | None = Field(
        None,
        description="Size of the picture WxH, in pixels. Absent: 800x600, a panorama 1024x512, "
        "or what transforms says.",
    )
    samples: Annotated[int, Strict(), Field(ge=1, le=4096)] = Field(
        1,
        description="Rays a pixel, spread over it evenly; the picture is their mean. 1: through "
        "its middle.",
    )

    @field_validator("up")
    @classmethod
    def _up_points_somewhere(cls, up: Vector) -> Vector:
        if not any(up):
            raise ValueError("must not be 0,0,0")
        return up

    @field_validator("frame", mode="before")
    @classmethod
    def _frame_is_a_number_or_all(cls, frame: Any) -> Any:
        if frame is None or frame == "all" or (type(frame) is int and frame >= 0):
            return frame
        raise ValueError(f'must be a whole number from 0, or "all", not {frame!r}')

    @model_validator(mode="after")
    def _fields_go_together(self) -> Camera:
        def given(*names: str) -> list[str]:
            return [name for name in names if getattr(self, name) is not None]

        if self.transforms is not None:
            for name in given("eye", "target", "fov", "width", "focal", "principal"):
                raise ValueError(f"camera.{name} is for a camera without camera.transforms")
            for name, default in (("type", "perspective"), ("up", (0.0, 1.0, 0.0))):
                if getattr(self, name) != default:
                    raise ValueError(f"camera.{name} is for a camera without camera.transforms")
        elif self.frame is not None:
            raise ValueError("camera.frame is for camera.transforms; give that file")
        for name, kind in _LENS.items():
            if self.type != kind and given(name):
                raise ValueError(f'camera.{name} is for camera.type = "{kind}"')
        if self.focal is not None and self.fov is not None:
            raise ValueError("camera.focal and camera.fov exclude each other; give one")
        if self.focal is not None and len(given("eye", "target")) < 2:
            raise ValueError("camera.focal is for a camera with camera.eye and camera.target")
        if self.principal is not None and self.focal is None:
            raise ValueError("camera.principal is for a camera with camera.focal")
        return self

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels: as asked for, or the default of the camera's type."""
        return self.resolution or DEFAULT_SIZES[self.type]


def _writable(error: float) -> float:
    if 0 < error < FINEST_ERROR:
        raise ValueError(
            f"must be 0, which is exact, or at least {FINEST_ERROR:g}: pixels are float32"
        )
    return error


Error = Annotated[Number, Field(ge=0, lt=1), AfterValidator(_writable)]


class Quadrature(Part):
    """How light is summed up along a ray."""

    rule: Rule = Field(
        "exact",
        description="exact: optical depth right to rounding, or as right as max_error asks; "
        "midpoint: a sample in the middle of each step.",
    )
    step: Positive | None = Field(
        None,
        description="Step of the midpoint rule, in voxels; without it the rule is exact "
        f"(a job that names midpoint and no step takes {DEFAULT_STEP}).",
    )
    max_error: Error | None = Field(
        None,
        description="Error that transmittance, and radiance as a share of the brightest, may have "
        "at most: certified, pixel by pixel. 0: exact.",
    )
    target_error: Error | None = Field(
        None,
        description="Error that pixels should stay below, judged by some rays of the picture: an "
        "estimate. The longest step that does is taken, or the exact rule.",
    )

    @model_validator(mode="after")
    def _one_way(self) -> Quadrature:
        if self.step is not None and self.rule != "midpoint":
            raise ValueError('quadrature.step is for quadrature.rule = "midpoint"')
        if self.max_error is not None and self.rule != "exact":
            raise ValueError('quadrature.max_error is for quadrature.rule = "exact"')
        if self.target_error is not None:
            if self.rule != "exact":
                raise ValueError(
                    "quadrature.target_error chooses the rule; leave out quadrature.rule and step"
                )
            if self.max_error is not None:
                raise ValueError(
                    "quadrature.max_error and quadrature.target_error exclude each other; give one"
                )
        return self

    @property
    def step_voxels(self) -> float | None:
        """The step of the midpoint rule, None for the exact rule."""
        if self.rule == "exact":
            return None
        return DEFAULT_STEP if self.step is None else self.step


class Background(Part):
    """What is behind the volume: one of a colour or an image; absent: nothing (transparent)."""

    color: Colour | None = Field(None, description="Linear R,G,B.")
    image: Path | None = Field(None, description="Image file, fitted to the picture's size.")

    @model_validator(mode="after")
    def _one_background(self) -> Background:
        if self.color is not None and self.image is not None:
            raise ValueError("background.color and background.image exclude each other; give one")
        return self


class Output(Part):
    """What is written."""

    image: Path | None = Field(None, description="Picture: .exr (everything in it) or .png.")
    maps: tuple[MapName, ...] = Field(
        (), description=f"Maps to write beside the picture: {', '.join(MAPS)}."
    )
    bits: Literal[8, 16] = Field(8, description="Bits a channel of a PNG picture: 8 or 16.")


class Job(Part):
    """One picture of one volume."""

    density: Density = Density()
    color: Color = Color()
    emission: Emission = Emission()
    camera: Camera = Camera()
    quadrature: Quadrature = Quadrature()
    background: Background = Background()
    output: Output = Output()

    @model_validator(mode="after")
    def _something_is_seen(self) -> Job:
        if self.density.scale == 0 and not self.emission.wanted:
            raise ValueError(
                "density.scale is 0 and nothing is emitted, so there is nothing to see; give a "
                "scale above 0, or an [emission]"
            )
        return self

    @model_validator(mode="after")
    def _bounds_are_of_an_error(self) -> Job:
        if "error_bound" in self.output.maps and not self.quadrature.max_error:
            raise ValueError(
                "output.maps: error_bound is what quadrature.max_error certifies; give one above 0"
            )
        return self

    @model_validator(mode="after")
    def _estimates_are_of_the_exact_rule(self) -> Job:
        wanted, how = "error_estimate" in self.output.maps, self.quadrature
        if wanted and (how.rule != "exact" or how.max_error or how.target_error):
            raise ValueError(
                "output.maps: error_estimate is of the exact rule; leave it out, or "
                "quadrature.rule, max_error and target_error"
            )
        return self


def field(key: str) -> tuple[str, Any]:
    """(help, default) of a field by its dotted name: ``density.scale``, ``color.ramp.map``.

    The default of a field that must be given is None.

    Raises
    ------
    KeyError
        If there is no such field.
    """
    model: type[BaseModel] = Job
    *tables, name = key.split(".")
    for table in tables:
        inner = table_of(model, table)
        if inner is None:
            raise KeyError(key)
        model = inner
    info = model.model_fields[name]
    default = None if info.is_required() else info.default
    return info.description or "", default


def keys(model: type[BaseModel] = Job, prefix: str = "") -> list[str]:
    """The dotted names of all fields, tables before what they hold."""
    found = []
    for name in model.model_fields:
        found.append(prefix + name)
        inner = table_of(model, name)
        if inner is not None:
            found += keys(inner, f"{prefix}{name}.")
    return found


def table_of(model: type[BaseModel], name: str) -> type[BaseModel] | None:
    """The model of a field that is a table, or None where the field is a value.

    Raises
    ------
    KeyError
        If there is no such field.
    """
    annotation = model.model_fields[name].annotation
    for kind in (annotation, *get_args(annotation)):
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            return kind
    return None
