"""Grids kept in the memory of a worker from one job to its next: each is read once.

Given to `run.load` in place of a cache's folder; a folder may lie below it.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path

from volcli.grids import BrickGrid
from volcli.grids.cache import through_cache

Loaded = tuple[BrickGrid, list[str]]
_Key = tuple[object, ...]


class KeptGrids:
    """Grids that were loaded, the least recently used dropped first.

    A grid that is dropped stays in memory while a job still renders it.

    Parameters
    ----------
    folder
        A cache on disk that grids are looked for in before they are read, or None.
    """

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder
        self._grids: OrderedDict[_Key, Loaded] = OrderedDict()
        self._reading: dict[_Key, threading.Lock] = {}
        self._lock = threading.Lock()

    def __call__(
        self, source: Path, label: str, settings: tuple[str, ...], load: Callable[[], Loaded]
    ) -> Loaded:
        """The grid of a file: from memory, from the folder, or from ``load``."""
        status = source.stat()
        key = (source, status.st_size, status.st_mtime_ns, label, settings)
        with self._lock:
            reading = self._reading.setdefault(key, threading.Lock())
        with reading:  # two jobs that want one grid at once read it once
            with self._lock:
                found = self._grids.get(key)
                if found is not None:
                    self._grids.move_to_end(key)
            if found is None:
                if self._folder is None:
                    found = load()
                else:
                    found = through_cache(self._folder, source, label, settings, load)
                with self._lock:
                    self._grids[key] = found
        grid, warnings = found
        return grid, list(warnings)

    @property
    def nbytes(self) -> int:
        """Bytes of the grids that are kept."""
        with self._lock:
            return sum(grid.nbytes for grid, _ in self._grids.values())

    def shrink(self, limit: int) -> None:
        """Drop grids, the least recently used first, until no more than so many bytes are kept."""
        with self._lock:
            held = sum(grid.nbytes for grid, _ in self._grids.values())
            while self._grids and held > limit:
                key, (grid, _) = self._grids.popitem(last=False)
                self._reading.pop(key, None)
                held -= grid.nbytes
