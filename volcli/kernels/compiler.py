"""How volcli compiles kernels, and where the machine code is kept.

    jit       a function that kernels call: always inlined
    kernel    an entry point, called from Python: cached on disk

Three settings were found by measuring, and matter:

* Reference counting is off (``_nrt``). Numba counts references to each array that passes through a
  tuple, atomically, in the innermost loop: ten times the time of the arithmetic for a colour grid.
  So kernels allocate nothing; callers own all arrays.
* Functions are always inlined. A tuple of arrays is passed by value, some eighty words a call.
* The cache folder carries a hash of every kernel source and of numba's version. Numba keys its
  cache by the file of the entry point alone, and would not see an edit of a file it calls into. It
  lies in the user's cache folder, because site-packages may be read-only.

Kernels release the interpreter lock; the caller owns the threads. Floating point follows IEEE but
for contraction (a*b + c in one rounding); division by zero gives inf, as in NumPy.
"""

from __future__ import annotations

import hashlib
import os
import stat
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

import numba
from numba.core import config, event

_OPTIONS: dict[str, Any] = {
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"contract"},
    "_nrt": False,
}

notes: list[str] = []
"""What the user should know of where kernels are kept."""


def jit(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function that kernels call.

    Nobody else can: what it would take to be called from Python is left out, a third of the time
    that a kernel takes to compile. (Tests call them through an entry of their own.)
    """
    bare: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    return numba.njit(forceinline=True, **bare, **_OPTIONS)(function)


def kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile an entry point, kept on disk for the next process."""
    folder = _cache_folder()
    if folder is None:
        return numba.njit(**_OPTIONS)(function)
    before = config.CACHE_DIR  # type: ignore[attr-defined]
    config.CACHE_DIR = str(folder)  # type: ignore[attr-defined]
    try:
        return numba.njit(cache=True, **_OPTIONS)(function)
    finally:
        config.CACHE_DIR = before  # type: ignore[attr-defined]


@contextmanager
def when_compiling(call: Callable[[], None]) -> Iterator[None]:
    """Call something as soon as a compilation begins; what the cache holds is loaded in silence."""

    class Listener(event.Listener):
        def on_start(self, _: Any) -> None:
            call()

        def on_end(self, _: Any) -> None:
            pass

    with event.install_listener("numba:compile", Listener()):
        yield


@cache
def _cache_folder() -> Path | None:
    """Where machine code is kept; None where there is no such place."""
    digest = hashlib.sha256(numba.__version__.encode())
    for source in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(source.read_bytes())
    name = f"kernels-{digest.hexdigest()[:16]}"
    base = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME")
    wanted = Path(base or "~/.cache")
    with suppress(OSError, RuntimeError):  # the latter: there is no home
        wanted = wanted.expanduser()
        folder = wanted / "volcli" / name
        folder.mkdir(parents=True, exist_ok=True)
        if os.access(folder, os.W_OK):
            return folder
    instead: Path | None = None
    kept = "are compiled for each run"
    with suppress(OSError):
        folder = _own_folder() / name
        folder.mkdir(exist_ok=True)
        instead, kept = folder, f"are kept in {folder}"
    notes.append(f"{wanted}: cannot be written; kernels {kept}; NUMBA_CACHE_DIR names a folder")
    return instead


def _own_folder() -> Path:
    """A folder among the temporary ones that nobody else can write to: what is read from it is run.

    Raises
    ------
    OSError
        Somebody else has taken its name, or none can be made.
    """
    folder = Path(tempfile.gettempdir()) / f"volcli-kernels-{os.geteuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    status = folder.lstat()
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.geteuid() or status.st_mode & 0o022:
        raise PermissionError(f"{folder} is not this user's own")
    return folder
