"""The manifest of a batch: what is done, in a file that is true at any moment.

A line of JSON is added for each event and nothing is ever changed, so that a kill or a power cut
costs the last line at most; one that is not whole is passed over. What a job's last line says
holds:

    {"event": "batch", "time": ..., "volcli": ..., "host": ..., "pid": ..., "jobs": ...}
    {"event": "worker", "host": ..., "pid": ...}
    {"event": "done", "job": OUTPUT, "hash": ..., "files": {OUTPUT: PRINT, ...}, ...}
    {"event": "failed", "job": OUTPUT, "hash": ..., "error": ..., "attempt": ..., "again": ...}

OUTPUT is the path of a job's picture, relative to the folder of the manifest. A lock on the file
keeps a second batch away while one runs; the system lifts it when the process ends, in any way.
"""

from __future__ import annotations

import fcntl
import json
import os
import socket
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

import volcli
from volcli.batch.identity import is_as_printed
from volcli.errors import OutputError

_START = b'{"event": '


def read_manifest(path: Path) -> list[dict[str, Any]]:
    """The events of a manifest, in order; none where there is no file.

    Raises
    ------
    OutputError
        If it cannot be read.
    """
    try:
        lines = path.read_bytes().split(b"\n")
    except FileNotFoundError:
        return []
    except OSError as error:
        raise OutputError(f"{path}: cannot be read: {error.strerror or error}") from error
    events = []
    for line in lines:
        try:
            event = json.loads(line)
        except (ValueError, RecursionError):
            continue  # cut off by a kill; what it told of is done again
        if isinstance(event, dict) and isinstance(event.get("job", ""), str) and "event" in event:
            events.append(event)
    return events


def _may_be_cut_off(path: Path) -> bool:
    """Whether a file without a whole line is the beginning of a manifest, or is not there."""
    try:
        with path.open("rb") as file:
            start = file.read(len(_START))
    except FileNotFoundError:
        return True
    return _START.startswith(start)


class Record:
    """What a manifest says, as it was when it was read.

    Raises
    ------
    OutputError
        If it cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._events = read_manifest(path)
        self._jobs = {event["job"]: event for event in self._events if "job" in event}
        if not self._events and not _may_be_cut_off(path):
            raise OutputError(f"{path}: is there and is no manifest; name another file")

    @property
    def has_jobs(self) -> bool:
        """Whether a job was ever recorded."""
        return bool(self._jobs)

    def is_done(self, output: Path, content: str, files: Mapping[str, Path]) -> bool:
        """Whether a job with this hash is recorded as done, and all its files are as recorded."""
        last = self._jobs.get(self._name(output))
        if last is None or last["event"] != "done" or last.get("hash") != content:
            return False
        prints = last.get("files", {})
        return {self._name(path) for path in files.values()} == set(prints) and all(
            is_as_printed(path, prints[self._name(path)]) for path in files.values()
        )

    def former_workers(self) -> Iterator[int]:
        """Process ids of workers that batches had on this machine."""
        host = socket.gethostname()
        for event in self._events:
            if event.get("event") == "worker" and event.get("host") == host:
                yield event["pid"]

    def _name(self, path: Path) -> str:
        return os.path.relpath(path, self.path.parent)


class Manifest(Record):
    """A manifest that is written to; while it is open no other process can open it.

    Raises
    ------
    OutputError
        If it cannot be made, read or written, or another batch has it open.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = os.open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT, 0o666)
        except OSError as error:
            raise self._failed(error) from error
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            os.close(self._file)
            raise OutputError(
                f"{path}: another batch is at work on it; wait for it to end, or name another "
                "manifest"
            ) from error
        except OSError as error:
            os.close(self._file)
            raise self._failed(error) from error
        try:
            super().__init__(path)
        except OutputError:
            os.close(self._file)
            raise
        size = os.fstat(self._file).st_size
        if size and os.pread(self._file, 1, size - 1) != b"\n":
            self._append(b"\n")  # ends a line that was cut off

    def __enter__(self) -> Manifest:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        os.close(self._file)

    def begin(self, jobs: int) -> None:
        """Record that a batch of so many jobs begins."""
        self.write("batch", volcli=volcli.__version__, pid=os.getpid(), jobs=jobs)

    def worker(self, pid: int) -> None:
        """Record a worker process of this machine, so that what it leaves can be told later."""
        self.write("worker", pid=pid)

    def done(self, output: Path, content: str, files: Mapping[Path, Any], **told: Any) -> None:
        """Record a job as done, with the prints of what it wrote."""
        prints = {self._name(path): printed for path, printed in files.items()}
        self.write("done", job=self._name(output), hash=content, files=prints, **told)

    def failed(self, output: Path, content: str, error: str, **told: Any) -> None:
        """Record an attempt that failed."""
        self.write("failed", job=self._name(output), hash=content, error=error, **told)

    def write(self, event: str, **told: Any) -> None:
        """Add a line, and have it on the disk before this returns.

        Raises
        ------
        OutputError
            If the disk is full.
        """
        line = {"event": event, "time": round(time.time(), 3), "host": socket.gethostname(), **told}
        self._append(json.dumps(line, allow_nan=False).encode() + b"\n")
        if "job" in line:
            self._jobs[line["job"]] = line

    def _append(self, data: bytes) -> None:
        try:
            written = os.write(self._file, data)
            if written < len(data):
                raise OSError(28, "No space left on device")
            os.fsync(self._file)
        except OSError as error:
            raise self._failed(error) from error

    def _failed(self, error: OSError) -> OutputError:
        return OutputError(
            f"{self.path}: the manifest cannot be written: {error.strerror or error}; check the "
            "free space and the permissions of its folder"
        )
