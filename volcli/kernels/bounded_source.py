"""Regions of a source along a ray, and the colours that it has there at most and at least."""

from __future__ import annotations

import numpy as np

from volcli.kernels.compiler import jit
from volcli.kernels.source import NOWHERE, cell_after, colour_in
from volcli.kernels.traversal import brick_entry


@jit
def octant_number(i, j, k):
    """The number of the octant (`bounds.region_of`) of a brick that local voxel (i, j, k) is in."""
    return 1 + ((i >> 2 & 1) << 2 | (j >> 2 & 1) << 1 | k >> 2 & 1)


@jit
def octant_after(ray, corner, t, t_end):
    """(t_exit, number): the octant that a ray is in just after t, in the brick with lowest voxel
    ``corner``, and where it leaves it, t_end at the latest."""
    i, tx = cell_after(ray, 0, t, 4)
    j, ty = cell_after(ray, 1, t, 4)
    k, tz = cell_after(ray, 2, t, 4)
    i = min(max(i - corner[0], 0), 4)  # rounding may have it in the next brick
    j = min(max(j - corner[1], 0), 4)
    k = min(max(k - corner[2], 0), 4)
    return min(min(tx, ty), min(tz, t_end)), octant_number(i, j, k)


@jit
def source_region(source, own, number, path, t, t_end, width):
    """(t_exit, entry, number): the region of a source that a ray is in just after t, and where it
    leaves it, t_end at the latest.

    Parameters
    ----------
    own, number
        The source's brick, if it is known to reach up to t_end, and the region of it; else
        `NOWHERE`.
    width
        8 for bricks, 4 for octants. Where the source is a constant, that is the region.
    """
    if t < path.begin:
        return min(path.begin, t_end), NOWHERE, 0
    if t >= path.end:
        return t_end, NOWHERE, 0
    t_end = min(path.end, t_end)
    if own != NOWHERE:
        return t_end, own, number
    ray = path.ray
    i = cell_after(ray, 0, t, width)[0]
    j = cell_after(ray, 1, t, width)[0]
    k = cell_after(ray, 2, t, width)[0]
    entry, wide = brick_entry(source.grid, i, j, k)
    if entry >= 0:
        wide = width
    t_exit = min(min(cube_exit(ray, 0, i, wide), cube_exit(ray, 1, j, wide)), t_end)
    t_exit = min(t_exit, cube_exit(ray, 2, k, wide))
    return t_exit, entry, 0 if width == 8 else octant_number(i, j, k)


@jit
def cube_exit(ray, axis, voxel, width):
    """Where a ray leaves the aligned cube of a voxel, along one axis."""
    low = voxel // width * width
    if ray.d[axis] > 0.0:
        return (low + width - ray.o[axis]) * ray.inverse[axis]
    if ray.d[axis] < 0.0:
        return (low - ray.o[axis]) * ray.inverse[axis]
    return np.inf


@jit
def region_colour(source, ranges, nearest, entry, number):
    """(middle, off) of a source in a region: the middle of its range, (r, g, b), and how far from
    that any channel is at most."""
    if entry == NOWHERE:
        return (0.0, 0.0, 0.0), 0.0
    if entry < 0:
        colour = colour_in(
            source.grid, source.table, source.scale, nearest, entry, 0, 0.0, 0.0, 0.0
        )
        return colour, 0.0
    r, red = channel_range(ranges, entry, number, 0)
    g, green = channel_range(ranges, entry, number, 1)
    b, blue = channel_range(ranges, entry, number, 2)
    return (r, g, b), max(red, max(green, blue))


@jit
def channel_range(ranges, entry, number, c):
    """(middle, half) of the range of one channel."""
    low = np.float64(ranges[entry, number, 0, c])
    high = np.float64(ranges[entry, number, 1, c])
    return 0.5 * (low + high), 0.5 * (high - low)
