"""Job files and settings of the command line to a `Job`.

Flags win over the file, the file over defaults.
"""

from __future__ import annotations

import copy
import difflib
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from volcli.errors import UsageError
from volcli.schema import Job, field, keys, table_of
from volcli.sources import SOURCES
from volcli.texts import parse_toml, read_text

PATHS = (
    "density.file",
    "color.file",
    "emission.file",
    "camera.transforms",
    "background.image",
    "output.image",
)
"""Fields that are paths: in a job file they are relative to the folder of that file."""

_ANY = object()

_EMITTED = ("grid", "ramp", "blackbody")

_PINHOLE = ("fov", "focal", "principal")
_POSE = ("type", "eye", "target", "up", "width", *_PINHOLE)

_ENDS: list[tuple[str, Any, str]] = [
    *((f"color.{a}", _ANY, f"color.{b}") for a in SOURCES for b in SOURCES if a != b),
    *((f"emission.{a}", _ANY, f"emission.{b}") for a in _EMITTED for b in _EMITTED if a != b),
    ("emission.ramp", _ANY, "emission.constant"),
    ("emission.blackbody", _ANY, "emission.constant"),
    *(
        (f"{part}.ramp.{a}", _ANY, f"{part}.ramp.{b}")
        for part in ("color", "emission")
        for a, b in (("map", "stops"), ("stops", "map"), ("range", "stops"), ("stops", "range"))
    ),
    ("background.color", _ANY, "background.image"),
    ("background.image", _ANY, "background.color"),
    ("camera.type", "perspective", "camera.width"),
    ("camera.type", "panorama", "camera.width"),
    *(
        ("camera.type", kind, f"camera.{n}")
        for kind in ("orthographic", "panorama")
        for n in _PINHOLE
    ),
    ("camera.focal", _ANY, "camera.fov"),
    ("camera.fov", _ANY, "camera.focal"),
    ("camera.fov", _ANY, "camera.principal"),
    ("camera.eye", _ANY, "camera.transforms"),
    ("camera.eye", _ANY, "camera.frame"),
    *(("camera.transforms", _ANY, f"camera.{name}") for name in _POSE),
    ("quadrature.rule", "exact", "quadrature.step"),
    *(
        ("quadrature.rule", "midpoint", f"quadrature.{name}")
        for name in ("max_error", "target_error")
    ),
    *(
        (f"quadrature.{name}", _ANY, f"quadrature.{other}")
        for name in ("max_error", "target_error")
        for other in ("rule", "step", "max_error", "target_error")
        if name != other
    ),
]
"""(key, value, other key): the first, set on the command line, drops the other that a file set.

A key inside a table stands for the table too: ``color.ramp.map`` drops ``color.grid``.
"""


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
    return from_folder(read_toml(path), path.parent)


def read_toml(path: Path) -> dict[str, Any]:
    """The tables of a TOML file.

    Raises
    ------
    UsageError
        If the file cannot be read, or is not TOML.
    """
    try:
        return parse_toml(read_text(path))
    except FileNotFoundError as error:
        raise UsageError(f"{path}: no such job file; check the path") from error
    except OSError as error:
        raise UsageError(f"{path}: cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise UsageError(f"{path}: is not a text file in UTF-8") from error
    except ValueError as error:
        raise UsageError(f"{path}: is not TOML: {error}") from error


def from_folder(tables: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Tables of a job with their paths, which are relative to a folder, made relative to where the
    user stands.
    """
    moved = copy.deepcopy(dict(tables))
    for key in PATHS:
        part, name = key.split(".")
        table = moved.get(part)
        if isinstance(table, dict) and isinstance(table.get(name), str):
            table[name] = str(folder / table[name])
    return moved


def parse_setting(text: str) -> tuple[str, Any]:
    """``KEY=VALUE`` to (key, value); the value is TOML, or a bare string; no value is None.

    Raises
    ------
    UsageError
        If there is no '=', or the key is not PART.FIELD or PART.TABLE.FIELD.
    """
    key, equals, value = text.partition("=")
    key = key.strip()
    if not equals or key.count(".") not in (1, 2):
        raise UsageError(f"--set {text}: write PART.FIELD=VALUE, such as density.scale=2")
    if not value.strip():
        return key, None
    try:
        return key, parse_toml(f"value = {value}")["value"]
    except ValueError:
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
    merged: dict[str, Any] = copy.deepcopy(dict(tables))
    given = {key for key, _ in settings}
    for key, value in settings:
        for winner, wanted, loser in _ENDS:
            wins = key == winner or key.startswith(f"{winner}.")
            if wins and wanted in (_ANY, value) and not _given(loser, given):
                _table(merged, loser, source).pop(loser.split(".")[-1], None)
        table, name = _table(merged, key, source), key.split(".")[-1]
        if value is None and key in keys():
            table.pop(name, None)
        else:
            table[name] = value
    try:
        return Job.model_validate(merged)
    except ValidationError as error:
        raise UsageError(_explained(error, source, spelled or {})) from error


def _given(key: str, given: set[str]) -> bool:
    """Whether a key, or one inside it, is among those that were given."""
    return any(other == key or other.startswith(f"{key}.") for other in given)


def _table(tables: dict[str, Any], key: str, source: str) -> dict[str, Any]:
    """The table that a key lies in, made where there is none."""
    path = key.split(".")[:-1]
    for depth, part in enumerate(path, 1):
        tables = tables.setdefault(part, {})
        if not isinstance(tables, dict):
            where = ".".join(path[:depth])
            raise UsageError(f"{source}: {where}: must be a table, [{where}]")
    return tables


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

_LISTS = {
    "camera.focal": "a list of 2 numbers, [across, down]",
    "camera.principal": "a list of 2 numbers, [x, y]",
    "camera.resolution": "a list of 2 whole numbers, [width, height]",
    "density.ramp.stops": "a list of [value, density] pairs",
    "stops": "a list of [value, R, G, B] rows of numbers",
    "range": "a list of 2 numbers, [low, high]",
}
"""What a list must hold, by its key or the last part of it, where it is not three numbers."""

_LIMITS = {
    "greater_than": ("above", "gt"),
    "greater_than_equal": ("at least", "ge"),
    "less_than": ("below", "lt"),
    "less_than_equal": ("at most", "le"),
}


def _explained(error: ValidationError, source: str, spelled: Mapping[str, str]) -> str:
    """The first problem of a job in one line: where, what, and what it must be."""
    problem = error.errors()[0]
    named = itertools.takewhile(lambda part: isinstance(part, str), problem["loc"])
    key = ".".join(str(part) for part in named)
    where = _spelled(key, spelled) or f"{source}: {key}"
    if problem["type"] == "value_error":
        message = problem["msg"].removeprefix("Value error, ")
        return f"{where}: {message}" if "." in key else f"{source}: {message}"
    if problem["type"] == "extra_forbidden":
        written = _written(key, spelled)
        where = source if written is None else spelled[written]
        return f"{where}: unknown key '{key}'{_suggested(key)}"
    value = problem["input"]
    if problem["type"] == "missing" and isinstance(problem["loc"][-1], str):
        return f"{where}: is missing; give {_wanted(key, problem)}"
    if key not in spelled and not isinstance(value, Mapping) and problem["type"] != "missing":
        return f"{where}: must be {_wanted(key, problem)}, not {value!r}"
    return f"{where}: must be {_wanted(key, problem)}"


def _spelled(key: str, spelled: Mapping[str, str]) -> str | None:
    """How the user wrote a setting of a key; or of the table that it lies in, and the key."""
    written = _written(key, spelled)
    if written is None:
        return None
    return spelled[key] if written == key else f"{spelled[written]}: {key}"


def _written(key: str, spelled: Mapping[str, str]) -> str | None:
    """The key that the user wrote, of a key or of the table that it lies in."""
    while key and key not in spelled:
        key = key.rpartition(".")[0]
    return key or None


def _wanted(key: str, problem: Any) -> str:
    """What a value must be, from pydantic's type of problem and the field."""
    kind, context = problem["type"], problem.get("ctx", {})
    if _is_table(key):
        return f"a table, [{key}]"
    if kind in _LIMITS:
        word, limit = _LIMITS[kind]
        return f"{word} {context[limit]:g}"
    if kind == "finite_number":
        return "finite"
    if kind == "literal_error":
        return str(context["expected"])
    if kind.startswith("tuple") or kind in ("missing", "too_long", "too_short"):
        return _LISTS.get(key) or _LISTS.get(key.rpartition(".")[2]) or _sized(key)
    if kind.endswith("path_type"):
        return _KINDS["path"]
    return _KINDS.get(kind.split("_")[0], problem["msg"].removeprefix("Input should be "))


def _sized(key: str) -> str:
    """What a list must hold, from the default of its field; a field without one is a name."""
    _, default = field(key)
    if key.endswith(".grid"):
        return "the name of a grid in quotes"
    if default == ():
        return 'a list of names in quotes, such as ["depth"]'
    count = 3 if default is None else len(default)
    return f"a list of {count} numbers"


def _is_table(key: str) -> bool:
    model: Any = Job
    for part in key.split("."):
        model = table_of(model, part)
        if model is None:
            return False
    return True


def _suggested(key: str) -> str:
    """What may have been meant by a key that there is not."""
    known = keys()
    table, _, name = key.rpartition(".")
    inside = [k for k in known if k.rpartition(".")[0] == table]
    names = [k.rpartition(".")[2] for k in inside]
    close = [f"{table}.{n}".strip(".") for n in difflib.get_close_matches(name, names, n=1)]
    if table:
        close += [k for k in known if k.endswith(f".{name}")]
    if close:
        return f"; did you mean '{close[0]}'?"
    return f"; {f'[{table}]' if table else 'a job'} has: {', '.join(names)}"
