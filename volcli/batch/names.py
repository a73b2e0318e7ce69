"""Names of outputs from the fields of a job: ``out/{stem}_{quadrature.step}.{frame:04d}.exr``.

``{stem}`` and ``{folder}`` are of the volume's file, ``{frame}`` is the frame's number, and any
other name is that of a field of the job. What follows a colon is Python's way to write a value.
"""

from __future__ import annotations

import difflib
import string
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from volcli.errors import UsageError
from volcli.schema import Job


def paths_of(job: Job) -> dict[str, Path]:
    """The files that a job names, by the dotted names of their fields."""
    return {key: value for key, value in _fields(job).items() if isinstance(value, Path)}


def with_paths(job: Job, paths: dict[str, Path]) -> Job:
    """The job with other files."""
    return _updated(job, paths)


def fill(path: Path, job: Job, frame: int | None, where: str) -> Path:
    """The path of a job's output, from one with ``{...}`` in it.

    Raises
    ------
    UsageError
        If a name is not known, or has no value in this job.
    """
    values = _fields(job)
    file = job.density.file
    if file is not None:
        values |= {"stem": file.stem, "folder": file.absolute().parent.name}
    values["frame"] = frame
    try:
        return Path(_Template(values, where).format(str(path)))
    except (ValueError, IndexError) as error:
        raise UsageError(
            f"{where}: {path}: {error}; write {{{{ and }}}} for braces that are meant as such"
        ) from error


class _Template(string.Formatter):
    """Looks a name up among values, and looks into nothing."""

    def __init__(self, values: dict[str, Any], where: str) -> None:
        self._values, self._where = values, where

    def get_field(self, field_name: str, args: Any, kwargs: Any) -> tuple[Any, str]:
        if field_name not in self._values:
            close = difflib.get_close_matches(field_name, self._values, n=1)
            hint = f"did you mean {{{close[0]}}}?" if close else "there are stem, folder, frame"
            raise UsageError(f"{self._where}: {{{field_name}}} is no field of a job; {hint}")
        value = self._values[field_name]
        if value is None:
            raise UsageError(f"{self._where}: {{{field_name}}} has no value in this job")
        return value, field_name

    def format_field(self, value: Any, format_spec: str) -> str:
        return super().format_field(value, format_spec) if format_spec else _text(value)


def _text(value: Any) -> str:
    """A value as part of a name: no slashes, no more digits than it needs."""
    if isinstance(value, Path):
        return value.stem
    if isinstance(value, tuple | list):
        return "_".join(_text(v) for v in value)
    if isinstance(value, float):
        return f"{value:g}"
    return str(value).replace("/", "-").replace("\0", "")


def _fields(model: BaseModel, prefix: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name in type(model).model_fields:
        value = getattr(model, name)
        if isinstance(value, BaseModel):
            found |= _fields(value, f"{prefix}{name}.")
        else:
            found[prefix + name] = value
    return found


def _updated(model: Any, changes: dict[str, Any]) -> Any:
    own = {key: value for key, value in changes.items() if "." not in key}
    for part in {key.partition(".")[0] for key in changes if "." in key}:
        below = {k.partition(".")[2]: v for k, v in changes.items() if k.startswith(f"{part}.")}
        own[part] = _updated(getattr(model, part), below)
    return model.model_copy(update=own)
