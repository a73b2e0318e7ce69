"""Level sets as fog: distances to a surface to a density that is 0 outside it and 1 within.

As OpenVDB's ``tools::sdfToFogVolume`` does it (openvdb/tools/LevelSetUtil.h, OpenVDB 10), a tree at
a time; nothing here builds bricks.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from volcli.grids.tree import LEAF_WIDTH, Tree


def fog_of_level_set(tree: Tree) -> Tree:
    """The fog inside a level set.

    A voxel at distance v (below 0 inside) becomes ``v * (1 / cutoff)`` in float32 where v < 0, and
    0 elsewhere, active where it is above 0; a tile below 0 becomes 1, any other 0; outside is 0.
    The cutoff is the distance at which fog is 1: that of the deepest tile of 8 voxels (the inner
    edge of the band), or where there is none inside, of the deepest voxel. As in OpenVDB, a voxel
    deeper than the cutoff is denser than 1.

    Parameters
    ----------
    tree
        Distances, float32.
    """
    leaves = np.asarray(tree.leaf_values, np.float32)
    tiles = np.asarray(tree.tile_values, np.float32)
    narrow = tiles[tree.tile_widths == LEAF_WIDTH]
    deepest = narrow.min(initial=np.inf)
    if not deepest < 0:
        deepest = leaves.min(initial=np.inf)
    weight = np.float32(1) / np.float32(deepest) if deepest < 0 else np.float32(0)
    fog = np.where(leaves < 0, leaves * weight, np.float32(0))
    inside = fog > 0
    kept = inside.any(axis=(1, 2, 3))
    masks = np.packbits(inside[kept].reshape(-1, LEAF_WIDTH**3), axis=1, bitorder="little")
    within = tiles < 0
    return replace(
        tree,
        background=np.zeros((), np.float32),
        leaf_origins=tree.leaf_origins[kept],
        leaf_values=fog[kept],
        leaf_masks=masks,
        tile_origins=tree.tile_origins[within],
        tile_widths=tree.tile_widths[within],
        tile_values=np.ones(int(within.sum()), np.float32),
        tile_active=np.ones(int(within.sum()), np.bool_),
    )
