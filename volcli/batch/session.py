"""A batch from beginning to end: what is to do, on which engine, with how much memory.

The one way a batch is run; `volcli batch` calls it. It prints nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from volcli.batch import farm
from volcli.batch.expand import Expanded, Item
from volcli.batch.identity import job_hash
from volcli.batch.manifest import Manifest, Record
from volcli.batch.processes import Processes
from volcli.batch.runner import Engine, Runner, Settings, Told, Work
from volcli.batch.tiles import windows
from volcli.batch.work import Limits
from volcli.errors import UsageError
from volcli.estimate import PROCESS, estimate
from volcli.leftovers import remove_leftovers
from volcli.memory import SHARE, available_memory
from volcli.outputs import outputs
from volcli.render import available_threads

CORES_PER_WORKER = 4


@dataclass(frozen=True)
class Options:
    """How to run a batch.

    Attributes
    ----------
    workers
        Processes of this machine; None: as many as suit its processors.
    scheduler
        Address of a dask scheduler, instead of processes of this machine.
    threads
        Of each worker, to render with; None: the processors shared out, or what a cluster's worker
        was started with.
    memory
        Bytes for all workers of this machine together; None: `memory.SHARE` of what there is.
    cache
        Folder of bricks that were built before.
    resume, force
        What to do where there is a manifest: what is missing or changed, or everything.
    settings
        Retries, collecting, tiles.
    """

    workers: int | None = None
    scheduler: str | None = None
    threads: int | None = None
    memory: int | None = None
    cache: Path | None = None
    resume: bool = False
    force: bool = False
    settings: Settings = field(default_factory=Settings)


@dataclass(frozen=True)
class Listed:
    """One line of a dry run.

    Attributes
    ----------
    state
        ``to do``, ``done`` or ``missing input``.
    memory
        Bytes that it will take, the process included; None where that is not known.
    """

    item: Item
    state: str
    memory: int | None


@dataclass
class Tally:
    """What became of the jobs of a batch, while it runs and at its end."""

    total: int = 0
    tasks: int = 0
    kept: list[Item] = field(default_factory=list)
    done: list[Told] = field(default_factory=list)
    failed: list[Told] = field(default_factory=list)


def list_jobs(expanded: Expanded) -> list[Listed]:
    """What a batch would do (with ``--resume``), without doing anything."""
    record = Record(expanded.manifest)
    listed = []
    for item in expanded.items:
        needs = estimate(item.job)
        state = "missing input" if item.missing else "to do"
        if record.is_done(item.output, job_hash(item.job), outputs(item.job)):
            state = "done"
        listed.append(Listed(item, state, None if needs is None else PROCESS + needs))
    return listed


def run_batch(
    expanded: Expanded,
    options: Options,
    tally: Tally,
    tell: Callable[[Told], None],
    advance: Callable[[int], None] = lambda count: None,
    begin: Callable[[Tally], None] = lambda tally: None,
    note: Callable[[str], None] = lambda text: None,
) -> None:
    """Run a batch; ``tally`` says what became of it, also where it is interrupted.

    Parameters
    ----------
    tell, advance
        Called with what becomes of each job, and with the number of tasks that are settled.
    begin
        Called once it is known what is to do.
    note
        Called with what the user should know.

    Raises
    ------
    UsageError
        If there is a manifest and it is not said what to do, or no scheduler answers.
    OutputError
        If the manifest cannot be written, or another batch has it.
    VolcliError
        If the scheduler has gone away.
    """
    with Manifest(expanded.manifest) as manifest:
        if manifest.has_jobs and not (options.resume or options.force):
            raise UsageError(
                f"{manifest.path}: is there from an earlier run; --resume does what is missing or "
                "changed, --force does everything again"
            )

        def keep(told: Told) -> None:
            if told.event != "retry":
                (tally.done if told.event == "done" else tally.failed).append(told)
            tell(told)

        works = _left_to_do(expanded.items, options, manifest, tally)
        memory = options.memory or int(SHARE * available_memory())
        possible, hopeless = _possible(works, None if options.scheduler else memory)
        tile = options.settings.tile
        tally.tasks = len(hopeless) + sum(
            1 if tile is None else len(windows(work.item.job, tile)) for work in possible
        )
        manifest.begin(len(works))
        begin(tally)
        for work, reason in hopeless:
            manifest.failed(work.item.output, work.content, reason, attempt=0, again=False)
            keep(Told("failed", work, reason))
            advance(1)
        with _swept_folders(expanded.items, manifest) as started:
            for count, share in _phases(
                possible, _workers(options, len(possible)), memory, options
            ):
                engine = _engine(options, count, memory, started, note)
                try:
                    Runner(engine, manifest, options.settings, keep, advance).run(share)
                finally:
                    engine.close()


def _left_to_do(
    items: Sequence[Item], options: Options, manifest: Manifest, tally: Tally
) -> list[Work]:
    """The jobs that are not done as they are to be, those of one volume next to each other."""
    tally.total = len(items)
    works = []
    for item in _by_volume(items):
        content = job_hash(item.job)
        if not options.force and manifest.is_done(item.output, content, outputs(item.job)):
            tally.kept.append(item)
        else:
            works.append(Work(item, content, _needs(item, options.settings.tile)))
    return works


@contextmanager
def _swept_folders(items: Sequence[Item], manifest: Manifest) -> Iterator[Callable[[int], None]]:
    """The folders of all outputs, made, and swept before and after of what killed workers leave.

    Gives what is to be told the process id of each worker.
    """
    folders = {item.output.parent for item in items}
    workers = set(manifest.former_workers())

    def started(pid: int) -> None:
        workers.add(pid)
        manifest.worker(pid)

    remove_leftovers(folders, workers)
    for folder in folders:
        with suppress(OSError):  # the job will say so
            folder.mkdir(parents=True, exist_ok=True)
    try:
        yield started
    finally:
        remove_leftovers(folders, workers)


def _by_volume(items: Sequence[Item]) -> list[Item]:
    """Jobs of one volume next to each other, so that it is read once; else in their order."""
    first: dict[Any, int] = {}
    for number, item in enumerate(items):
        first.setdefault(item.job.density.file, number)
    return sorted(items, key=lambda item: first[item.job.density.file])


def _needs(item: Item, tile: int | None) -> int:
    return estimate(item.job, None if tile is None else tile * tile) or 0


def _possible(
    works: Sequence[Work], memory: int | None
) -> tuple[list[Work], list[tuple[Work, str]]]:
    """Jobs that can be begun, and those that cannot, with the reason."""
    possible, hopeless = [], []
    for work in works:
        if work.item.missing is not None:
            hopeless.append((work, f"{work.item.missing}: no such file"))
        elif memory is not None and PROCESS + work.needs > memory:
            hopeless.append(
                (
                    work,
                    f"needs about {(PROCESS + work.needs) / 1e9:.2f} GB of memory, and --memory "
                    f"is {memory / 1e9:.2f} GB",
                )
            )
        else:
            possible.append(work)
    return possible, hopeless


def _workers(options: Options, jobs: int) -> int:
    cores = available_threads()
    wanted = options.workers or max(min(2, cores), cores // CORES_PER_WORKER)
    return max(1, min(wanted, jobs)) if options.settings.tile is None else wanted


def _phases(
    works: Sequence[Work], count: int, memory: int, options: Options
) -> list[tuple[int, list[Work]]]:
    """(workers, jobs): jobs that take much memory come last, with fewer workers to share it."""
    if options.scheduler is not None:
        return [(count, list(works))] if works else []
    phases = []
    left = list(works)
    while left:
        fit = [w for w in left if count == 1 or PROCESS + w.needs <= memory / count]
        if fit:
            phases.append((count, fit))
        taken = {id(work) for work in fit}
        left = [work for work in left if id(work) not in taken]
        count = max(1, count // 2)
    return phases


def _engine(
    options: Options,
    count: int,
    memory: int,
    started: Callable[[int], None],
    note: Callable[[str], None],
) -> Engine:
    if options.scheduler is not None:
        limits = Limits(options.threads, None, options.cache)
        return farm.Farm(options.scheduler, count, limits, started, note)
    threads = options.threads or max(1, available_threads() // count)
    limits = Limits(threads, memory // count, options.cache)
    if farm.is_installed():
        return farm.Farm(None, count, limits, started)
    return Processes(count, limits, started)
