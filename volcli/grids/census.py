"""How much memory a grid will take, counted in its topology before any value is read.

Exact for the tree; for the bricks as near as the masks of active voxels tell: what is not active is
taken for the background, and the few bricks around tiles are left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from volcli.grids.brick import APRON, BRICK, CORNERS, LOWER, UPPER

_LEAF_VOXELS = BRICK**3
_LEAF_FIXED = 64 + 12 + 8  # bytes of its mask and its origin, and of finding its neighbours


@dataclass(frozen=True)
class Census:
    """What a grid holds.

    Attributes
    ----------
    leaves, tiles
        Of the tree.
    tree_bytes
        What the tree takes while the bricks are built of it.
    grid_bytes
        What the bricks take.
    bricks
        That are built of it.
    mapped_bytes
        Of the file, as far as it is mapped into memory while it is read.
    stays_mapped
        Whether it still is while the grid is rendered.
    """

    leaves: int
    tiles: int
    tree_bytes: int
    grid_bytes: int
    bricks: int = 0
    mapped_bytes: int = 0
    stays_mapped: bool = True

    @property
    def loading_bytes(self) -> int:
        """The most that is held while the grid is loaded."""
        return self.tree_bytes + self.grid_bytes


def take_census(
    leaf_origins: NDArray[np.int32], leaf_masks: NDArray[np.uint8], tiles: int, dtype: np.dtype[Any]
) -> Census:
    """Count a grid.

    Parameters
    ----------
    leaf_origins, leaf_masks
        (n, 3) and (n, 64), as in a `Tree`.
    tiles
        How many tiles there are.
    dtype
        Of a value in memory, with its components: ``3f4``.
    """
    cells = [
        _hashed(leaf_origins[_reaches(leaf_masks, corner)] // BRICK - corner) for corner in CORNERS
    ]
    bricks = len(np.unique(np.concatenate(cells)))
    blocks, roots = (
        _with_neighbours(leaf_origins // (BRICK * width)) for width in (LOWER, LOWER * UPPER)
    )
    return census_of(len(leaf_origins), bricks, blocks, roots, tiles, dtype)


def census_of(
    leaves: int,
    bricks: int,
    blocks: int,
    roots: int,
    tiles: int,
    dtype: np.dtype[Any],
    copies: int = 1,
    mapped_bytes: int = 0,
) -> Census:
    """The bytes of what was counted: bricks, and tables of 16^3 and of 32^3 entries.

    ``copies`` is how often a reader holds the values that it reads.
    """
    components = dtype.shape[0] if dtype.shape else 1
    brick_bytes = APRON**3 * 4 * components
    value_bytes = copies * dtype.itemsize
    if dtype.base != np.float32:  # converted before bricks are built of it
        value_bytes += 4 * components
    return Census(
        leaves,
        tiles,
        leaves * (_LEAF_VOXELS * value_bytes + _LEAF_FIXED) + tiles * (17 + value_bytes),
        bricks * brick_bytes + blocks * (4 * LOWER**3 + 8) + roots * 4 * UPPER**3,
        bricks,
        mapped_bytes,
    )


def _reaches(masks: NDArray[np.uint8], corner: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which leaves have an active voxel in what the brick reads whose corner they are."""
    x, y, z = (slice(0, 1) if side else slice(None) for side in corner)
    bits = masks.reshape(-1, BRICK, BRICK)[:, x, y]
    if z.stop:
        bits = bits & np.uint8(1)
    return np.asarray(bits.any(axis=(1, 2)))


def _with_neighbours(nodes: NDArray[np.int32]) -> int:
    """How many nodes there are with those below them, whose cells reach into them."""
    _, first = np.unique(_hashed(nodes), return_index=True)
    return len(np.unique(_hashed((nodes[first][:, None] - CORNERS).reshape(-1, 3))))


def _hashed(points: NDArray[np.int32]) -> NDArray[np.uint64]:
    """A number for each of n points; that two have the same is too rare to matter here."""
    x, y, z = points.astype(np.int64).view(np.uint64).T
    return (
        (x * np.uint64(0x9E3779B97F4A7C15)) ^ (y * np.uint64(0xC2B2AE3D27D4EB4F) << np.uint64(1))
    ) + z * np.uint64(0x165667B19E3779F9)
