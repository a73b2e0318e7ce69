"""The command that follows the ray of a pixel, for a message to name."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from volcli.errors import NonFiniteError
from volcli.schema import Job


@contextmanager
def naming_the_ray(job: Job) -> Iterator[None]:
    """Add to a `NonFiniteError` the command that follows the ray of its pixel."""
    try:
        yield
    except NonFiniteError as error:
        if error.pixel is None:
            raise
        raise NonFiniteError(f"{error}; its ray: {probe_command(job, error.pixel)}") from error


def probe_command(job: Job, pixel: tuple[int, int]) -> str:
    """A command line of `volcli probe` that follows the ray of a pixel of a job's picture."""
    tables = job.model_dump(mode="json", exclude_defaults=True, exclude_none=True)
    tables.pop("output", None)
    source = str(tables.get("density", {}).pop("file", ""))
    words = ["volcli", "probe", source, "--pixel", f"{pixel[0]},{pixel[1]}"]
    for key, value in _flat(tables, ""):
        words += ["--set", f"{key}={value}"]
    return shlex.join(words)


def _flat(tables: dict[str, Any], prefix: str) -> Iterator[tuple[str, str]]:
    """(PART.FIELD, VALUE) of all fields, as ``--set`` takes them."""
    for name, value in tables.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value if isinstance(value, str) else json.dumps(value)
