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
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
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


def jit(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function that kernels call.

    Nobody else can: what it would take to be called from Python is left out, a third of the time
    that a kernel takes to compile. (Tests call them through an entry of their own.)
    """
    bare = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    return numba.njit(forceinline=True, **bare, **_OPTIONS)(function)


def kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile an entry point, kept on disk for the next process."""
    before = config.CACHE_DIR  # type: ignore[attr-defined]
    config.CACHE_DIR = str(_cache_folder())  # type: ignore[attr-defined]
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


def _cache_folder() -> Path:
    digest = hashlib.sha256(numba.__version__.encode())
    for source in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(source.read_bytes())
    name = f"kernels-{digest.hexdigest()[:16]}"
    base = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME")
    candidates = [Path(base)] if base else []
    candidates += [Path("~/.cache").expanduser(), Path(tempfile.gettempdir())]
    for candidate in candidates:
        folder = candidate / "volcli" / name
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(folder, os.W_OK):
            return folder
    return Path(tempfile.mkdtemp(prefix="volcli-"))
