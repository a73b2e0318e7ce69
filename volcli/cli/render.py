"""`volcli render`: one picture of a volume."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from volcli.cli.options import background as parse_background
from volcli.cli.options import numbers, option, size
from volcli.cli.progress import Bars
from volcli.cli.table import in_bytes, table
from volcli.errors import UsageError


def render(
    source: Annotated[
        Path, typer.Argument(help="A volume (.vdb, .npy, .npz) or a job file (.toml).")
    ],
    output: Annotated[Path | None, option("output.image", "-o", "--output", metavar="OUT")] = None,
    grid: Annotated[str | None, option("density.grid", "--grid", metavar="NAME")] = None,
    density_scale: Annotated[
        float | None, option("density.scale", "--density-scale", metavar="F")
    ] = None,
    color: Annotated[str | None, option("color.constant", "--color", metavar="R,G,B")] = None,
    color_grid: Annotated[str | None, option("color.grid", "--color-grid", metavar="NAME")] = None,
    eye: Annotated[str | None, option("camera.eye", "--eye", metavar="X,Y,Z")] = None,
    target: Annotated[str | None, option("camera.target", "--target", metavar="X,Y,Z")] = None,
    up: Annotated[str | None, option("camera.up", "--up", metavar="X,Y,Z")] = None,
    fov: Annotated[float | None, option("camera.fov", "--fov", metavar="DEG")] = None,
    ortho: Annotated[float | None, option("camera.width", "--ortho", metavar="WIDTH")] = None,
    image_size: Annotated[str | None, option("camera.resolution", "--size", metavar="WxH")] = None,
    step: Annotated[float | None, option("quadrature.step", "--step", metavar="VOXELS")] = None,
    interpolation: Annotated[
        str | None,
        option("density.interpolation", "--interpolation", metavar="linear|nearest"),
    ] = None,
    background: Annotated[
        str | None,
        typer.Option(
            metavar="transparent|R,G,B|IMAGE",
            help="What is behind the volume: nothing, a linear colour, or an image file.",
        ),
    ] = None,
    maps: Annotated[str | None, option("output.maps", "--maps", metavar="NAME,...")] = None,
    bits: Annotated[int | None, option("output.bits", "--bits", metavar="8|16")] = None,
    reader: Annotated[
        str | None, option("density.reader", "--reader", metavar="volcli|openvdb")
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Any field of the job; repeatable."),
    ] = None,
    threads: Annotated[
        int | None,
        typer.Option(min=1, metavar="N", help="Threads. [default: the processors there are]"),
    ] = None,
    overwrite: Annotated[bool, typer.Option(help="Whether files that exist are replaced.")] = True,
    explain: Annotated[
        bool, typer.Option("--explain", help="Print what is evaluated and why, and render.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
    quiet: Annotated[
        bool, typer.Option("--quiet", "-q", help="No progress and no notes, only warnings.")
    ] = False,
) -> None:
    """Render a picture of a volume, with its opacity, transmittance and depth.

    Flags win over a job file, which wins over defaults. Without a camera the volume is framed.
    """
    given: list[tuple[str, Any]] = [
        ("output.image", output),
        ("density.grid", grid),
        ("density.scale", density_scale),
        ("color.constant", numbers("--color", color)),
        ("color.grid", color_grid),
        ("camera.eye", numbers("--eye", eye)),
        ("camera.target", numbers("--target", target)),
        ("camera.up", numbers("--up", up)),
        ("camera.fov", fov),
        ("camera.type", None if ortho is None else "orthographic"),
        ("camera.width", ortho),
        ("camera.resolution", size(image_size)),
        ("quadrature.rule", None if step is None else "midpoint"),
        ("quadrature.step", step),
        ("density.interpolation", interpolation),
        ("output.maps", None if maps is None else [m.strip() for m in maps.split(",")]),
        ("output.bits", bits),
        ("density.reader", reader),
    ]
    from volcli.config import load_job
    from volcli.run import prepare, run

    if color is not None and color_grid is not None:
        raise UsageError("--color and --color-grid exclude each other; give one")
    job = load_job(
        source,
        flags=[*((k, v) for k, v in given if v is not None), *parse_background(background)],
        settings=settings or [],
    )
    prepared = prepare(job, overwrite=overwrite)
    with Bars(quiet) as bars:
        report = run(prepared, threads=threads, overwrite=overwrite, on_stage=bars)

    for warning in report.warnings:
        print(f"volcli: {warning}", file=sys.stderr)
    if as_json:
        printed = asdict(report)
        if explain:
            printed["plan"] = [asdict(term) for term in prepared.plan.terms]
        print(json.dumps(printed))
        return
    if job.camera.eye is None and not quiet:
        print(f"volcli: camera chosen: {_camera_flags(report.camera)}", file=sys.stderr)
    if explain:
        rows = [
            (t.name, "yes" if t.wanted else "no", t.grid or "-", _held(report.grids, t.grid), t.why)
            for t in prepared.plan.terms
        ]
        print(table(("term", "in", "grid", "memory", "why"), rows), end="\n\n")
    _print_summary(report)


def _held(grids: dict[str, int], grid: str | None) -> str:
    return in_bytes(grids[grid]) if grid in grids else "-"


def _camera_flags(camera: dict[str, Any]) -> str:
    """A camera as the flags that ask for it."""
    eye, target = (",".join(f"{v:.6g}" for v in camera[name]) for name in ("eye", "target"))
    lens = f"--ortho {camera['width']:.6g}" if "width" in camera else f"--fov {camera['fov']:g}"
    return f"--eye {eye} --target {target} {lens}"


def _print_summary(report: Any) -> None:
    width, height = report.size
    if report.image is not None:
        print(f"{report.image}  picture {width}x{height}")
    for name, written in report.maps.items():
        scale = ""
        if (written["black"], written["white"]) != (0.0, 1.0):
            scale = f", black is {written['black']:g}, white is {written['white']:g}"
        print(f"{written['file']}  {name}{scale}")
    t, s = report.transmittance, report.seconds
    print(
        f"{report.rule}: {report.rays:,} rays, {report.cells:,} evaluations; transmittance "
        f"{t['min']:.4g} to {t['max']:.4g}, mean {t['mean']:.4g}"
    )
    print(
        f"load {s['load']:.2f} s, compile {s['compile']:.2f} s, render {s['render']:.2f} s, "
        f"write {s['write']:.2f} s; peak memory {in_bytes(report.peak_memory_bytes)}"
    )
