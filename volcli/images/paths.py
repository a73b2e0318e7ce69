"""Where an image may be written: a path is judged before anything is computed.

Nothing here opens a file.
"""

import os
import stat
from pathlib import Path

from volcli.errors import OutputError, UsageError
from volcli.images.library import reason_of

IMAGES = (".exr", ".png")
"""The extensions of images that volcli writes."""


def check_output(
    path: str | os.PathLike[str], *, overwrite: bool = True, kinds: tuple[str, ...] = IMAGES
) -> None:
    """Refuse, before anything is computed, a path that a file cannot be written to.

    What only writing can show (a full disk, a quota) is left to the writers, which report it as
    the same `OutputError`.

    Parameters
    ----------
    kinds
        The extensions that there may be; by default those of images.

    Raises
    ------
    UsageError
        The extension is another.
    OutputError
        The folder is missing, is no folder or is read-only; the path is a folder or a special
        file; or it exists and ``overwrite`` is False.
    """
    path = Path(path)
    if os.path.isdir(path):  # noqa: PTH112 - Path.is_dir raises where a name is too long
        raise OutputError(f"{path}: is a folder; name a file inside it, such as picture{kinds[0]}")
    if path.suffix.lower() not in kinds:
        what = "image format" if kinds == IMAGES else "extension"
        raise UsageError(f"{path}: unknown {what} '{path.suffix}'; use {' or '.join(kinds)}")
    folder = path.parent
    try:
        folder_mode = mode_of(folder)
        mode = mode_of(path)
    except (OSError, ValueError) as error:
        raise OutputError(f"{path}: {reason_of(error)}; choose another path") from error
    if folder_mode is None:
        raise OutputError(f"{path}: the folder '{folder}' does not exist; create it first")
    if not stat.S_ISDIR(folder_mode):
        raise OutputError(f"{path}: '{folder}' is not a folder; choose another path")
    if mode is not None:
        if not stat.S_ISREG(mode):
            raise OutputError(f"{path}: is not a regular file; choose another path")
        if not overwrite:
            raise OutputError(f"{path}: already exists; use --overwrite or another path")
        if not os.access(path, os.W_OK):
            raise OutputError(f"{path}: is read-only; change its permissions or choose another")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise OutputError(f"{path}: the folder '{folder}' is not writable; choose another")


def checked_path(path: str | os.PathLike[str], suffix: str, overwrite: bool) -> Path:
    """A path that passed `check_output` and has the extension of its format."""
    path = Path(path)
    check_output(path, overwrite=overwrite)
    if path.suffix.lower() != suffix:
        raise UsageError(f"{path}: the extension must be {suffix} here, not {path.suffix}")
    return path


def mode_of(path: Path) -> int | None:
    """The st_mode of what `path` leads to, None where there is nothing."""
    try:
        return path.stat().st_mode
    except FileNotFoundError:
        return None
    except NotADirectoryError:
        return None  # the folder's own check says so
