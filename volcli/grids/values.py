"""Values that cannot be rendered as they are (NaN, Inf, densities below 0), and their range."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from volcli.errors import VolumeError
from volcli.grids.tree import Tree

_CHUNK = 1024
"""Leaves looked at at a time, so that what a test makes of them stays in the cache."""


def settle_nonfinite(tree: Tree, where: str, nonfinite: str) -> tuple[Tree, list[str]]:
    """The tree with values that float32 can hold, and warnings.

    Parameters
    ----------
    where
        File and grid, for messages.
    nonfinite
        ``error``: NaN and Inf raise; ``zero``: they become 0, with a warning.

    Raises
    ------
    VolumeError
        Naming how many there are, and the index of the first.
    """
    with np.errstate(over="ignore"):  # a double beyond float32 becomes Inf, and is found below
        parts = [p.astype(np.float32, copy=False) for p in _parts(tree)]
    count = _count(parts, lambda values: ~np.isfinite(values))
    if count == 0:
        return _with_parts(tree, parts), []
    bad = [~np.isfinite(p) for p in parts]
    first = _first_index(tree, bad)
    if nonfinite == "error":
        raise VolumeError(
            f"{where}: {count} values are NaN or Inf, the first at index {first}; mend the file or "
            f"accept them as 0 with --set density.nonfinite=zero"
        )
    settled = [np.where(b, np.float32(0), p) for p, b in zip(parts, bad, strict=True)]
    return _with_parts(tree, settled), [f"{where}: {count} values are NaN or Inf, taken as 0"]


def clamp_negative(tree: Tree, where: str) -> tuple[Tree, list[str]]:
    """The tree with values below 0 raised to 0, and a warning that counts them."""
    parts = _parts(tree)
    count = _count(parts, lambda values: values < 0)
    if count == 0:
        return tree, []
    clamped = [np.maximum(p, p.dtype.type(0)) for p in parts]
    return _with_parts(tree, clamped), [f"{where}: {count} values below 0, taken as 0"]


def active_range(tree: Tree) -> tuple[float, float]:
    """Smallest and largest value of active voxels and tiles; of all values where none is active."""
    low, high = np.inf, -np.inf
    for start in range(0, len(tree.leaf_values), _CHUNK):
        values = tree.leaf_values[start : start + _CHUNK]
        bits = np.unpackbits(tree.leaf_masks[start : start + _CHUNK], axis=1, bitorder="little")
        active = values.reshape(len(values), -1)[bits.astype(bool)]
        low, high = active.min(initial=low), active.max(initial=high)
    tiles = tree.tile_values[tree.tile_active]
    low, high = tiles.min(initial=low), tiles.max(initial=high)
    if not low <= high:
        low, high = np.min(tree.background), np.max(tree.background)
    return float(low), float(high)


def _count(parts: list[NDArray[Any]], test: Callable[[NDArray[Any]], NDArray[np.bool_]]) -> int:
    """How many values pass a test."""
    chunks = (
        p[i : i + _CHUNK] for p in map(np.atleast_1d, parts) for i in range(0, len(p), _CHUNK)
    )
    return sum(int(np.count_nonzero(test(chunk))) for chunk in chunks)


def _parts(tree: Tree) -> list[NDArray[Any]]:
    return [tree.leaf_values, tree.tile_values, np.asarray(tree.background)]


def _with_parts(tree: Tree, parts: list[NDArray[Any]]) -> Tree:
    leaves, tiles, background = parts
    return replace(tree, leaf_values=leaves, tile_values=tiles, background=background)


def _first_index(tree: Tree, bad: list[NDArray[np.bool_]]) -> str:
    leaves, tiles, _ = bad
    if leaves.any():
        at = np.unravel_index(int(np.argmax(leaves)), leaves.shape)
        index = tree.leaf_origins[at[0]] + np.array(at[1:4], np.int64)
    elif tiles.any():
        index = tree.tile_origins[np.unravel_index(int(np.argmax(tiles)), tiles.shape)[0]]
    else:
        return "outside all voxels (the grid's background)"
    return "(" + ", ".join(str(int(i)) for i in index) + ")"
