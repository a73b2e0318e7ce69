"""`volcli render`: one picture of a volume."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from volcli.cli import scene as options
from volcli.cli.options import background as parse_background
from volcli.cli.options import names, option
from volcli.cli.progress import Bars
from volcli.cli.table import in_bytes, say, table, terminal_width
from volcli.errors import BatchError, VolcliError

if TYPE_CHECKING:
    from volcli.plan import Plan, Term
    from volcli.render import Scene
    from volcli.run import Report
    from volcli.schema import Job


def render(
    source: Annotated[
        Path, typer.Argument(help="A volume (.vdb, .npy, .npz) or a job file (.toml).")
    ],
    output: Annotated[Path | None, option("output.image", "-o", "--output", metavar="OUT")] = None,
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
    step: Annotated[float | None, option("quadrature.step", "--step", metavar="VOXELS")] = None,
    max_error: Annotated[
        float | None, option("quadrature.max_error", "--max-error", metavar="E")
    ] = None,
    target_error: Annotated[
        float | None, option("quadrature.target_error", "--target-error", metavar="E")
    ] = None,
    interpolation: options.Interpolation = None,
    background: Annotated[
        str | None,
        typer.Option(
            metavar="transparent|R,G,B|IMAGE",
            help="What is behind the volume: nothing, a linear colour, or an image file. "
            "[default: transparent]",
        ),
    ] = None,
    maps: Annotated[str | None, option("output.maps", "--maps", metavar="NAME,...")] = None,
    bits: Annotated[int | None, option("output.bits", "--bits", metavar="8|16")] = None,
    reader: Annotated[
        str | None, option("density.reader", "--reader", metavar="volcli|openvdb")
    ] = None,
    settings: options.Settings = None,
    frames: Annotated[
        str | None,
        typer.Option(
            "--frames",
            metavar="RANGES",
            help="Frames of files named with ####, %04d or $F4: 7, 1-100, or 1-100x2,150. One that "
            "fails does not stop the others.",
        ),
    ] = None,
    threads: Annotated[
        int | None,
        typer.Option(min=1, metavar="N", help="Threads. [default: the processors there are]"),
    ] = None,
    cache: Annotated[
        Path | None,
        typer.Option(
            "--cache",
            metavar="DIR",
            help="Folder that keeps what is made of a volume, so that its next picture loads at "
            "once. [default: none]",
        ),
    ] = None,
    max_memory: Annotated[
        str | None,
        typer.Option(
            "--max-memory",
            metavar="SIZE",
            help="Memory that may be taken: 8GB, or a share of what is free. What would take more "
            "is refused before it is read. [default: 75%]",
        ),
    ] = None,
    overwrite: Annotated[bool, typer.Option(help="Whether files that exist are replaced.")] = True,
    explain: Annotated[
        bool,
        typer.Option(
            "--explain",
            help="Print what is read and evaluated, and why. Without an output (-o, or one in the "
            "job) grids are read, and nothing is rendered.",
        ),
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
    quiet: Annotated[
        bool, typer.Option("--quiet", "-q", help="No progress and no notes, only warnings.")
    ] = False,
) -> None:
    """Render a picture of a volume.

    An EXR also holds its opacity, transmittance, optical depth and depth. Flags win over a job
    file, which wins over defaults. Without a camera the volume is framed.
    """
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
    flags += [
        ("output.image", "-o", output, output),
        *options.rule_flags(step, max_error, target_error),
        ("output.maps", "--maps", maps, names(maps)),
        ("output.bits", "--bits", bits, bits),
        ("density.reader", "--reader", reader, reader),
    ]
    behind = parse_background(background)
    spelled = options.spellings_of(flags)
    spelled |= {key: f"--background {background}" for key, _ in behind}
    from volcli.config import load_job

    job = load_job(
        source,
        flags=[*options.values_of(flags), *behind],
        settings=settings or [],
        spelled=spelled,
    )

    from volcli.memory import parse_memory

    memory = None if max_memory is None else parse_memory(max_memory, "--max-memory")

    def pictures_of(one: Job) -> None:
        _render(one, threads, cache, memory, overwrite, explain, as_json, quiet)

    if frames is None:
        pictures_of(job)
    else:
        _each_frame(job, frames, pictures_of, quiet)


def _each_frame(job: Job, frames: str, render_one: Callable[[Job], None], quiet: bool) -> None:
    """The frames of a sequence, one after another; what fails is told, and the rest goes on."""
    from volcli.batch.expand import expand_frames
    from volcli.batch.frames import as_ranges
    from volcli.batch.orbit import is_framed

    if is_framed(job.camera) and not quiet:
        _warn(["no camera: each frame is framed by itself; --eye and --target keep it still"])
    failed = []
    jobs = expand_frames(job, frames)
    for frame, one in jobs:
        try:
            render_one(one)
        except VolcliError as error:
            if len(jobs) == 1:
                raise
            print(f"volcli: frame {frame}: {error}", file=sys.stderr)
            failed.append(frame)
    if failed:
        raise BatchError(f"{len(failed)} of {len(jobs)} frames failed: {as_ranges(failed)}")


def _render(
    job: Job,
    threads: int | None,
    cache: Path | None,
    memory: int | None,
    overwrite: bool,
    explain: bool,
    as_json: bool,
    quiet: bool,
) -> None:
    """The pictures of a job, and what is printed of them."""
    from volcli.estimate import PROCESS, needed_memory
    from volcli.run import load, prepare_each, run

    pictures = prepare_each(job, overwrite=overwrite, writes=not explain)
    prepared = pictures[0]
    needed = 0
    if explain:
        pixels = None if prepared.files else 0
        needed = PROCESS + needed_memory(prepared.job, prepared.plan, prepared.volumes, pixels)
    with Bars(quiet) as bars:
        loaded = load(prepared, bars, cache, threads, memory)
        held = _held(loaded.scene)
        if explain and not as_json:
            say(_explained(prepared.plan, held))
            say(f"\nrule: {prepared.plan.rule}")
            say(f"memory: about {in_bytes(needed)} at its peak")
        if not prepared.files:
            _warn([*prepared.plan.warnings, *loaded.warnings])
            if as_json:
                explained = {
                    "rule": prepared.plan.rule,
                    "plan": _plan(prepared.plan, held),
                    "memory_bytes": needed,
                }
                say(json.dumps(explained, allow_nan=False))
            return
        if explain and not as_json:
            say()
        told: set[str] = set()
        for picture in pictures:
            report = run(picture, loaded, threads=threads, overwrite=overwrite, on_stage=bars)
            loaded = replace(loaded, seconds=0.0)  # once for all
            _warn([warning for warning in report.warnings if warning not in told])
            told.update(report.warnings)
            asked = picture.job.camera
            if not quiet and None in (asked.eye, asked.target):
                print(f"volcli: camera chosen: {_camera_flags(report.camera)}", file=sys.stderr)
            if as_json:
                printed = _printed(report)
                if explain:
                    printed["plan"] = _plan(picture.plan, held)
                    printed["memory_bytes"] = needed
                say(json.dumps(printed, allow_nan=False))
            else:
                say(_summary(report))


def _printed(report: Report) -> dict[str, Any]:
    """A report as plain data: what there is of it."""
    printed = asdict(report)
    del printed["camera"]
    for name in ("error_bound", "error_estimate", "pilot"):
        if printed[name] is None:
            del printed[name]
    return printed


def _warn(warnings: Sequence[str]) -> None:
    for warning in warnings:
        print(f"volcli: {warning}", file=sys.stderr)


def _held(scene: Scene) -> dict[str, int]:
    """The bytes of the bricks that each term holds; of a grid that two share, the first."""
    grids: dict[str, Any] = {"optical depth": scene.density}
    if not isinstance(scene.color, tuple):
        grids["colour"] = scene.color.grid
    if scene.emission is not None:
        grids["emission"] = scene.emission.grid
    held, seen = {}, set()
    for term, grid in grids.items():
        held[term] = 0 if id(grid) in seen else grid.nbytes
        seen.add(id(grid))
    return held


def _plan(plan: Plan, held: dict[str, int]) -> list[dict[str, Any]]:
    """The terms of a plan with the bytes that their grids hold, as plain data."""
    return [
        {**asdict(term), "bytes_held": held.get(term.name, 0) if term.wanted else 0}
        for term in plan.terms
    ]


def _explained(plan: Plan, held: dict[str, int]) -> str:
    """The plan as a table. Bytes held are those of the grids as they were loaded."""
    rows = [
        (
            term.name,
            "yes" if term.wanted else "no",
            term.grid or "-",
            _read(term),
            in_bytes(held.get(term.name, 0)) if term.wanted and term.grid else "-",
            str(term.evaluations or "-"),
            term.why,
        )
        for term in plan.terms
    ]
    head = ("term", "in", "grid", "read", "held", "a cell", "why")
    return table(head, rows, terminal_width())


def _read(term: Term) -> str:
    if not term.wanted or term.grid is None:
        return "-"
    return "?" if term.bytes_read is None else in_bytes(term.bytes_read)


def _camera_flags(camera: dict[str, Any]) -> str:
    """A camera as the flags that ask for it."""
    eye, target = (",".join(f"{v:.6g}" for v in camera[name]) for name in ("eye", "target"))
    lens = {
        "perspective": "--fov {fov:g}",
        "orthographic": "--ortho {width:.6g}",
        "panorama": "--set camera.type=panorama",
    }[camera["type"]].format_map(camera)
    up = ",".join(f"{v:.6g}" for v in camera["up"])
    tilt = "" if up == "0,1,0" else f" --up {up}"
    return f"--eye {eye} --target {target}{tilt} {lens}"


def _summary(report: Report) -> str:
    width, height = report.size
    lines = [f"{report.image}  picture {width}x{height}"]
    for name, written in report.maps.items():
        scale = ""
        if (written.get("black", 0.0), written.get("white", 1.0)) != (0.0, 1.0):
            scale = f", black is {written['black']:g}, white is {written['white']:g}"
        lines.append(f"{written['file']}  {name}{scale}")
    t, s = report.transmittance, report.seconds
    lines.append(
        f"{report.rule}: {report.rays:,} rays, {report.cells:,} evaluations; transmittance "
        f"{t['min']:.4g} to {t['max']:.4g}, mean {t['mean']:.4g}"
    )
    pilot = f"pilot {s['pilot']:.2f} s, " if "pilot" in s else ""
    if report.pilot is not None:
        lines.append(f"an estimate: {report.pilot['said']}")
    if report.error_bound is not None:
        lines.append(
            f"certified: no pixel's transmittance, nor its radiance as a share of the brightest "
            f"light, is off by more than {report.error_bound:.3g}"
        )
    if report.error_estimate is not None:
        lines.append(
            f"an estimate: no pixel's radiance, as a share of the brightest light, is off by more "
            f"than {report.error_estimate:.1g}"
        )
    lines.append(
        f"load {s['load']:.2f} s, compile {s['compile']:.2f} s, {pilot}render {s['render']:.2f} s, "
        f"write {s['write']:.2f} s; peak memory {in_bytes(report.peak_memory_bytes)}"
    )
    return "\n".join(lines)
