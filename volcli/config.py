"""Job files and settings of the command line to a `Job`.

Flags win over the file, the file over defaults.
"""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from volcli.errors import UsageError
from volcli.schema import Job

_FILES = ("density.file", "background.image", "output.image")
"""Fields that are paths: in a job file they are relative to the folder of that file."""

_EXCLUSIVE = [
    ("color.constant", "color.grid"),
    ("color.grid", "color.constant"),
    ("background.color", "background.image"),
    ("background.image", "background.color"),
]
"""When the first is set on the command line, the second that a file set is dropped."""


def load_job(
    source: Path, flags: Sequence[tuple[str, Any]] = (), settings: Sequence[str] = ()
) -> Job:
    """The job of a source, which is a job file (.toml) or a volume, with flags on top.

    Parameters
    ----------
    flags
        (dotted key, value); they win over the file.
    settings
        ``KEY=VALUE`` texts; they win over the flags.

    Raises
    ------
    UsageError
        In one line, for the first thing that is wrong.
    """
    extra = [parse_setting(text) for text in settings]
    if source.suffix.lower() == ".toml":
        return make_job(read_job_file(source), [*flags, *extra], source=str(source))
    return make_job({}, [("density.file", source), *flags, *extra], source="options")


def read_job_file(path: Path) -> dict[str, Any]:
    """The tables of a job file, paths made relative to where the user stands.

    Raises
    ------
    UsageError
        If the file cannot be read, or is not TOML.
    """
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise UsageError(f"{path}: no such job file") from error
    except OSError as error:
        raise UsageError(f"{path}: cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise UsageError(f"{path}: is not a text file in UTF-8") from error
    except tomllib.TOMLDecodeError as error:
        raise UsageError(f"{path}: is not TOML: {error}") from error
    for key in _FILES:
        part, name = key.split(".")
        table = tables.get(part)
        if isinstance(table, dict) and isinstance(table.get(name), str):
            table[name] = str(path.parent / table[name])
    return tables


def parse_setting(text: str) -> tuple[str, Any]:
    """``KEY=VALUE`` to (key, value); the value is TOML, or a bare string.

    Raises
    ------
    UsageError
        If there is no '=', or the key is not PART.FIELD.
    """
    key, equals, value = text.partition("=")
    key = key.strip()
    if not equals or key.count(".") != 1:
        raise UsageError(f"--set {text}: write PART.FIELD=VALUE, such as density.scale=2")
    try:
        return key, tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        return key, value.strip()


def make_job(
    tables: Mapping[str, Any], settings: Sequence[tuple[str, Any]] = (), *, source: str = "job"
) -> Job:
    """A checked `Job` of a file's tables and of settings (dotted key, value) that win over them.

    Where a setting gives one of several that exclude each other (``color.grid`` against a
    ``color.constant`` of the file), the other one is dropped.

    Parameters
    ----------
    source
        The name of the file or command line, for messages.

    Raises
    ------
    UsageError
        One line for the first thing that is wrong: what, where, what to do.
    """
    merged: dict[str, Any] = {
        part: dict(table) if isinstance(table, Mapping) else table for part, table in tables.items()
    }
    given = {key for key, _ in settings}
    for key, value in settings:
        part, name = key.split(".")
        table = merged.setdefault(part, {})
        if not isinstance(table, dict):
            raise UsageError(f"{source}: {part} must be a table, [{part}]")
        for winner, loser in _EXCLUSIVE:
            if key == winner and loser not in given:
                table.pop(loser.split(".")[1], None)
        table[name] = value
    try:
        return Job.model_validate(merged)
    except ValidationError as error:
        raise UsageError(f"{source}: {_explained(error)}") from error


def job_as_toml(job: Job) -> str:
    """The job as TOML text, every field with its value; absent ones (None) are left out."""
    import tomli_w

    return tomli_w.dumps(job.model_dump(mode="json", exclude_none=True))


def _explained(error: ValidationError) -> str:
    """The first problem of a job in one line."""
    problem = error.errors()[0]
    where = ".".join(str(part) for part in problem["loc"] if isinstance(part, str))
    if problem["type"] == "extra_forbidden":
        close = difflib.get_close_matches(where, _known_keys(), n=1, cutoff=0.5)
        meant = f"; did you mean '{close[0]}'?" if close else ""
        return f"unknown key '{where}'{meant}"
    message = problem["msg"].removeprefix("Value error, ")
    message = message[:1].lower() + message[1:]
    if isinstance(problem["input"], (dict,)) or problem["type"] == "value_error":
        return f"{where}: {message}"
    return f"{where}: {message}, not {problem['input']!r}"


def _known_keys() -> list[str]:
    keys = list(Job.model_fields)
    for part, info in Job.model_fields.items():
        model: Any = info.annotation
        keys += [f"{part}.{name}" for name in model.model_fields]
    return keys
