"""`volcli batch`: many pictures, from one file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from volcli.batch.schema import described
from volcli.cli.table import in_bytes, say, say_json, table, terminal_width
from volcli.errors import BatchError, UsageError

if TYPE_CHECKING:
    from volcli.batch.expand import Expanded


def _retries_help() -> str:
    text, default = described("retries")
    return f"{text} [default: that of the file, else {default}]"


def batch(
    batch_file: Annotated[Path, typer.Argument(help="A batch file (.toml).")],
    workers: Annotated[
        int | None,
        typer.Option(
            min=1,
            metavar="N",
            help="Processes of this machine. [default: one for 4 processors, at least 2]",
        ),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="A dask scheduler whose workers do the jobs instead: tcp://HOST:PORT, or the file "
            "that it was given as --scheduler-file.",
        ),
    ] = None,
    threads: Annotated[
        int | None,
        typer.Option(
            min=1,
            metavar="N",
            help="Threads of each worker. [default: the processors shared out; on a cluster, what "
            "its workers were started with]",
        ),
    ] = None,
    memory: Annotated[
        str | None,
        typer.Option(
            metavar="SIZE",
            help="Memory for all workers of this machine together: 8GB, or a share of what is "
            "free. [default: 75%]",
        ),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Do what is missing or changed, and nothing else.")
    ] = False,
    force: Annotated[
        bool, typer.Option("--force", help="Do everything again that an earlier run has done.")
    ] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="List the jobs and their memory; do nothing.")
    ] = False,
    retries: Annotated[int | None, typer.Option(min=0, metavar="N", help=_retries_help())] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="KEY=VALUE", help="Any field of all jobs, over the file; repeatable."
        ),
    ] = None,
    collect: Annotated[
        bool,
        typer.Option(
            "--collect",
            help="With --scheduler: workers send pictures back, and they are written here.",
        ),
    ] = False,
    tile: Annotated[
        int | None,
        typer.Option(
            min=1,
            metavar="N",
            help="Split pictures into tiles of N x N pixels among the workers. The picture is the "
            "same, to the bit.",
        ),
    ] = None,
    cache: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Folder that keeps what is made of volumes. [default: none]"
        ),
    ] = None,
    contact_sheet: Annotated[
        Path | None,
        typer.Option(
            "--contact-sheet", metavar="OUT.png", help="A picture of all pictures, at the end."
        ),
    ] = None,
    log: Annotated[
        Path | None, typer.Option("--log", metavar="FILE", help="Add what happens to a file.")
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print a JSON object a line: each job, then the sum.")
    ] = False,
    quiet: Annotated[
        bool, typer.Option("--quiet", "-q", help="No progress, and of jobs only the summary.")
    ] = False,
) -> None:
    """Render many pictures: sequences, sweeps, turntables.

    What is done is recorded in a manifest beside the pictures. A job that fails costs only itself
    (exit code 6 at the end), and --resume goes on after an interruption of any kind.
    """
    if resume and force:
        raise UsageError("--resume and --force exclude each other; give one")
    if scheduler is not None and (workers is not None or memory is not None):
        given = "--workers" if workers is not None else "--memory"
        raise UsageError(
            f"{given} is for this machine, and a cluster's workers are there; drop one"
        )
    if collect and scheduler is None:
        raise UsageError("--collect is for --scheduler; on this machine pictures are written here")
    from volcli.batch.expand import read_batch
    from volcli.batch.runner import Settings
    from volcli.batch.session import Options, Tally, run_batch
    from volcli.cli.batch_output import Output
    from volcli.images import check_output
    from volcli.memory import parse_memory

    if contact_sheet is not None:
        check_output(contact_sheet)
        if contact_sheet.suffix.lower() != ".png":
            raise UsageError(f"--contact-sheet {contact_sheet}: must be a .png")
    bytes_of_memory = None if memory is None else parse_memory(memory)
    expanded = read_batch(batch_file, settings or [])
    if dry_run:
        _list(expanded, as_json)
        return
    options = Options(
        workers=workers,
        scheduler=scheduler,
        threads=threads,
        memory=bytes_of_memory,
        cache=cache,
        resume=resume,
        force=force,
        settings=Settings(
            retries=expanded.retries if retries is None else retries, collect=collect, tile=tile
        ),
    )
    tally = Tally()
    with Output(tally, quiet=quiet, as_json=as_json, log=log) as output:
        for note in expanded.notes:
            output.note(note)
        try:
            run_batch(
                expanded, options, tally, output.tell, output.advance, output.begin, output.note
            )
        finally:
            output.summary(expanded.manifest)
        if contact_sheet is not None:
            output.contact_sheet(contact_sheet, expanded.items)
    if tally.failed:
        raise BatchError(
            f"{len(tally.failed)} of {tally.total} jobs failed; the reasons are above and in "
            f"{expanded.manifest}"
        )


def _list(expanded: Expanded, as_json: bool) -> None:
    """What would run, with its memory."""
    from volcli.batch.session import list_jobs
    from volcli.cli.batch_output import shown, warn

    for note in expanded.notes:
        warn(note)
    listed = list_jobs(expanded)
    if as_json:
        for job in listed:
            row: dict[str, Any] = {
                "job": str(job.item.output),
                "volume": str(job.item.job.density.file),
                "state": job.state,
                "memory_bytes": job.memory,
            }
            say_json(row)
        return
    rows = [
        (
            shown(job.item.output),
            job.item.job.density.file.name if job.item.job.density.file else "-",
            "x".join(map(str, job.item.job.camera.size)),
            "?" if job.memory is None else in_bytes(job.memory),
            job.state,
        )
        for job in listed
    ]
    say(table(("picture", "volume", "size", "memory", "state"), rows, terminal_width()))
    known = [job.memory for job in listed if job.memory is not None]
    to_do = sum(job.state == "to do" for job in listed)
    most = f"; the largest takes about {in_bytes(max(known))}" if known else ""
    say(f"\n{len(listed)} jobs, {to_do} to do{most}")
