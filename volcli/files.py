"""A file that appears whole or not at all, for what is not an image: pages, tables, plots.

Images have a writer of their own, which reads back what it wrote (`volcli.images`).
"""

from __future__ import annotations

import errno
import io
import os
from contextlib import suppress
from pathlib import Path
from typing import Any

from volcli.errors import OutputError
from volcli.leftovers import temporary_name


def write_file(path: Path, content: bytes, *, overwrite: bool = True) -> None:
    """Write bytes to a temporary file in the same folder, and move it into place.

    Raises
    ------
    OutputError
        The file exists and ``overwrite`` is False, or it cannot be written.
    """
    path = linked(path)
    temporary = temporary_name(path)
    try:
        with temporary.open("xb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        move_into_place(temporary, path, overwrite)
    except FileExistsError as error:
        raise OutputError(f"{path}: already exists; use --overwrite or another path") from error
    except (OSError, ValueError) as error:
        raise not_written(path, getattr(error, "strerror", None) or str(error)) from error
    finally:
        with suppress(OSError, ValueError):
            temporary.unlink()


def linked(path: Path) -> Path:
    """The file that a link leads to, which is written as open() would; any other path as it is.

    Raises
    ------
    OutputError
        Links lead in a circle, or the path cannot be one.
    """
    try:
        return path.resolve() if path.is_symlink() else path
    except (OSError, RuntimeError, ValueError) as error:  # RuntimeError: a circle
        raise not_written(path, getattr(error, "strerror", None) or str(error)) from error


def move_into_place(temporary: Path, path: Path, overwrite: bool) -> None:
    """Give a finished file its name; without ``overwrite`` even where another writer was faster.

    Raises
    ------
    FileExistsError
        There is one already, and it may not be overwritten.
    OSError
        It cannot be moved.
    """
    if overwrite:
        temporary.replace(path)
        return
    try:
        path.hardlink_to(temporary)
    except FileExistsError:
        raise
    except OSError as error:  # a file system without hard links
        if path.exists():
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST)) from error
        temporary.replace(path)


def not_written(path: Path, reason: str) -> OutputError:
    """What to raise for a file that could not be written."""
    return OutputError(
        f"{path}: could not be written ({reason}); check the free space and the permissions of "
        f"'{path.parent}'"
    )


FIGURES = (".png", ".svg", ".pdf")
"""The extensions of figures."""

_UNDATED: dict[str, dict[str, None]] = {
    ".png": {"Software": None},
    ".svg": {"Date": None},
    ".pdf": {"CreationDate": None},
}


def write_figure(path: Path, figure: Any, *, overwrite: bool = True) -> None:
    """Write a figure of matplotlib's in the format of the path's extension, without a date.

    Raises
    ------
    OutputError
        As `write_file`.
    """
    buffer = io.BytesIO()
    kind = path.suffix.lower()
    figure.savefig(buffer, format=kind.lstrip("."), metadata=_UNDATED[kind])
    write_file(path, buffer.getvalue(), overwrite=overwrite)
