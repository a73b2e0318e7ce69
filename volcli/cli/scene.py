"""The options that say what is looked at and from where, for commands that write no picture.

An EXR or a PNG of volcli's is a source as well: its header holds the job that made it.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from volcli.cli.options import numbers, option, size
from volcli.errors import UsageError

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


def job_of(
    source: Path,
    settings: Sequence[str] | None,
    *,
    grid: str | None = None,
    density_scale: float | None = None,
    color: str | None = None,
    color_grid: str | None = None,
    eye: str | None = None,
    target: str | None = None,
    up: str | None = None,
    fov: float | None = None,
    ortho: float | None = None,
    image_size: str | None = None,
    interpolation: str | None = None,
) -> Any:
    """The job of a volume, a job file or a picture of volcli's, with options on top.

    Raises
    ------
    UsageError
        In one line, for the first thing that is wrong.
    """
    if color is not None and color_grid is not None:
        raise UsageError("--color and --color-grid exclude each other; give one")
    if fov is not None and ortho is not None:
        raise UsageError("--fov and --ortho exclude each other; give one")
    lens = "perspective" if fov is not None else "orthographic" if ortho is not None else None
    given: list[tuple[str, str, Any, Any]] = [
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
    flags = [(key, value) for key, _, _, value in given if value is not None]
    spelled = {key: f"{flag} {text}" for key, flag, text, _ in given if text is not None}
    from volcli.config import load_job, make_job, parse_setting

    if source.suffix.lower() not in PICTURES:
        return load_job(source, flags=flags, settings=settings or [], spelled=spelled)
    from volcli.opacity.maps import job_of_picture

    extra = [parse_setting(text) for text in settings or []]
    spelled |= {key: f"--set {text}" for (key, _), text in zip(extra, settings or [], strict=True)}
    tables = job_of_picture(source)
    tables.pop("output", None)
    return make_job(tables, [*flags, *extra], source=str(source), spelled=spelled)
