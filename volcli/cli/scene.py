"""The options that say what is seen and from where, which `render` and `probe` have in common.

To `probe` a picture of volcli's is a source as well: its header holds the job that made it.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from volcli.cli.options import numbers, option, size
from volcli.errors import UsageError

if TYPE_CHECKING:
    from volcli.schema import Job

Grid = Annotated[str | None, option("density.grid", "--grid", metavar="NAME")]
DensityScale = Annotated[float | None, option("density.scale", "--density-scale", metavar="F")]
Color = Annotated[str | None, option("color.constant", "--color", metavar="R,G,B")]
ColorGrid = Annotated[str | None, option("color.grid", "--color-grid", metavar="NAME")]
Eye = Annotated[str | None, option("camera.eye", "--eye", metavar="X,Y,Z")]
Target = Annotated[str | None, option("camera.target", "--target", metavar="X,Y,Z")]
Up = Annotated[str | None, option("camera.up", "--up", metavar="X,Y,Z")]
Fov = Annotated[float | None, option("camera.fov", "--fov", metavar="DEG")]
Ortho = Annotated[float | None, option("camera.width", "--ortho", metavar="WIDTH")]
Size = Annotated[str | None, option("camera.resolution", "--size", metavar="WxH")]
Interpolation = Annotated[
    str | None, option("density.interpolation", "--interpolation", metavar="linear|nearest")
]
Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Any field of the job, such as density.nonfinite=zero; repeatable. No VALUE: the "
        "default.",
    ),
]

PICTURES = (".exr", ".png")


Flag = tuple[str, str, Any, Any]
"""(key of the job, flag, what was given, the value that it stands for); None where not given."""


def scene_flags(
    *,
    grid: str | None,
    density_scale: float | None,
    color: str | None,
    color_grid: str | None,
    eye: str | None,
    target: str | None,
    up: str | None,
    fov: float | None,
    ortho: float | None,
    image_size: str | None,
    interpolation: str | None,
) -> list[Flag]:
    """The options of this module as settings of the job.

    Raises
    ------
    UsageError
        Two exclude each other, or one is not what it takes.
    """
    if color is not None and color_grid is not None:
        raise UsageError("--color and --color-grid exclude each other; give one")
    if fov is not None and ortho is not None:
        raise UsageError("--fov and --ortho exclude each other; give one")
    lens = "perspective" if fov is not None else "orthographic" if ortho is not None else None
    return [
        ("density.grid", "--grid", grid, grid),
        ("density.scale", "--density-scale", density_scale, density_scale),
        ("color.constant", "--color", color, numbers("--color", color)),
        ("color.grid", "--color-grid", color_grid, color_grid),
        ("camera.eye", "--eye", eye, numbers("--eye", eye)),
        ("camera.target", "--target", target, numbers("--target", target)),
        ("camera.up", "--up", up, numbers("--up", up)),
        ("camera.type", "--fov or --ortho", lens, lens),
        ("camera.fov", "--fov", fov, fov),
        ("camera.width", "--ortho", ortho, ortho),
        ("camera.resolution", "--size", image_size, size(image_size)),
        ("density.interpolation", "--interpolation", interpolation, interpolation),
    ]


def rule_flags(
    step: float | None, max_error: float | None, target_error: float | None
) -> list[Flag]:
    """The options that choose the rule of integration as settings of the job.

    Raises
    ------
    UsageError
        Two exclude each other.
    """
    given = {"--step": step, "--max-error": max_error, "--target-error": target_error}
    named = [flag for flag, value in given.items() if value is not None]
    if len(named) > 1:
        raise UsageError(f"{' and '.join(named)} exclude each other; give one")
    return [
        ("quadrature.rule", "--step", step, None if step is None else "midpoint"),
        ("quadrature.step", "--step", step, step),
        ("quadrature.max_error", "--max-error", max_error, max_error),
        ("quadrature.target_error", "--target-error", target_error, target_error),
    ]


def values_of(flags: Sequence[Flag]) -> list[tuple[str, Any]]:
    """(key, value) of the options that were given."""
    return [(key, value) for key, _, _, value in flags if value is not None]


def spellings_of(flags: Sequence[Flag]) -> dict[str, str]:
    """How the user wrote the options that were given, by key: ``--step 0``."""
    return {key: f"{flag} {_typed(text)}" for key, flag, text, _ in flags if text is not None}


def _typed(value: Any) -> str:
    """A value about as it was typed: 0 rather than 0.0."""
    return f"{value:g}" if isinstance(value, float) else str(value)


def job_of(source: Path, flags: Sequence[Flag], settings: Sequence[str]) -> Job:
    """The job of a volume, a job file or a picture of volcli's, with options on top.

    Raises
    ------
    UsageError
        In one line, for the first thing that is wrong.
    """
    from volcli.config import load_job, make_job, parse_setting

    spelled = spellings_of(flags)
    if source.suffix.lower() not in PICTURES:
        return load_job(source, flags=values_of(flags), settings=settings, spelled=spelled)
    from volcli.opacity.maps import job_of_picture

    extra = [parse_setting(text) for text in settings]
    spelled |= {key: f"--set {text}" for (key, _), text in zip(extra, settings, strict=True)}
    tables = job_of_picture(source)
    tables.pop("output", None)
    return make_job(tables, [*values_of(flags), *extra], source=str(source), spelled=spelled)
