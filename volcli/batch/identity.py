"""What a job is made of, and what it made, as hashes: where both are as before, nothing is to do.

An input counts with its size, its time of change in ns and its first 4 KiB (an OpenVDB file begins
with an identifier, new whenever it is written), for to hash volumes would take longer than to
render many of them. An output is hashed whole: it was just written, and is small beside a volume.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import volcli
from volcli.batch.names import paths_of
from volcli.schema import Job

_START = 4096

Print = dict[str, Any]
"""Of one file: ``bytes``, ``mtime_ns`` and ``sha256``."""


def job_hash(job: Job) -> str:
    """The content hash of a job: all its fields, its input files, and the version of volcli."""
    inputs = {
        key: _input(path) for key, path in sorted(paths_of(job).items()) if key != "output.image"
    }
    whole = {"job": job.model_dump(mode="json"), "inputs": inputs, "volcli": volcli.__version__}
    return hashlib.sha256(json.dumps(whole, sort_keys=True).encode()).hexdigest()[:32]


def file_print(path: Path) -> Print:
    """What a file holds now.

    Raises
    ------
    OSError
        If it cannot be read.
    """
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    status = path.stat()
    return {"bytes": status.st_size, "mtime_ns": status.st_mtime_ns, "sha256": digest}


def is_as_printed(path: Path, printed: Mapping[str, Any]) -> bool:
    """Whether a file is there and holds what it held when it was printed.

    It is read only where its time of change is another, as after it was copied.
    """
    try:
        status = path.stat()
        if status.st_size != printed.get("bytes"):
            return False
        if status.st_mtime_ns == printed.get("mtime_ns"):
            return True
        return file_print(path)["sha256"] == printed.get("sha256")
    except OSError:
        return False


def _input(path: Path) -> list[Any] | None:
    try:
        status = path.stat()
        with path.open("rb") as file:
            start = hashlib.sha256(file.read(_START)).hexdigest()
    except OSError:
        return None  # the job will say so
    return [status.st_size, status.st_mtime_ns, start]
