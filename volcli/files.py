"""A file that appears whole or not at all, for what is not an image: pages, tables, plots.

Images have a writer of their own, which reads back what it wrote (`volcli.images`).
"""

from __future__ import annotations

import io
import os
import secrets
from contextlib import suppress
from pathlib import Path
from typing import Any

from volcli.errors import OutputError


def write_file(path: Path, content: bytes, *, overwrite: bool = True) -> None:
    """Write bytes to a temporary file in the same folder, and move it into place.

    Raises
    ------
    OutputError
        The file exists and ``overwrite`` is False, or it cannot be written.
    """
    if path.is_symlink():
        path = path.resolve()  # write the file that the link leads to, as open() would
    temporary = path.with_name(f".volcli-{os.getpid()}-{secrets.token_hex(4)}")
    try:
        with temporary.open("xb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        if not overwrite and path.exists():
            raise OutputError(f"{path}: already exists; use --overwrite or another path")
        temporary.replace(path)
    except OSError as error:
        raise OutputError(
            f"{path}: could not be written ({error.strerror or error}); check the free space and "
            f"the permissions of '{path.parent}'"
        ) from error
    finally:
        with suppress(OSError):
            temporary.unlink()


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
