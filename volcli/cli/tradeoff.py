"""`volcli tradeoff`: every rule on the user's own picture, its time and its error."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from volcli.cli import scene as options
from volcli.cli.options import option
from volcli.cli.progress import Bars
from volcli.cli.table import say, table, terminal_width
from volcli.errors import UsageError

if TYPE_CHECKING:
    from volcli.tradeoff.session import Outcome, Wanted


def tradeoff(
    source: Annotated[
        Path,
        typer.Argument(help="A volume, a job file (.toml), or a picture that volcli rendered."),
    ],
    output: Annotated[
        Path,
        typer.Option(
            "-o",
            "--output",
            metavar="DIR",
            help="Folder for tradeoff.csv, tradeoff.json and tradeoff.png; made if it is not "
            "there.",
        ),
    ],
    target_error: Annotated[
        float | None,
        typer.Option(
            metavar="E", help="Name the cheapest setting that no pixel is off by more with."
        ),
    ] = None,
    time_budget: Annotated[
        float | None,
        typer.Option(
            metavar="S",
            help="Name the most accurate setting whose picture takes no more seconds; with "
            "--target-error, the cheapest that does both.",
        ),
    ] = None,
    write_job: Annotated[
        Path | None,
        typer.Option(metavar="FILE.toml", help="Write the job with the setting that is named."),
    ] = None,
    quick: Annotated[
        bool,
        typer.Option(
            "--quick",
            help="Measure a small picture of the same view, and take the times of the whole one "
            "from it.",
        ),
    ] = False,
    step: Annotated[float | None, option("quadrature.step", "--step", metavar="VOXELS")] = None,
    max_error: Annotated[
        float | None, option("quadrature.max_error", "--max-error", metavar="E")
    ] = None,
    rounds: Annotated[
        int, typer.Option(min=5, metavar="N", help="How often each setting is timed.")
    ] = 5,
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
    threads: Annotated[
        int | None,
        typer.Option(min=1, metavar="N", help="Threads. [default: the processors there are]"),
    ] = None,
    overwrite: Annotated[bool, typer.Option(help="Whether files that exist are replaced.")] = True,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
    quiet: Annotated[
        bool, typer.Option("--quiet", "-q", help="No progress, only results and warnings.")
    ] = False,
) -> None:
    """Measure speed against accuracy on a picture of one's own.

    The picture is rendered by every rule with a range of steps and errors, and with the setting of
    the job, --step or --max-error; each is timed in rounds and held to a float64 truth on the same
    rays.
    """
    for flag, value in (("--target-error", target_error), ("--time-budget", time_budget)):
        if value is not None and not (0 < value < float("inf")):
            raise UsageError(f"{flag} {value:g}: must be above 0")
    if write_job is not None and target_error is None and time_budget is None:
        raise UsageError("--write-job writes what --target-error or --time-budget names; give one")
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
    flags += options.rule_flags(step, max_error, None)
    job = options.job_of(source, flags, settings or [])
    from volcli.images import check_output
    from volcli.tradeoff import session

    if write_job is not None:
        check_output(write_job, overwrite=overwrite, kinds=(".toml",))
    session.check_files(output, overwrite=overwrite)
    wanted = session.Wanted(target_error, time_budget, quick)
    with Bars(quiet) as bars:
        outcome = session.measure_job(
            job, output, wanted, rounds=rounds, threads=threads, on_stage=bars
        )
    for warning in outcome.found.warnings:
        print(f"volcli: {warning}", file=sys.stderr)
    files = session.write_files(output, outcome, wanted, overwrite=overwrite)
    if write_job is not None and outcome.job is not None:
        session.write_job(write_job, outcome.job, overwrite=overwrite)
        files.append(write_job)
    if as_json:
        printed = session.report(outcome, wanted)
        say(json.dumps({**printed, "files": [str(path) for path in files]}, allow_nan=False))
    else:
        say(_summary(outcome, wanted))
        say("\n".join(str(path) for path in files))
    if wanted.advice and outcome.advised is None:
        raise session.missed(outcome, wanted)


def _summary(outcome: Outcome, wanted: Wanted) -> str:
    from volcli.tradeoff.report import HEAD, reasons, rows

    found = outcome.found
    width, height = found.size
    lines = [
        f"{found.source}  picture {width}x{height}, {found.threads} threads, {found.rounds} rounds"
    ]
    if found.measured_size != found.size:
        small = "x".join(map(str, found.measured_size))
        lines.append(
            f"an estimate: measured on a picture of {small}, times in proportion to the rays"
        )
    lines += ["", table(HEAD, rows(found), terminal_width())]
    lines.append("error: of the worst pixel; *: no other is both as fast and as accurate")
    lines += reasons(found)
    setup = max((row.setup_seconds for row in found.measured), default=0.0)
    if setup > 0:
        lines.append(f"certified: {setup:.2g} s of its time make the bounds that it rests on")
    if found.order is not None:
        longest, *_, shortest = found.order.steps
        lines.append(
            f"midpoint: its error falls as step^{found.order.order:.2f} here, from {longest:g} to "
            f"{shortest:g} voxels"
        )
    if outcome.advised is not None:
        lines.append(_advice(outcome, wanted))
    return "\n".join(lines)


def _advice(outcome: Outcome, wanted: Wanted) -> str:
    advised = outcome.advised
    assert advised is not None
    why = []
    if wanted.target_error is not None:
        why.append(f"no pixel off by more than {wanted.target_error:.3g}")
    if wanted.time_budget is not None:
        why.append(f"no more than {wanted.time_budget:.3g} s")
    cheapest = "the cheapest" if wanted.target_error is not None else "the most accurate"
    return (
        f"take {advised.setting.name}: {cheapest} with {' and '.join(why)}; {advised.median:.3g} s "
        f"here, largest error {advised.errors.largest:.2g}"
    )
