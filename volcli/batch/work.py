"""One job, or a tile of one, in the process of a worker: a task in, an outcome out.

A worker has two tasks at a time: while one renders, the volume of the next is read. What they share
(grids in memory, the turn to render) belongs to the process and lives here.
"""

from __future__ import annotations

import os
import socket
import tempfile
import threading
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import volcli
from volcli import run
from volcli.batch.identity import Print, file_print
from volcli.batch.volumes import KeptGrids
from volcli.errors import UsageError, VolcliError
from volcli.estimate import PROCESS
from volcli.outputs import outputs
from volcli.render import Window
from volcli.schema import Job

AT_ONCE = 2
"""Tasks that a worker has at a time: one renders, one reads."""


@dataclass(frozen=True)
class Task:
    """What a worker is to do.

    Attributes
    ----------
    key
        Unique in a batch.
    window
        The tile to render, whose arrays are sent back; None: all of the picture, written here.
    collect
        Whether the files are sent back instead of written where the job says.
    needs
        Bytes that the task will take, as far as is known.
    version
        Of volcli, which the worker's must be.
    """

    key: str
    job: Job
    window: Window | None = None
    collect: bool = False
    needs: int = 0
    version: str = field(default_factory=lambda: volcli.__version__)


@dataclass(frozen=True)
class Limits:
    """What a worker may use.

    Attributes
    ----------
    threads
        To render with; None: all that the process may use.
    memory
        Bytes, or None for no limit.
    cache
        A folder of bricks that were built before.
    """

    threads: int | None = None
    memory: int | None = None
    cache: Path | None = None


@dataclass(frozen=True)
class Outcome:
    """What became of a task.

    Attributes
    ----------
    error
        Why it failed, in one line; None: it did not.
    final
        Whether to try again would be of no use: the job itself is wrong.
    lost
        Whether the worker was lost with it, so that another task may be to blame.
    trace
        Where in the code an error that was not foreseen happened.
    report
        What `run.write` reported.
    files
        Prints of what was written.
    contents
        The files themselves, by their paths, where they are collected.
    part
        The rendered tile.
    """

    key: str
    error: str | None = None
    final: bool = False
    lost: bool = False
    trace: str = ""
    report: run.Report | None = None
    files: dict[Path, Print] = field(default_factory=dict)
    contents: dict[Path, bytes] = field(default_factory=dict)
    part: run.Rendered | None = None
    host: str = field(default_factory=socket.gethostname)
    pid: int = field(default_factory=os.getpid)


class Worker:
    """What the tasks of one process share."""

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        self._grids = KeptGrids(limits.cache)
        self._turn = threading.Lock()
        self._changed = threading.Condition()
        self._taken: list[int] = []

    def work(self, task: Task) -> Outcome:
        """Do a task. What goes wrong with it is told, never raised."""
        try:
            with self._room(task.needs):
                return self._done(task)
        except VolcliError as error:
            return Outcome(task.key, str(error), final=isinstance(error, UsageError))
        except MemoryError as error:
            return Outcome(task.key, f"out of memory ({error or 'no memory is left'})")
        except Exception as error:  # a defect of volcli costs a job, and not the batch
            what = f"unexpected {type(error).__name__}: {error}; please report it"
            return Outcome(task.key, what, trace=traceback.format_exc())

    def _done(self, task: Task) -> Outcome:
        if task.version != volcli.__version__:
            raise UsageError(
                f"{socket.gethostname()}: this worker has volcli {volcli.__version__}, and the "
                f"batch {task.version}; install the same one"
            )
        if task.collect or task.window is not None:
            with tempfile.TemporaryDirectory(prefix="volcli-") as folder:
                return self._elsewhere(task, Path(folder))
        prepared = run.prepare(task.job)
        rendered = self._rendered(prepared, None)
        report = run.write(prepared, rendered)
        files = {path: file_print(path) for path in prepared.files.values()}
        return Outcome(task.key, report=report, files=files)

    def _elsewhere(self, task: Task, folder: Path) -> Outcome:
        """A task whose job's output is not written here, where its folder need not even exist."""
        prepared = prepare_into(task.job, folder)
        rendered = self._rendered(prepared, task.window)
        if task.window is not None:
            return Outcome(task.key, part=rendered)
        report = run.write(prepared, rendered)
        named = outputs(task.job)
        contents = {named[name]: path.read_bytes() for name, path in prepared.files.items()}
        return Outcome(task.key, report=renamed(report, task.job), contents=contents)

    def _rendered(self, prepared: run.Prepared, window: Window | None) -> run.Rendered:
        loaded = run.load(prepared, cache=self._grids, threads=self._limits.threads)
        with self._turn:
            return run.render_loaded(prepared, loaded, threads=self._limits.threads, window=window)

    @contextmanager
    def _room(self, needs: int) -> Iterator[None]:
        """Wait until there is memory for a task, and none but another before it."""
        with self._changed:
            self._changed.wait_for(lambda: self._fits(needs))
            self._taken.append(needs)
        self._leave_room()
        try:
            yield
        finally:
            with self._changed:
                self._taken.remove(needs)
                self._changed.notify_all()
            self._leave_room()  # now: a worker of dask that holds too much is given no more tasks

    def _leave_room(self) -> None:
        """Keep no more grids than there is memory for beside what the tasks at hand need."""
        if self._limits.memory is not None:
            self._grids.shrink(max(0, self._limits.memory - PROCESS - sum(self._taken)))

    def _fits(self, needs: int) -> bool:
        if not self._taken:
            return True
        limit = self._limits.memory
        together = PROCESS + sum(self._taken) + needs
        return len(self._taken) < AT_ONCE and (limit is None or together <= limit)


def prepare_into(job: Job, folder: Path) -> run.Prepared:
    """`run.prepare` with the outputs in another folder; the job keeps the names it has for them."""
    assert job.output.image is not None
    there = job.model_copy(
        update={"output": job.output.model_copy(update={"image": folder / job.output.image.name})}
    )
    return replace(run.prepare(there), job=job)


def renamed(report: run.Report, job: Job) -> run.Report:
    """A report of files that were written elsewhere, with the names that the job has for them."""
    named = outputs(job)
    maps: dict[str, dict[str, Any]] = {
        name: {**told, "file": str(named[name])} for name, told in report.maps.items()
    }
    return replace(report, image=str(named["picture"]), maps=maps)
