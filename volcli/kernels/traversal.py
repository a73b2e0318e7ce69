"""Where a ray meets the bricks of a grid: a hierarchical walk that skips what is constant.

Positions are local voxels of a `BrickGrid`; distances ``t`` are world units from the point where
the ray enters the volume, so that a camera a million voxels away loses nothing. Levels are root
cells (4096 voxels), blocks (128), macro cells (32) and bricks (8); each is walked by the same
digital differential analyser (Amanatides and Woo 1987): the next plane along each axis, the
nearest of the three is crossed. The root's planes are not evenly spaced, and are looked up.

A root cell at a time, the walk writes the segments of the ray that are not background into a
buffer that the caller owns; `SEGMENTS` of them are enough for any ray.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from volcli.kernels.compiler import jit
from volcli.kernels.lanes import pick

BRICK = 8
MACRO = 32
BLOCK = 128
ROOT = 4096
BACKGROUND = -1

LEADS_NOWHERE = 2.0**-200
"""As a share of a direction's largest component: less moves a ray, from one end of the lattice to
the other, by no more than 2^-168 voxels."""

SEGMENTS = 94 * 10 * 10
"""A ray meets at most 3*(32 - 1) + 1 blocks of a root cell, 3*(4 - 1) + 1 macro cells of each and
as many bricks of each of those; a proof that needs no assumption about rounding."""


class Ray(NamedTuple):
    """The ray o + t d in local voxels of a grid; each field is (x, y, z).

    Attributes
    ----------
    o
        Where it enters the volume.
    d
        Voxels per world unit of distance.
    inverse
        1 / d; infinite where d is 0.
    """

    o: tuple[float, float, float]
    d: tuple[float, float, float]
    inverse: tuple[float, float, float]


class Segments(NamedTuple):
    """A buffer for the segments of a ray through one root cell.

    Attributes
    ----------
    used
        (1,) int64: how many segments there are.
    times
        (SEGMENTS, 2) float64: from and to where.
    entries
        (SEGMENTS,) int32: a brick (>= 0) or a constant.
    corners
        (SEGMENTS, 3) int64: the lowest local voxel of the brick, block or root cell.
    """

    used: NDArray[np.int64]
    times: NDArray[np.float64]
    entries: NDArray[np.int32]
    corners: NDArray[np.int64]


def segment_buffer() -> Segments:
    """An empty `Segments`."""
    return Segments(
        np.zeros(1, np.int64),
        np.empty((SEGMENTS, 2), np.float64),
        np.empty(SEGMENTS, np.int32),
        np.empty((SEGMENTS, 3), np.int64),
    )


@jit
def clip(lo, hi, o, d):
    """Where the ray o + t d is inside the box [lo, hi]: (t_near, t_far), t_near > t_far if not.

    ``lo`` and ``hi`` are (3,); t_near is at least 0.
    """
    t_near = 0.0
    t_far = math.inf
    for axis in range(3):
        if d[axis] == 0.0:
            if o[axis] < lo[axis] or o[axis] > hi[axis]:
                return 1.0, 0.0
        else:
            a = (lo[axis] - o[axis]) / d[axis]
            b = (hi[axis] - o[axis]) / d[axis]
            t_near = max(t_near, min(a, b))
            t_far = min(t_far, max(a, b))
    return t_near, t_far


@jit
def straight(d):
    """The direction d (x, y, z), components that lead nowhere as 0: 1 / d of a denormal number is
    infinite, and 0 times that is NaN. Takes registers, too."""
    x, y, z = max(d[0], -d[0]), max(d[1], -d[1]), max(d[2], -d[2])
    least = max(x, max(y, z)) * LEADS_NOWHERE
    return (
        pick(x < least, 0.0 * d[0], d[0]),
        pick(y < least, 0.0 * d[1], d[1]),
        pick(z < least, 0.0 * d[2], d[2]),
    )


@jit
def make_ray(o, d):
    """A `Ray` from origin and direction."""
    return Ray(o, d, (1.0 / d[0], 1.0 / d[1], 1.0 / d[2]))


@jit
def start(o, d, inverse, t, lo, width, count):
    """Enter a row of ``count`` cells of ``width`` that begins at ``lo``, at distance t.

    Takes one axis of a `Ray`. Returns (cell, t of the next plane, t between planes, step). Width
    and count are floats: numba compiles a function anew for each constant integer it is given.
    """
    cell = math.floor((o + t * d - lo) / width)
    cell = min(max(cell, 0), int(count) - 1)
    if d > 0.0:
        return cell, (lo + (cell + 1) * width - o) * inverse, width * inverse, 1
    if d < 0.0:
        return cell, (lo + cell * width - o) * inverse, -width * inverse, -1
    return cell, math.inf, math.inf, 0


@jit
def start_all(ray, t, x, y, z, width, count):
    """`start` along the three axes of a cube of cells whose lowest voxel is (x, y, z)."""
    o, d, inverse = ray
    i, tx, ddx, sx = start(o[0], d[0], inverse[0], t, float(x), width, count)
    j, ty, ddy, sy = start(o[1], d[1], inverse[1], t, float(y), width, count)
    k, tz, ddz, sz = start(o[2], d[2], inverse[2], t, float(z), width, count)
    return i, j, k, tx, ty, tz, sx, sy, sz, ddx, ddy, ddz


@jit
def advance(i, j, k, tx, ty, tz, sx, sy, sz, ddx, ddy, ddz):
    """Cross the nearest plane: the new cell and the new next planes."""
    if tx <= ty and tx <= tz:
        return i + sx, j, k, tx + ddx, ty, tz
    if ty <= tz:
        return i, j + sy, k, tx, ty + ddy, tz
    return i, j, k + sz, tx, ty, tz + ddz


@jit
def enter(grid, o, d):
    """The root cell (i, j, k), counted in intervals between planes, that a ray is in after o."""
    return (
        interval(grid.planes_x, o[0], d[0]),
        interval(grid.planes_y, o[1], d[1]),
        interval(grid.planes_z, o[2], d[2]),
    )


@jit
def last_below(ascending, x):
    """The index of the last number that is not above x; -1 where all are. (np.searchsorted takes
    seconds to compile.)"""
    low, high = 0, len(ascending)
    while low < high:
        middle = (low + high) // 2
        if ascending[middle] <= x:
            low = middle + 1
        else:
            high = middle
    return low - 1


@jit
def interval(planes, x, d):
    """The interval between planes that a ray in direction d is in just after x."""
    cell = min(max(last_below(planes, x), 0), len(planes) - 2)
    if d < 0.0 and cell > 0 and x == planes[cell]:
        cell -= 1
    return cell


@jit
def inside(grid, at):
    """Whether (i, j, k) is a root cell at all."""
    return (
        0 <= at[0] < len(grid.planes_x) - 1
        and 0 <= at[1] < len(grid.planes_y) - 1
        and 0 <= at[2] < len(grid.planes_z) - 1
    )


@jit
def root_exit(grid, ray, at):
    """(t, axis): where and through which plane the ray leaves the root cell."""
    tx = interval_end(grid.planes_x, ray, 0, at[0])
    ty = interval_end(grid.planes_y, ray, 1, at[1])
    tz = interval_end(grid.planes_z, ray, 2, at[2])
    if tx <= ty and tx <= tz:
        return tx, 0
    if ty <= tz:
        return ty, 1
    return tz, 2


@jit
def interval_end(planes, ray, axis, cell):
    """The distance at which the ray leaves an interval between planes."""
    if ray.d[axis] > 0.0:
        return (planes[cell + 1] - ray.o[axis]) * ray.inverse[axis]
    if ray.d[axis] < 0.0:
        return (planes[cell] - ray.o[axis]) * ray.inverse[axis]
    return math.inf


@jit
def root_next(ray, at, axis):
    """The root cell beyond the plane through which the ray leaves."""
    step = 1 if ray.d[axis] > 0.0 else -1
    if axis == 0:
        return at[0] + step, at[1], at[2]
    if axis == 1:
        return at[0], at[1] + step, at[2]
    return at[0], at[1], at[2] + step


@jit
def root_cell(grid, at):
    """(entry, corner): what stands in the root cell, and its lowest local voxel."""
    corner = (
        int(grid.planes_x[at[0]]),
        int(grid.planes_y[at[1]]),
        int(grid.planes_z[at[2]]),
    )
    return root_entry(grid, at[0], at[1], at[2]), corner


@jit
def root_entry(grid, i, j, k):
    """The entry of the root cell (i, j, k), counted in intervals between planes."""
    key = (i * (len(grid.planes_y) - 1) + j) * (len(grid.planes_z) - 1) + k
    at = last_below(grid.root_keys, key)
    if at >= 0 and grid.root_keys[at] == key:
        return int(grid.root_entries[at])
    return BACKGROUND


@jit
def brick_entry(grid, i, j, k):
    """(entry, width): what stands at the local voxel (i, j, k), and the width of the aligned cube
    around it over which an entry that is a constant holds."""
    at = (
        last_below(grid.planes_x, float(i)),
        last_below(grid.planes_y, float(j)),
        last_below(grid.planes_z, float(k)),
    )
    if not inside(grid, at):
        return BACKGROUND, ROOT
    entry = root_entry(grid, at[0], at[1], at[2])
    if entry < 0:
        return entry, ROOT
    block = ((i >> 7 & 31) * 32 + (j >> 7 & 31)) * 32 + (k >> 7 & 31)
    entry = int(grid.upper[entry, block])
    if entry < 0:
        return entry, BLOCK
    brick = ((i >> 3 & 15) * 16 + (j >> 3 & 15)) * 16 + (k >> 3 & 15)
    return int(grid.lower[entry, brick]), BRICK


@jit
def root_segments(grid, skip_background, entry, corner, ray, t0, t1, buffer):
    """Write the segments of one root cell that the ray crosses between t0 and t1.

    Parameters
    ----------
    grid
        `BrickArrays`.
    skip_background
        Whether segments of background are left out (they are when it is 0).
    entry, corner
        The root cell's entry, and its (x, y, z) lowest local voxel.
    ray
        `Ray`.
    buffer
        `Segments`, to which the segments are added.
    """
    x, y, z = corner
    if entry < 0:
        if skip_background and entry == BACKGROUND:
            return
        put(buffer, t0, t1, entry, x, y, z)
        return
    upper = grid.upper
    i, j, k, tx, ty, tz, sx, sy, sz, ddx, ddy, ddz = start_all(ray, t0, x, y, z, float(BLOCK), 32.0)
    t = t0
    while True:
        t_exit = min(min(tx, ty), min(tz, t1))
        e = int(upper[entry, (i * 32 + j) * 32 + k])
        if t_exit > t and not (skip_background and e == BACKGROUND):
            bx, by, bz = x + i * BLOCK, y + j * BLOCK, z + k * BLOCK
            if e >= 0:
                block_segments(grid, skip_background, e, bx, by, bz, ray, t, t_exit, buffer)
            else:
                put(buffer, t, t_exit, e, bx, by, bz)
        t = max(t, t_exit)
        if t_exit >= t1:
            return
        i, j, k, tx, ty, tz = advance(i, j, k, tx, ty, tz, sx, sy, sz, ddx, ddy, ddz)
        if (i | j | k) & ~31:
            return


@jit
def block_segments(grid, skip_background, entry, x, y, z, ray, t0, t1, buffer):
    """As `root_segments`, for the occupied macro cells of the block with lowest voxel (x, y, z)."""
    occupied = grid.occupied[entry]
    i, j, k, tx, ty, tz, sx, sy, sz, ddx, ddy, ddz = start_all(ray, t0, x, y, z, float(MACRO), 4.0)
    t = t0
    while True:
        t_exit = min(min(tx, ty), min(tz, t1))
        if t_exit > t and (not skip_background or occupied >> ((i * 4 + j) * 4 + k) & 1):
            macro_segments(grid, skip_background, entry, i, j, k, x, y, z, ray, t, t_exit, buffer)
        t = max(t, t_exit)
        if t_exit >= t1:
            return
        i, j, k, tx, ty, tz = advance(i, j, k, tx, ty, tz, sx, sy, sz, ddx, ddy, ddz)
        if (i | j | k) & ~3:
            return


@jit
def macro_segments(grid, skip_background, entry, mi, mj, mk, x, y, z, ray, t0, t1, buffer):
    """As `root_segments`, for the bricks of macro cell (mi, mj, mk) of the block at (x, y, z)."""
    lower = grid.lower
    first = (mi * 64 + mj * 4) * 16 + mk * 4
    x += mi * MACRO
    y += mj * MACRO
    z += mk * MACRO
    i, j, k, tx, ty, tz, sx, sy, sz, ddx, ddy, ddz = start_all(ray, t0, x, y, z, float(BRICK), 4.0)
    t = t0
    while True:
        t_exit = min(min(tx, ty), min(tz, t1))
        e = int(lower[entry, first + (i * 16 + j) * 16 + k])
        if t_exit > t and not (skip_background and e == BACKGROUND):
            put(buffer, t, t_exit, e, x + i * BRICK, y + j * BRICK, z + k * BRICK)
        t = max(t, t_exit)
        if t_exit >= t1:
            return
        i, j, k, tx, ty, tz = advance(i, j, k, tx, ty, tz, sx, sy, sz, ddx, ddy, ddz)
        if (i | j | k) & ~3:
            return


@jit
def put(buffer, t0, t1, entry, x, y, z):
    """Write one more segment."""
    n = buffer.used[0]
    buffer.used[0] = n + 1
    buffer.times[n, 0] = t0
    buffer.times[n, 1] = t1
    buffer.entries[n] = entry
    buffer.corners[n, 0] = x
    buffer.corners[n, 1] = y
    buffer.corners[n, 2] = z
