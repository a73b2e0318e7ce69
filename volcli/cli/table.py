"""What commands print to stdout: plain tables, columns lined up, nothing drawn."""

from __future__ import annotations

import json
import math
import os
import shutil
import sys
import textwrap
import unicodedata
from collections.abc import Iterator, Sequence
from itertools import zip_longest
from typing import Any

from volcli.errors import OutputError


def say(text: str = "") -> None:
    """Print to stdout at once, so that it keeps its place among the lines on stderr.

    A reader that has gone away (``| head -1``) is not an error: the rest goes nowhere.

    Raises
    ------
    OutputError
        It goes to a file, and the disk is full.
    """
    try:
        print(text, flush=True)
    except OSError as error:
        # What could not be written is still in the buffer, and would fail again at the end.
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)
        if not isinstance(error, BrokenPipeError):
            raise OutputError(f"stdout: cannot be written ({error.strerror})") from error


def say_json(found: Any) -> None:
    """Print one JSON object, with null for what is NaN or infinite, which JSON does not have."""
    say(json.dumps(_finite(found), allow_nan=False))


def _finite(found: Any) -> Any:
    if isinstance(found, dict):
        return {name: _finite(value) for name, value in found.items()}
    if isinstance(found, list | tuple):
        return [_finite(value) for value in found]
    return None if isinstance(found, float) and not math.isfinite(found) else found


def terminal_width() -> int:
    """Columns to print in: the terminal's; 100 where output goes to a file or a pipe."""
    return max(40, shutil.get_terminal_size((100, 24)).columns)


def table(head: Sequence[str], rows: Sequence[Sequence[str]], width: int | None = None) -> str:
    """Rows of text under a heading, each column as wide as its widest cell.

    Parameters
    ----------
    width
        Where the columns do not fit, those that are left over follow as a further table, which
        repeats the first column; text that does not fit beside it goes on below. None: they
        always fit.
    """
    lines = [list(head), *[list(row) for row in rows]]
    if width is None:
        cells = [[[text] for text in line] for line in lines]
    else:
        first = min(max(_columns(line[0]) for line in lines), width // 2)
        limits = [first] + [width - first - 2] * (len(head) - 1)
        cells = [
            [_wrapped(text, limit) for text, limit in zip(line, limits, strict=True)]
            for line in lines
        ]
    widths = [max(_columns(part) for line in cells for part in line[i]) for i in range(len(head))]
    groups: list[list[int]] = [[0]]
    for column in range(1, len(head)):
        taken = sum(widths[i] + 2 for i in groups[-1])
        if width is not None and len(groups[-1]) > 1 and taken + widths[column] > width:
            groups.append([0])
        groups[-1].append(column)

    def row(line: list[list[str]], group: list[int]) -> Iterator[str]:
        for parts in zip_longest(*(line[i] for i in group), fillvalue=""):
            padded = (
                part + " " * (widths[i] - _columns(part))
                for i, part in zip(group, parts, strict=True)
            )
            yield "  ".join(padded).rstrip()

    return "\n\n".join("\n".join(text for line in cells for text in row(line, g)) for g in groups)


def _wrapped(text: str, limit: int) -> list[str]:
    """A text in lines of no more columns than ``limit``."""
    if _columns(text) <= limit:
        return [text]
    letters = limit if _columns(text) == len(text) else max(1, limit // 2)  # wide ones take two
    return textwrap.wrap(text, letters, break_on_hyphens=False) or [""]


def in_short(text: str, limit: int = 40) -> str:
    """A text with its middle left out where it has more characters than ``limit``."""
    half = (limit - 3) // 2
    return text if len(text) <= limit else f"{text[:half]}...{text[-half:]}"


def _columns(text: str) -> int:
    """How many columns of a terminal a text takes: wide characters of East Asia take two."""
    return sum(1 + (unicodedata.east_asian_width(c) in "WF") for c in text)


def in_bytes(count: int) -> str:
    """A number of bytes for people: 23.6 MB."""
    value = float(count)
    for unit in ("B", "kB", "MB", "GB"):
        if value < 1000 or unit == "GB":
            break
        value /= 1000
    return f"{value:.0f} {unit}" if unit == "B" else f"{value:.1f} {unit}"
