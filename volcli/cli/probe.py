"""`volcli probe`: one ray through a scene, in numbers and as a plot."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from volcli.cli import scene as options
from volcli.cli.progress import Bars
from volcli.cli.table import say, say_json, table, terminal_width
from volcli.errors import UsageError

_ROWS = 24
"""Rows of the table of a ray on a terminal; --csv and --json have them all."""

_BRICKS = 12


def probe(
    source: Annotated[
        Path,
        typer.Argument(help="A volume, a job file (.toml), or a picture that volcli rendered."),
    ],
    pixel: Annotated[
        list[str] | None,
        typer.Option(metavar="X,Y", help="The ray through this pixel; repeatable. 0,0: top left."),
    ] = None,
    ray: Annotated[
        list[str] | None,
        typer.Option(
            metavar="OX,OY,OZ,DX,DY,DZ",
            help="The ray from a point in a direction, in world units; repeatable.",
        ),
    ] = None,
    step: Annotated[
        list[float] | None,
        typer.Option(
            metavar="VOXELS",
            help="Show what the midpoint rule makes of it with this step; repeatable. [default: "
            "the job's step, else 1]",
        ),
    ] = None,
    csv: Annotated[
        Path | None, typer.Option("--csv", metavar="OUT.csv", help="Write the whole table.")
    ] = None,
    plot: Annotated[
        Path | None,
        typer.Option(
            metavar="OUT", help="Draw sigma, T, weight and radiance, as .png, .svg or .pdf."
        ),
    ] = None,
    grid: options.Grid = None,
    density_scale: options.DensityScale = None,
    color: options.Color = None,
    color_grid: options.ColorGrid = None,
    eye: options.Eye = None,
    target: options.Target = None,
    up: options.Up = None,
    fov: options.Fov = None,
    ortho: options.Ortho = None,
    image_size: options.Size = None,
    interpolation: options.Interpolation = None,
    settings: options.Settings = None,
    overwrite: Annotated[bool, typer.Option(help="Whether files that exist are replaced.")] = True,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object, with every cell and sample.")
    ] = False,
) -> None:
    """Follow rays through a scene.

    Extinction, optical depth, transmittance, weight and light on the way; the bricks that are met;
    what each rule makes of it, against a slow walk in float64 that shares no code with them.
    """
    pixels = [_numbers("--pixel", text, 2) for text in pixel or []]
    lines = [_numbers("--ray", text, 6) for text in ray or []]
    if not pixels and not lines:
        raise UsageError("which ray: give --pixel X,Y, or --ray OX,OY,OZ,DX,DY,DZ")
    if any(not (0 < s < math.inf) for s in step or []):
        raise UsageError("--step: must be above 0")
    flags = options.scene_flags(
        grid=grid,
        density_scale=density_scale,
        color=color,
        color_grid=color_grid,
        eye=eye,
        target=target,
        up=up,
        fov=fov,
        ortho=ortho,
        image_size=image_size,
        interpolation=interpolation,
    )
    job = options.job_of(source, flags, settings or [])
    from volcli.files import FIGURES, write_file
    from volcli.images import check_output
    from volcli.probe.rays import probe_job
    from volcli.probe.report import as_csv

    if csv is not None:
        check_output(csv, overwrite=overwrite, kinds=(".csv",))
    if plot is not None:
        check_output(plot, overwrite=overwrite, kinds=FIGURES)
    with Bars(quiet=False) as bars:
        found, walks, warnings = probe_job(job, pixels, lines, step, bars)
    _warn(warnings)
    if csv is not None:
        write_file(csv, as_csv(found), overwrite=overwrite)
    if plot is not None:
        from volcli.probe.plot import write_plot

        write_plot(plot, walks, found, overwrite=overwrite)
    if as_json:
        say_json({"rays": found})
        return
    say("\n\n".join(_summary(one) for one in found))
    for written in (csv, plot):
        if written is not None:
            say(str(written))


def _warn(warnings: list[str]) -> None:
    for warning in warnings:
        print(f"volcli: {warning}", file=sys.stderr)


def _numbers(flag: str, text: str, count: int) -> tuple[float, ...]:
    """Numbers separated by commas; those of a pixel are whole.

    Raises
    ------
    UsageError
        Naming the flag and what it takes.
    """
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) != count or not all(math.isfinite(v) for v in values):
        raise UsageError(f"{flag} {text}: give {count} numbers separated by commas")
    if count == 2 and not all(v == int(v) and v >= 0 for v in values):
        raise UsageError(f"{flag} {text}: give whole numbers from 0, column and row")
    return values


def _summary(found: dict[str, Any]) -> str:
    from volcli.probe.plot import title_of

    def listed(values: list[float]) -> str:
        return ",".join(f"{v:.6g}" for v in values)

    lines = [
        f"{title_of(found)}  from {listed(found['origin'])} along {listed(found['direction'])}"
    ]
    if found["range"] is None:
        return f"{lines[0]}\nmeets no grid: its opacity is 0"
    near, far = found["range"]
    lines.append(
        f"in the volume from {near:.6g} to {far:.6g}: optical depth {found['optical_depth']:.6g}, "
        f"transmittance {found['transmittance']:.6g}, opacity {found['opacity']:.6g}, radiance "
        f"{listed(found['radiance'])}"
    )
    if found["distance"] is not None:
        lines.append(
            f"mean hit at distance {found['distance']:.6g}, depth {found['depth']:.6g}; T falls "
            + ", ".join(f"to {T} {_where(at)}" for T, at in found["falls"].items())
        )
    return "\n".join([*lines, "", _cells(found), "", _bricks(found), "", _rules(found)])


def _where(at: float | None) -> str:
    return "nowhere" if at is None else f"at {at:.6g}"


def _cells(found: dict[str, Any]) -> str:
    from volcli.probe.report import folded

    cells = found["cells"]
    head = ["from", "to", "sigma", "tau", "T", "weight", "red", "green", "blue"]
    rows = [[f"{value:.5g}" for value in row] for row in folded(cells, _ROWS)]
    if not rows:
        return "no density and no light on the way"
    count = len(cells["begin"])
    note = f"\n{count} cells, joined to {len(rows)} rows" if count > len(rows) else ""
    return table(head, rows, terminal_width()) + note


def _bricks(found: dict[str, Any]) -> str:
    met = found["bricks"]
    if not met:
        return "meets no brick"
    shown = met if len(met) <= _BRICKS else [*met[: _BRICKS // 2], *met[-_BRICKS // 2 :]]
    rows = [
        [
            brick["kind"],
            "-" if brick["index"] is None else ",".join(map(str, brick["index"])),
            *(f"{brick[key]:.5g}" for key in ("begin", "end", "optical_depth")),
            " .. ".join(f"{v:.4g}" for v in brick["density"]),
        ]
        for brick in shown
    ]
    head = ["met", "index", "from", "to", "tau", "density in it"]
    left = len(met) - len(shown)
    note = f"\nand {left} more between" if left else ""
    return table(head, rows, terminal_width()) + note


def _certified(rule: dict[str, Any]) -> str:
    return "-" if rule["error_bound"] is None else f"{rule['error_bound']:.1e}"


def _rules(found: dict[str, Any]) -> str:
    certified = any(rule["error_bound"] is not None for rule in found["rules"])
    rows = [
        [
            rule["rule"],
            f"{rule['evaluations']:,}",
            f"{rule['optical_depth']:.8g}",
            f"{rule['transmittance']:.8g}",
            ",".join(f"{v:.5g}" for v in rule["radiance"]),
            f"{rule['error']:.1e}",
            *([_certified(rule)] if certified else []),
        ]
        for rule in found["rules"]
    ]
    head = ["rule", "evaluations", "optical depth", "transmittance", "radiance", "error of T"]
    if certified:
        head.append("certified")
    return table(head, rows, terminal_width())
