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
from volcli.schema import Job, field

_FILES = ("density.file", "background.image", "output.image")
"""Fields that are paths: in a job file they are relative to the folder of that file."""

_ANY = object()

_ENDS: list[tuple[str, Any, str]] = [
    ("color.constant", _ANY, "color.grid"),
    ("color.grid", _ANY, "color.constant"),
    ("background.color", _ANY, "background.image"),
    ("background.image", _ANY, "background.color"),
    ("camera.type", "perspective", "camera.width"),
    ("quadrature.rule", "exact", "quadrature.step"),
]
"""(key, value, other key): the first, set on the command line, drops the other that a file set."""


def load_job(
    source: Path,
    flags: Sequence[tuple[str, Any]] = (),
    settings: Sequence[str] = (),
    spelled: Mapping[str, str] | None = None,
) -> Job:
    """The job of a source, which is a job file (.toml) or a volume, with flags on top.

    Parameters
    ----------
    flags
        (dotted key, value); they win over the file.
    settings
        ``KEY=VALUE`` texts; they win over the flags.
    spelled
        How the user wrote a flag, by its key, for messages: ``--step 0``.

    Raises
    ------
    UsageError
        In one line, for the first thing that is wrong.
    """
    spelled = dict(spelled or {})
    extra = []
    for text in settings:
        key, value = parse_setting(text)
        spelled[key] = f"--set {text}"
        extra.append((key, value))
    if source.suffix.lower() == ".toml":
        tables, name = read_job_file(source), str(source)
    else:
        tables, name = {"density": {"file": source}}, "command line"
    job = make_job(tables, [*flags, *extra], source=name, spelled=spelled)
    if job.density.file is None:
        raise UsageError(f"{name}: no density.file; name the volume to render")
    return job


def read_job_file(path: Path) -> dict[str, Any]:
    """The tables of a job file, paths made relative to where the user stands.

    Raises
    ------
    UsageError
        If the file cannot be read, or is not TOML.
    """
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except FileNotFoundError as error:
        raise UsageError(f"{path}: no such job file; check the path") from error
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
    """``KEY=VALUE`` to (key, value); the value is TOML, or a bare string; no value is None.

    Raises
    ------
    UsageError
        If there is no '=', or the key is not PART.FIELD.
    """
    key, equals, value = text.partition("=")
    key = key.strip()
    if not equals or key.count(".") != 1:
        raise UsageError(f"--set {text}: write PART.FIELD=VALUE, such as density.scale=2")
    if not value.strip():
        return key, None
    try:
        return key, tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        return key, value.strip()


def make_job(
    tables: Mapping[str, Any],
    settings: Sequence[tuple[str, Any]] = (),
    *,
    source: str = "job",
    spelled: Mapping[str, str] | None = None,
) -> Job:
    """A checked `Job` of a file's tables and of settings (dotted key, value) that win over them.

    Where a setting gives one of several that exclude each other (``color.grid`` against a
    ``color.constant`` of the file), the other one is dropped. None takes a field back to its
    default.

    Parameters
    ----------
    source
        The name of the file or command line, for messages.
    spelled
        How the user wrote a setting, by its key, for messages.

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
            raise UsageError(f"{source}: {part}: must be a table, [{part}]")
        for winner, wanted, loser in _ENDS:
            if key == winner and wanted in (_ANY, value) and loser not in given:
                table.pop(loser.split(".")[1], None)
        if value is None and key in _known_keys():
            table.pop(name, None)
        else:
            table[name] = value
    try:
        return Job.model_validate(merged)
    except ValidationError as error:
        raise UsageError(_explained(error, source, spelled or {})) from error


def job_as_toml(job: Job) -> str:
    """The job as TOML text, every field with its value; absent ones (None) are left out."""
    import tomli_w

    return tomli_w.dumps(job.model_dump(mode="json", exclude_none=True))


# -- what is wrong, in one line -------------------------------------------------------------------

_KINDS = {
    "float": "a number",
    "int": "a whole number",
    "path": "a path in quotes",
    "string": "text in quotes",
    "bool": "true or false",
}

_LIMITS = {
    "greater_than": ("above", "gt"),
    "greater_than_equal": ("at least", "ge"),
    "less_than": ("below", "lt"),
    "less_than_equal": ("at most", "le"),
}


def _explained(error: ValidationError, source: str, spelled: Mapping[str, str]) -> str:
    """The first problem of a job in one line: where, what, and what it must be."""
    problem = error.errors()[0]
    key = ".".join([part for part in problem["loc"] if isinstance(part, str)][:2])
    where = spelled.get(key, f"{source}: {key}")
    if problem["type"] == "value_error":
        message = problem["msg"].removeprefix("Value error, ")
        return f"{where}: {message}" if "." in key else f"{source}: {message}"
    if problem["type"] == "extra_forbidden":
        return f"{spelled.get(key, source)}: unknown key '{key}'{_suggested(key)}"
    value = problem["input"]
    if key not in spelled and not isinstance(value, Mapping) and problem["type"] != "missing":
        return f"{where}: must be {_wanted(key, problem)}, not {value!r}"
    return f"{where}: must be {_wanted(key, problem)}"


def _wanted(key: str, problem: Any) -> str:
    """What a value must be, from pydantic's type of problem and the field."""
    kind, context = problem["type"], problem.get("ctx", {})
    if "." not in key:
        return f"a table, [{key}]"
    if kind in _LIMITS:
        word, limit = _LIMITS[kind]
        return f"{word} {context[limit]:g}"
    if kind == "finite_number":
        return "finite"
    if kind == "literal_error":
        return str(context["expected"])
    _, default = field(key)
    if kind.startswith("tuple") or kind in ("missing", "too_long", "too_short"):
        if default == ():
            return 'a list of names in quotes, such as ["depth"]'
        count = 3 if default is None else len(default)
        return f"a list of {count} numbers"
    if kind.endswith("path_type"):
        return _KINDS["path"]
    return _KINDS.get(kind.split("_")[0], problem["msg"].removeprefix("Input should be "))


def _suggested(key: str) -> str:
    """What may have been meant by a key that there is not."""
    known = _known_keys()
    part, dot, name = key.partition(".")
    if not dot:
        close = difflib.get_close_matches(part, [k for k in known if "." not in k], n=1)
        other = ", ".join(k for k in known if "." not in k)
        return f"; did you mean '{close[0]}'?" if close else f"; a job has: {other}"
    names = [k.partition(".")[2] for k in known if k.startswith(f"{part}.")]
    close = [f"{part}.{n}" for n in difflib.get_close_matches(name, names, n=1)]
    close += [k for k in known if k.endswith(f".{name}")]
    return f"; did you mean '{close[0]}'?" if close else f"; [{part}] has: {', '.join(names)}"


def _known_keys() -> list[str]:
    keys = list(Job.model_fields)
    for part, info in Job.model_fields.items():
        model: Any = info.annotation
        keys += [f"{part}.{name}" for name in model.model_fields]
    return keys
