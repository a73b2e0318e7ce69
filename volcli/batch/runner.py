"""Jobs to an engine and outcomes to the manifest: order, retries, and whose fault it was.

A job that fails is tried again at the end. Where a worker died with two tasks at hand it is not
known which of them killed it: both are tried again by themselves, and only what fails alone has
failed.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

from volcli import run
from volcli.batch.expand import Item
from volcli.batch.identity import Print, file_print
from volcli.batch.manifest import Manifest
from volcli.batch.tiles import Canvas, windows
from volcli.batch.work import Outcome, Task
from volcli.errors import OutputError, VolcliError
from volcli.files import write_file
from volcli.render import Window

_WAIT_SECONDS = 0.5


class Engine(Protocol):
    """Who works: processes of this machine, or those of a cluster."""

    def has_room(self, alone: bool) -> bool:
        """Whether a task can be taken now; ``alone``: so that its death is its own doing."""

    def submit(self, task: Task, alone: bool) -> None:
        """Take a task; only after `has_room`."""

    def wait(self, seconds: float) -> list[Outcome]:
        """What has become of tasks, waiting no longer than that for the first."""

    def close(self) -> None:
        """End, with whatever is still at work."""


@dataclass(frozen=True)
class Work:
    """An item that is to be done.

    Attributes
    ----------
    content
        Its hash (`identity.job_hash`).
    needs
        Bytes of memory, as far as is known.
    """

    item: Item
    content: str
    needs: int = 0


@dataclass(frozen=True)
class Told:
    """What is told of a job as it happens.

    Attributes
    ----------
    event
        ``done``, ``failed`` (for good) or ``retry``.
    """

    event: str
    work: Work
    error: str = ""
    trace: str = ""
    report: run.Report | None = None
    host: str = ""


@dataclass
class _Attempt:
    """A task on its way: a whole job, or one tile of it."""

    work: Work
    window: Window | None
    tries: int = 0
    alone: bool = False


@dataclass(frozen=True)
class Settings:
    """How a batch is run.

    Attributes
    ----------
    retries
        How often what failed is tried again.
    collect
        Whether workers send files back instead of writing them.
    tile
        Edge of the tiles that pictures are split into, in pixels, or None.
    """

    retries: int = 1
    collect: bool = False
    tile: int | None = None


@dataclass
class Runner:
    """One run of some jobs on an engine.

    Attributes
    ----------
    tell
        Called with what becomes of each job.
    advance
        Called with the number of tasks that are settled, as they are.
    """

    engine: Engine
    manifest: Manifest
    settings: Settings
    tell: Callable[[Told], None]
    advance: Callable[[int], None] = lambda count: None
    _queue: deque[_Attempt] = field(default_factory=deque)
    _going: dict[str, _Attempt] = field(default_factory=dict)
    _canvases: dict[Path, Canvas] = field(default_factory=dict)
    _given_up: set[Path] = field(default_factory=set)

    def run(self, works: Sequence[Work]) -> None:
        """Do jobs until each is done or has failed; each is recorded before it is told of.

        Raises
        ------
        OutputError
            If the manifest cannot be written.
        VolcliError
            If the engine is gone.
        """
        self._queue.extend(
            _Attempt(work, window) for work in works for window in self._windows(work)
        )
        while self._queue or self._going:
            while self._queue and self.engine.has_room(self._queue[0].alone):
                self._submit(self._queue.popleft())
            for outcome in self.engine.wait(_WAIT_SECONDS):
                self._settle(self._going.pop(outcome.key), outcome)

    def _windows(self, work: Work) -> list[Window | None]:
        return [*windows(work.item.job, self.settings.tile)] if self.settings.tile else [None]

    def _submit(self, attempt: _Attempt) -> None:
        work = attempt.work
        if work.item.output in self._given_up:
            self.advance(1)
            return
        key = f"{work.item.output}#{attempt.window}"
        self._going[key] = attempt
        task = Task(key, work.item.job, attempt.window, self.settings.collect, work.needs)
        self.engine.submit(task, attempt.alone)

    def _settle(self, attempt: _Attempt, outcome: Outcome) -> None:
        work = attempt.work
        if outcome.lost:
            self._queue.appendleft(replace(attempt, alone=True))
            return
        if outcome.error is None:
            try:
                self._finish(attempt, outcome)
            except VolcliError as error:
                outcome = replace(outcome, error=str(error))
        if outcome.error is None:
            self.advance(1)
            return
        tries = attempt.tries + 1
        again = tries <= self.settings.retries and not outcome.final
        if work.item.output in self._given_up:
            self.advance(1)
            return
        self.manifest.failed(
            work.item.output, work.content, outcome.error, attempt=tries, again=again
        )
        event = "retry" if again else "failed"
        self.tell(Told(event, work, outcome.error, outcome.trace, host=outcome.host))
        if again:
            self._queue.append(replace(attempt, tries=tries))
        else:
            self._given_up.add(work.item.output)
            self._canvases.pop(work.item.output, None)
            self.advance(1)

    def _finish(self, attempt: _Attempt, outcome: Outcome) -> None:
        """Write what was sent back, and record the job if it is complete."""
        work, report, files = attempt.work, outcome.report, outcome.files
        if attempt.window is not None:
            assert outcome.part is not None and self.settings.tile is not None
            job, output = work.item.job, work.item.output
            canvas = self._canvases.setdefault(output, Canvas(job, self.settings.tile))
            canvas.put(attempt.window, outcome.part)
            if not canvas.is_complete:
                return
            del self._canvases[output]
            prepared = run.prepare(job)
            report = run.write(prepared, canvas.picture())
            files = _prints(prepared.files.values())
        elif outcome.contents:
            for path, content in outcome.contents.items():
                write_file(path, content)
            files = _prints(outcome.contents)
        assert report is not None
        self.manifest.done(
            work.item.output,
            work.content,
            files,
            seconds=report.seconds,
            peak_memory_bytes=report.peak_memory_bytes,
            warnings=report.warnings,
            worker=f"{outcome.host}:{outcome.pid}",
        )
        self.tell(Told("done", work, report=report, host=outcome.host))


def _prints(paths: Iterable[Path]) -> dict[Path, Print]:
    try:
        return {path: file_print(path) for path in paths}
    except OSError as error:
        raise OutputError(f"{error.filename}: cannot be read back: {error.strerror}") from error
