"""How thick a density is: optical depth along lattice lines, straight from the values of a tree.

Along a line through lattice points a trilinear field is linear between them, so that its integral
is the sum of the values times their distance: no ray is traced, and nothing is compiled.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from volcli.grids import Tree
from volcli.grids.tree import LEAF_WIDTH

LINES = 64
"""Lines looked at along each of the two axes across, at most, evenly spread over the box."""


def column_depths(tree: Tree, world_from_index: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n,): the optical depth, at a density scale of 1, of each line that meets any density.

    Lines run along the lattice axis that is nearest to world Z, the way that the default camera
    looks. NaN, Inf and values below 0 count as 0, and so does what no leaf and no tile covers.

    Parameters
    ----------
    tree
        Of a grid of one channel.
    world_from_index
        (4, 4).
    """
    steps = np.linalg.norm(world_from_index[:3, :3], axis=0)
    along = int(np.argmax(np.abs(world_from_index[2, :3]) / steps))
    across = [axis for axis in range(3) if axis != along]
    corners = np.concatenate([tree.leaf_origins, tree.tile_origins]).astype(np.int64)
    widths = np.concatenate([np.full(len(tree.leaf_origins), LEAF_WIDTH), tree.tile_widths]).astype(
        np.int64
    )
    if not len(corners):
        return np.empty(0)
    low, high = corners.min(axis=0), (corners + widths[:, None]).max(axis=0) - 1
    u, v = (
        np.unique(np.linspace(low[axis], high[axis], LINES).round().astype(np.int64))
        for axis in across
    )
    total = np.zeros((len(u), len(v)))
    _add_leaves(total, u, v, tree, along, across)
    for origin, width, value in zip(
        tree.tile_origins[:, across].tolist(),
        tree.tile_widths.tolist(),
        _density(tree.tile_values).tolist(),
        strict=True,
    ):
        rows, columns = (
            slice(*np.searchsorted(lines, [first, first + width]))
            for lines, first in zip((u, v), origin, strict=True)
        )
        total[rows, columns] += value * width
    return total[total > 0] * steps[along]


def _add_leaves(
    total: NDArray[np.float64],
    u: NDArray[np.int64],
    v: NDArray[np.int64],
    tree: Tree,
    along: int,
    across: list[int],
) -> None:
    """Add what the lines see of leaves to ``total`` (len(u), len(v))."""
    sums = _density(tree.leaf_values).sum(axis=1 + along)  # (n, 8, 8)
    rows, hit_u = _found(u, tree.leaf_origins[:, across[0]])
    columns, hit_v = _found(v, tree.leaf_origins[:, across[1]])
    for i in range(LEAF_WIDTH):
        for j in range(LEAF_WIDTH):
            leaves = np.flatnonzero(hit_u[:, i] & hit_v[:, j])
            np.add.at(total, (rows[leaves, i], columns[leaves, j]), sums[leaves, i, j])


def _found(
    lines: NDArray[np.int64], origins: NDArray[np.int32]
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """(n, 8) each: the line through each layer of a leaf, and whether there is one."""
    layer = origins[:, None].astype(np.int64) + np.arange(LEAF_WIDTH)
    at = np.minimum(np.searchsorted(lines, layer), len(lines) - 1)
    return at, lines[at] == layer


def _density(values: NDArray[np.generic]) -> NDArray[np.float64]:
    finite = np.nan_to_num(np.asarray(values, np.float64), nan=0.0, posinf=0.0, neginf=0.0)
    return np.maximum(finite, 0.0)
