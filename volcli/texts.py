"""Texts that a user names: job files, batch files, cameras; read with no faith in what is in them.

A text is a regular file that is not too large to be parsed in seconds, and what it holds is nested
no deeper than `DEEPEST`, so that whoever walks through it by recursion comes back. Whose text it
is, and what to say of an error, is known to those who call.
"""

from __future__ import annotations

import errno
import json
import re
import stat
import tomllib
from pathlib import Path
from typing import Any

LARGEST = 1 << 22
"""Bytes: jobs by the ten thousand. TOML takes a second or two a megabyte, JSON a hundredth."""

DEEPEST = 32

_LONG_KEY = re.compile(
    r"""(?<![\w"'.-])(?:[\w"'-]++[ \t]*+\.[ \t]*+){LEVELS}""".replace("LEVELS", str(DEEPEST))
)
"""A key of so many parts, in which the parser would take time that grows with their square."""


def read_text(path: Path, largest: int = LARGEST) -> str:
    """The text of a file in UTF-8.

    Parameters
    ----------
    largest
        Bytes.

    Raises
    ------
    OSError
        It cannot be read, is no regular file (a pipe may never end), or is too large.
    UnicodeDecodeError
        It is not UTF-8.
    """
    status = path.stat()
    if not (stat.S_ISREG(status.st_mode) or stat.S_ISDIR(status.st_mode)):
        raise OSError(errno.EINVAL, "not a regular file")
    with path.open("rb") as file:
        raw = file.read(largest + 1)
    if len(raw) > largest:
        raise OSError(errno.EFBIG, f"larger than the {largest >> 20} MiB that it may have")
    return raw.decode("utf-8-sig")


def parse_toml(text: str) -> dict[str, Any]:
    """The tables of a TOML text; ValueError says in one line what is wrong with it."""
    if _LONG_KEY.search(text):
        raise _too_deep()
    try:
        tables = tomllib.loads(text)
    except RecursionError as error:
        raise _too_deep() from error
    _check_depth(tables)
    return tables


def parse_json(text: str) -> Any:
    """What a JSON text stands for; ValueError says in one line what is wrong with it."""
    try:
        found = json.loads(text)
    except RecursionError as error:
        raise _too_deep() from error
    _check_depth(found)
    return found


def _check_depth(found: Any) -> None:
    level = [found]
    for _ in range(DEEPEST):
        level = [inner for outer in level for inner in _parts(outer)]
        if not level:
            return
    raise _too_deep()


def _parts(found: Any) -> Any:
    if isinstance(found, dict):
        return found.values()
    return found if isinstance(found, list) else ()


def _too_deep() -> ValueError:
    return ValueError(f"it is nested deeper than {DEEPEST} levels")
