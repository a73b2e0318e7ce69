"""Kernels made ready in a thread while a volume is read.

They come from the cache of machine code, or are compiled, once on a machine for each combination of
terms. What is compiled depends on types alone, and those follow from the headers of a volume: so a
stand-in for it will do. Much of the work is LLVM's, which does not hold the interpreter.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from volcli.grids import GridHeader, Progress, Tree
from volcli.grids.census import Census


class WarmUp:
    """Kernels on their way: begun when this is made, in a thread of its own.

    Parameters
    ----------
    use_kernels
        Calls the kernels that will be called later, with arguments of the same types.
    """

    def __init__(self, use_kernels: Callable[[], None]) -> None:
        self._settled = threading.Event()  # a compilation has begun, or all is done
        self._use_kernels = use_kernels
        pool = ThreadPoolExecutor(1, thread_name_prefix="kernels")
        self._ready = pool.submit(self._run)
        self._ready.add_done_callback(lambda _: self._settled.set())
        pool.shutdown(wait=False)  # the thread ends with its work

    def wait(self, compiling: Progress) -> None:
        """Return once the kernels are ready.

        Parameters
        ----------
        compiling
            Called with (0, 1) before and (1, 1) after a wait for a compilation, which takes
            seconds; not where kernels come out of the cache, or are compiled already.

        Raises
        ------
        Exception
            Whatever went wrong in the thread.
        """
        self._settled.wait()
        if not self._ready.done():
            compiling(0, 1)
            self._ready.result()
            compiling(1, 1)
        self._ready.result()

    def _run(self) -> None:
        from volcli.kernels.compiler import when_compiling

        with when_compiling(self._settled.set):
            self._use_kernels()


@dataclass(frozen=True)
class StandIn:
    """A volume with the grids of another, each of a single leaf with values from 0 to 1."""

    path: Path
    headers: tuple[GridHeader, ...]

    def census(self, header: GridHeader) -> Census:
        """What that leaf holds: next to nothing."""
        return Census(1, 0, 0, 0)

    def read_tree(self, header: GridHeader, progress: Progress | None = None) -> Tree:
        """That leaf, at the origin."""
        channels = (3,) if header.is_vector else ()
        values = np.linspace(0, 1, 512, dtype=np.float32).reshape(1, 8, 8, 8)
        return Tree(
            background=np.zeros(channels, np.float32),
            leaf_origins=np.zeros((1, 3), np.int32),
            leaf_values=np.stack([values] * 3, axis=-1) if channels else values,
            leaf_masks=np.full((1, 64), 255, np.uint8),
            tile_origins=np.empty((0, 3), np.int32),
            tile_widths=np.empty(0, np.int32),
            tile_values=np.empty((0, *channels), np.float32),
            tile_active=np.empty(0, np.bool_),
        )
