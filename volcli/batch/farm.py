"""An engine of dask.distributed: an existing scheduler's workers, or a cluster on this machine.

What is lost with a worker, and how often the scheduler tries again elsewhere, is the scheduler's to
say (`distributed.scheduler.allowed-failures`); a task that it gives up comes back as lost.
"""

from __future__ import annotations

import importlib.util
import itertools
import json
import logging
import os
import queue
import secrets
import signal
import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from volcli.batch.work import AT_ONCE, Limits, Outcome, Task, Worker
from volcli.errors import UsageError, VolcliError

_ANSWER_SECONDS, _FILE_SECONDS = 10, 60
_LOOK_SECONDS = 1.0
"""How often it is asked which workers there are."""

UNPAUSED = 0.7
"""The part of its memory limit up to which a worker of dask surely goes on; it pauses at 0.8."""

_worker: Worker | None = None
_making = threading.Lock()


def is_installed() -> bool:
    """Whether the extra ``farm`` is there."""
    return importlib.util.find_spec("distributed") is not None


class Farm:
    """Workers of dask.distributed, as a `runner.Engine`.

    Parameters
    ----------
    address
        Of a scheduler, or the file that it was told to write it to (``*.json``), which is waited
        for; None: a cluster of ``count`` workers on this machine.
    on_start
        Called with the process id of each worker that is on this machine.
    note
        Called with what the user should know.

    Raises
    ------
    UsageError
        If the extra is not installed, or no scheduler answers.
    """

    def __init__(
        self,
        address: str | None,
        count: int,
        limits: Limits,
        on_start: Callable[[int], None],
        note: Callable[[str], None] = lambda text: None,
    ) -> None:
        if not is_installed():
            raise UsageError("--scheduler needs dask.distributed: pip install 'volcli[farm]'")
        from distributed import Client

        _silence()
        self._limits, self._on_start, self._note = limits, on_start, note
        self._cluster = _cluster(count, limits) if address is None else None
        self._name = address or "the local cluster"
        if address is not None and address.endswith(".json"):
            address = _read_address(Path(address))
        try:
            self._client = Client(
                address or self._cluster, timeout=_ANSWER_SECONDS, set_as_default=False
            )
        except (OSError, TimeoutError, ValueError) as error:
            raise UsageError(
                f"--scheduler {address}: no scheduler answers there ({_line(error)}); start one "
                "with: dask scheduler"
            ) from error
        if self._cluster is not None:
            self._client.register_worker_callbacks(_ignore_interrupts)
        self._ended: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._futures: dict[str, Any] = {}
        self._alone = False
        self._numbers = itertools.count()
        self._batch = secrets.token_hex(4)
        self._workers: set[str] = set()
        self._looked, self._has_looked = 0.0, False
        self._pids: set[int] = set()
        self._look()

    def has_room(self, alone: bool) -> bool:
        """Whether a task can be taken now; ``alone``: it is to be the only one there is."""
        self._look()
        if alone or self._alone:
            return not self._futures
        return len(self._futures) < AT_ONCE * max(1, len(self._workers))

    def submit(self, task: Task, alone: bool) -> None:
        """Give a task to the scheduler."""
        future = self._client.submit(
            _work,
            task,
            self._limits,
            key=f"volcli-{self._batch}-{next(self._numbers)}",
            pure=False,
        )
        self._alone = alone
        self._futures[task.key] = future
        future.add_done_callback(lambda ended, key=task.key: self._ended.put((key, ended)))

    def wait(self, seconds: float) -> list[Outcome]:
        """What has become of tasks, waiting no longer than that for the first."""
        outcomes = []
        with suppress(queue.Empty):
            key, future = self._ended.get(timeout=seconds)
            while True:
                outcomes.append(self._outcome(key, future))
                key, future = self._ended.get_nowait()
        if self._client.status in ("closed", "closing"):
            raise self._gone()
        return outcomes

    def close(self) -> None:
        """Leave the scheduler; tasks that have not begun are taken back."""
        with suppress(Exception):  # a scheduler that has gone away cannot be told
            self._client.cancel(list(self._futures.values()), force=True)
        with suppress(Exception):
            self._client.close(timeout=2)
        if self._cluster is not None:
            with suppress(Exception):
                self._cluster.close(timeout=10)

    def _outcome(self, key: str, future: Any) -> Outcome:
        from distributed import KilledWorker

        del self._futures[key]
        alone, self._alone = self._alone, False
        if future.status == "finished":
            try:
                outcome: Outcome = future.result()
            except Exception as error:  # it was computed, and lost before it was fetched
                return Outcome(key, f"its result was lost ({_line(error)})", lost=not alone)
            self._seen(outcome.host, outcome.pid)
            return outcome
        if future.status in ("cancelled", "lost"):
            raise self._gone()
        failure = future.exception()
        if isinstance(failure, KilledWorker):
            what = "its worker died; by hand, or because it ran out of memory"
            return Outcome(key, what, lost=not alone)
        return Outcome(key, f"its worker could not begin it ({_line(failure)})")

    def _look(self) -> None:
        """Which workers there are; asked again once a while."""
        if self._has_looked and time.monotonic() - self._looked < _LOOK_SECONDS:
            return
        self._looked = time.monotonic()
        try:
            workers = set(self._client.nthreads())
            if workers - self._workers:
                for host, pid in self._client.run(_whoami, on_error="ignore").values():
                    self._seen(host, pid)
        except (OSError, TimeoutError, ValueError) as error:
            raise self._gone() from error
        if not workers and (self._workers or not self._has_looked):
            self._note(f"{self._name}: has no workers; waiting for some")
        self._workers, self._has_looked = workers, True

    def _seen(self, host: str, pid: int) -> None:
        if host == socket.gethostname() and pid not in self._pids:
            self._pids.add(pid)
            self._on_start(pid)

    def _gone(self) -> VolcliError:
        return VolcliError(
            f"{self._name}: the scheduler has gone away; what is done is recorded, and --resume "
            "goes on once there is one"
        )


def _cluster(count: int, limits: Limits) -> Any:
    """A cluster on this machine that nobody else can use: its port asks for a certificate."""
    import dask
    from distributed import LocalCluster, Security

    settings = {
        # Once a worker has died its tasks come back, and are tried again one by one.
        "distributed.scheduler.allowed-failures": 0,
        # Nothing of ours can be spilt, and a pause would wait for grids that are kept.
        "distributed.worker.memory.target": False,
        "distributed.worker.memory.spill": False,
        "distributed.worker.memory.pause": False,
        # A profile looks at the stacks of all threads, a hundred times a second; where one begins
        # meanwhile some interpreters (CPython 3.11) stand still for ever.
        "distributed.worker.profile.enabled": False,
    }
    with dask.config.set(settings):
        return LocalCluster(
            n_workers=count,
            threads_per_worker=AT_ONCE,
            processes=True,
            memory_limit=limits.memory or 0,
            dashboard_address="127.0.0.1:0",  # None would have it listen to all the world
            security=Security.temporary(),
            silence_logs=logging.CRITICAL,
        )


def _read_address(file: Path) -> str:
    """The address that a scheduler writes to its ``--scheduler-file`` once it is there."""
    end = time.monotonic() + _FILE_SECONDS
    while True:
        try:
            return str(json.loads(file.read_text())["address"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            if time.monotonic() > end:
                raise UsageError(
                    f"--scheduler {file}: no scheduler has written its address there in "
                    f"{_FILE_SECONDS} s ({_line(error)})"
                ) from error
        time.sleep(0.1)


def _silence() -> None:
    """Keep distributed's logs off the terminal: what they tell comes as outcomes and errors too."""
    names = [name for name in logging.root.manager.loggerDict if name.startswith("distributed")]
    for name in ("distributed", *names):
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)


def _whoami() -> tuple[str, int]:
    """On a worker: its machine and its process id."""
    return socket.gethostname(), os.getpid()


def _ignore_interrupts() -> None:
    """On a worker of this machine: Ctrl-C is for the batch, which ends its workers."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _work(task: Task, limits: Limits) -> Outcome:
    """On a worker: do a task, with what the tasks of its process share."""
    global _worker
    with _making:
        if _worker is None:
            _worker = Worker(_own(limits))
    return _worker.work(task)


def _own(limits: Limits) -> Limits:
    """Limits, with what the batch leaves open set to what the worker was started with."""
    from distributed import get_worker

    worker = get_worker()
    memory = worker.memory_manager.memory_limit
    if memory:
        memory = int(UNPAUSED * memory)
    return Limits(
        threads=limits.threads or worker.state.nthreads,
        memory=limits.memory or memory,
        cache=limits.cache,
    )


def _line(error: BaseException | None) -> str:
    return " ".join(str(error).split()) or type(error).__name__
