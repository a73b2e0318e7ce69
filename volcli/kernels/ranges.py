"""The least and the largest value in each brick of a grid, and in each of its octants.

A field that is blended between lattice points does not leave the range of the points around it, so
that the points of a region, those on its far faces included, bound it. With ``nearest`` a region
has the values of its own cells and no others. Regions are those of `bounds.region_of`.
"""

from __future__ import annotations

import numpy as np

from volcli.kernels.bounds import REGIONS, region_of
from volcli.kernels.compiler import kernel


@kernel
def brick_ranges(atlas, nearest, ranges):
    """Write the ranges of bricks.

    Parameters
    ----------
    atlas
        (n, 729, c) float32.
    nearest
        Whether values are those of cells.
    ranges
        (n, REGIONS, 2, c) float32, to be filled: the least, then the largest.
    """
    channels = atlas.shape[2]
    for brick in range(len(atlas)):
        for number in range(REGIONS):
            x, y, z, width = region_of(number)
            points = width if nearest else width + 1
            for c in range(channels):
                low, high = np.float32(np.inf), np.float32(-np.inf)
                for i in range(points):
                    for j in range(points):
                        row = ((x + i) * 9 + y + j) * 9 + z
                        for k in range(points):
                            value = atlas[brick, row + k, c]
                            low, high = min(low, value), max(high, value)
                ranges[brick, number, 0, c] = low
                ranges[brick, number, 1, c] = high
