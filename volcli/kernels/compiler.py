"""`jit`: how volcli compiles a kernel, and where the machine code is kept.

Numba keys its disk cache by the file of the compiled function alone: an edit of another file whose
functions were inlined goes unseen. So the cache folder carries a hash of every kernel source and of
numba's version. It lies in the user's cache folder, because site-packages may be read-only. Kernels
release the interpreter lock; the caller owns the threads.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from numba.core import config


def _cache_folder() -> Path:
    sources = sorted(Path(__file__).parent.glob("*.py"))
    digest = hashlib.sha256(numba.__version__.encode())
    for source in sources:
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


_FOLDER = str(_cache_folder())


def jit(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function: cached on disk, without the interpreter lock.

    Floating point follows IEEE but for contraction (a*b + c in one rounding); division by zero
    gives inf, as in NumPy.
    """
    before = config.CACHE_DIR
    config.CACHE_DIR = _FOLDER
    try:
        return numba.njit(
            cache=True, nogil=True, error_model="numpy", fastmath={"contract"}, inline="never"
        )(function)
    finally:
        config.CACHE_DIR = before
