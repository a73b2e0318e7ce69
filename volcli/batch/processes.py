"""An engine of plain processes on this machine: each is watched, and is replaced when it dies.

Not concurrent.futures: its pool breaks as a whole when one process is killed.
"""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from typing import Any

from volcli.batch.work import AT_ONCE, Limits, Outcome, Task, Worker
from volcli.memory import held_memory

_LOOK_SECONDS = 0.2
"""How often memory is looked at."""

_PR_SET_PDEATHSIG = 1

_sending = threading.Lock()


@dataclass
class _Process:
    process: Any
    connection: Connection
    tasks: dict[str, Task] = field(default_factory=dict)
    alone: bool = False
    reason: str = ""


class Processes:
    """Worker processes, as a `runner.Engine`.

    Parameters
    ----------
    count
        Processes at a time.
    on_start
        Called with the process id of each.
    """

    def __init__(self, count: int, limits: Limits, on_start: Callable[[int], None]) -> None:
        self._count, self._limits, self._on_start = count, limits, on_start
        self._context = multiprocessing.get_context("spawn")
        self._processes: list[_Process] = []

    def has_room(self, alone: bool) -> bool:
        """Whether a task can be taken now; ``alone``: by a process that has no other."""
        return len(self._processes) < self._count or any(
            not p.alone and len(p.tasks) < (1 if alone else AT_ONCE) for p in self._processes
        )

    def submit(self, task: Task, alone: bool) -> None:
        """Give a task to the process that has the least to do."""
        free = [p for p in self._processes if not p.alone and len(p.tasks) < AT_ONCE]
        free.sort(key=lambda p: len(p.tasks))
        if (not free or free[0].tasks) and len(self._processes) < self._count:
            free.insert(0, self._started())
        process = free[0]
        process.tasks[task.key] = task
        process.alone = alone
        # A process that has just died is found out when its connection is next read.
        with suppress(OSError):
            process.connection.send(task)

    def wait(self, seconds: float) -> list[Outcome]:
        """What has become of tasks, waiting no longer than that for the first."""
        outcomes: list[Outcome] = []
        ready = wait([p.connection for p in self._processes], min(seconds, _LOOK_SECONDS))
        for process in list(self._processes):
            if process.connection in ready:
                outcomes += self._received(process)
        self._watch_memory()
        return outcomes

    def close(self) -> None:
        """End all processes at once; what they are at is lost."""
        for process in self._processes:
            process.process.kill()
        for process in self._processes:
            process.process.join()
            process.connection.close()
        self._processes = []

    def _started(self) -> _Process:
        ours, theirs = self._context.Pipe()
        process = self._context.Process(
            target=_serve, args=(theirs, self._limits, os.getpid()), daemon=True
        )
        process.start()
        theirs.close()  # so that the end of the process is the end of the connection
        self._on_start(process.pid or 0)
        self._processes.append(_Process(process, ours))
        return self._processes[-1]

    def _received(self, process: _Process) -> list[Outcome]:
        try:
            outcome: Outcome = process.connection.recv()
        except (EOFError, OSError):
            return self._buried(process)
        process.tasks.pop(outcome.key, None)
        process.alone = False
        return [outcome]

    def _buried(self, process: _Process) -> list[Outcome]:
        """A process has died; with two tasks at hand it is not known which one was to blame."""
        self._processes.remove(process)
        process.connection.close()
        process.process.join()
        reason = process.reason or _cause_of_death(process.process.exitcode)
        doubt = len(process.tasks) > 1
        return [Outcome(key, reason, lost=doubt, pid=process.process.pid) for key in process.tasks]

    def _watch_memory(self) -> None:
        limit = self._limits.memory
        if limit is None:
            return
        for process in self._processes:
            held = held_memory(process.process.pid)
            if held > limit:
                process.reason = (
                    f"out of memory: its worker held {held / 1e9:.2f} GB of {limit / 1e9:.2f} GB; "
                    "fewer --workers leave more to each, and --memory sets what there is"
                )
                process.process.kill()


def _cause_of_death(code: int | None) -> str:
    if code is None or code >= 0:
        return f"its worker ended (exit code {code})"
    name = signal.Signals(-code).name
    hint = "; by hand, or because the machine ran out of memory" if name == "SIGKILL" else ""
    return f"its worker died of {name}{hint}"


def _serve(connection: Connection, limits: Limits, parent: int) -> None:
    """The life of a worker process: tasks in, outcomes out, until the connection ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the batch, which ends its workers
    _die_with(parent)
    worker = Worker(limits)
    pool = ThreadPoolExecutor(AT_ONCE)
    try:
        while True:
            pool.submit(_answer, connection, worker, connection.recv())
    except (EOFError, OSError):
        os._exit(0)  # the batch is over, and waits for nothing that may still be in hand


def _answer(connection: Connection, worker: Worker, task: Task) -> None:
    outcome = worker.work(task)
    with _sending:  # two threads share the connection
        connection.send(outcome)


def _die_with(parent: int) -> None:
    """Have the system kill this process when its parent ends, even where that is killed (Linux)."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:  # it has ended before
            os._exit(0)
