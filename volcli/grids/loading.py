"""A grid of a volume to bricks, as a density or as a source of light, by way of the cache.

What is done to values on the way (NaN, negative densities, level sets) is in `values` and
`level_set`; which grid is read is settled before.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from volcli.grids.brick import BrickGrid
from volcli.grids.build import build
from volcli.grids.level_set import fog_of_level_set
from volcli.grids.tree import GridHeader, Progress, Tree, Volume
from volcli.grids.values import active_range, clamp_negative, settle_nonfinite
from volcli.memory import no_room

Transfer = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""Densities of values, where a job has a transfer function: values below 0 are then kept."""

Reading = Callable[[], tuple[BrickGrid, list[str]]]
"""Reads a grid: its bricks, and what the user should know of them."""

Cache = Path | Callable[[Path, str, tuple[str, ...], Reading], tuple[BrickGrid, list[str]]]
"""Keeps bricks from one load to the next: a folder (`grids.cache`), or what is called as
``cache(file, label, settings, read)`` and may keep them elsewhere.
"""


def load_density(
    volume: Volume,
    header: GridHeader,
    nonfinite: str,
    progress: Progress | None = None,
    cache: Cache | None = None,
    *,
    level_set: bool = False,
    transfer: Transfer | None = None,
) -> tuple[BrickGrid, list[str]]:
    """Read a grid as a density, with warnings on what was changed.

    Values below 0 become 0, unless there is a transfer function.

    Parameters
    ----------
    nonfinite
        What NaN and Inf are: ``error``, or ``zero``.
    cache
        What keeps bricks from one load to the next.
    level_set
        Whether the grid is a level set, to be taken as fog.
    transfer
        What the kernels make of values; of use here for warnings alone.

    Raises
    ------
    VolumeError
        If the file is damaged, or holds NaN or Inf and ``nonfinite`` is ``error``.
    """
    where = _where(volume, header)

    def read() -> tuple[BrickGrid, list[str]]:
        tree, notes = settle_nonfinite(volume.read_tree(header, progress), where, nonfinite)
        if level_set:
            tree = fog_of_level_set(tree)
        if transfer is None:
            tree, clamped = clamp_negative(tree, where)
            notes = notes + clamped
        return build(tree, header), notes

    form = ["density", "fog"][level_set] + ["", " as stored"][transfer is not None]
    grid, notes = _cached(read, volume, header, form, nonfinite, cache)
    return grid, notes + _density_notes(grid, where, transfer)


def load_source(
    volume: Volume,
    header: GridHeader,
    nonfinite: str,
    progress: Progress | None = None,
    cache: Cache | None = None,
) -> tuple[BrickGrid, list[str]]:
    """Read a grid as a source of light, scalar or Vec3, with its values as they are.

    A scalar grid comes with the range of its active values, for a ramp. Parameters, and what is
    raised, are those of `load_density`.
    """
    where = _where(volume, header)

    def read() -> tuple[BrickGrid, list[str]]:
        tree, notes = settle_nonfinite(volume.read_tree(header, progress), where, nonfinite)
        grid = build(tree, header)
        return replace(grid, active_range=None if header.is_vector else active_range(tree)), notes

    return _cached(read, volume, header, "source", nonfinite, cache)


def density_of_source(
    source: BrickGrid, volume: Volume, header: GridHeader, transfer: Transfer | None = None
) -> tuple[BrickGrid, list[str]]:
    """The density that `load_density` would make of a grid that was read as a source already.

    It is the same object, unless values below 0 have to become 0.
    """
    where, notes, grid = _where(volume, header), [], source
    low = source.field_range[0]
    if transfer is None and low < 0:
        notes.append(f"{where}: has values below 0, down to {low:g}, taken as 0")
        arrays = source.arrays
        grid = replace(
            source,
            arrays=arrays._replace(
                atlas=np.maximum(arrays.atlas, np.float32(0)),
                constants=np.maximum(arrays.constants, np.float32(0)),
            ),
        )
    return grid, notes + _density_notes(grid, where, transfer)


def empty_grid(header: GridHeader) -> BrickGrid:
    """A grid that is 0 everywhere, on the lattice of another: the density of a job without one."""
    none = Tree(
        background=np.zeros((), np.float32),
        leaf_origins=np.empty((0, 3), np.int32),
        leaf_values=np.empty((0, 8, 8, 8), np.float32),
        leaf_masks=np.empty((0, 64), np.uint8),
        tile_origins=np.empty((0, 3), np.int32),
        tile_widths=np.empty(0, np.int32),
        tile_values=np.empty(0, np.float32),
        tile_active=np.empty(0, np.bool_),
    )
    return build(none, header)


def _cached(
    read: Reading,
    volume: Volume,
    header: GridHeader,
    form: str,
    nonfinite: str,
    cache: Cache | None,
) -> tuple[BrickGrid, list[str]]:
    """A grid by way of the cache, if there is one; ``form`` is what was made of its values."""
    try:
        if cache is None:
            return read()
        settings = (type(volume).__name__, form, nonfinite)
        if not isinstance(cache, Path):
            return cache(volume.path, header.label, settings, read)
        from volcli.grids.cache import through_cache

        return through_cache(cache, volume.path, header.label, settings, read)
    except MemoryError as error:
        raise no_room(_where(volume, header), error) from error


def _density_notes(grid: BrickGrid, where: str, transfer: Transfer | None) -> list[str]:
    if grid.is_empty:
        return [f"{where}: is empty; it absorbs nothing"]
    outside = float(grid.background)
    if transfer is not None:
        outside = float(transfer(np.array(outside)))
    if outside > 0:
        return [f"{where}: is {outside:g} outside its voxels; cut at its active box"]
    return []


def _where(volume: Volume, header: GridHeader) -> str:
    return f"{volume.path}: grid '{header.label}'"
