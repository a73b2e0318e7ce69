"""Where a packet of rays meets the bricks of a grid: `traversal`, for `LANES` rays at once.

The levels and the way through each are those of `traversal`, and so is every position; here the
rays of a packet go through a level together, and lanes with nothing to do there wait. What is met
goes into one list, in which the segments of each ray stand in their order along it. A brick's
entry, where it lies in its root cell, and its ray share one number (`pack`), so that three numbers
make a segment.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from volcli.kernels.compiler import jit
from volcli.kernels.lane_memory import append, gather
from volcli.kernels.lanes import LANES, any_of, count, floats, ints, numbers, pick, to_ints
from volcli.kernels.traversal import BACKGROUND, BLOCK, BRICK, MACRO, SEGMENTS

LANE_BITS = (LANES - 1).bit_length()

ROOM = LANES * (SEGMENTS + 1)
"""Segments that a packet may have in a root cell, and a register more (`lanes.append`)."""

PLACE_BITS = 9
"""A root cell is 2^9 bricks wide: what it takes to say where a brick lies along one axis."""


class Buffer(NamedTuple):
    """Room for the segments of a packet in one root cell, and for what is found out about them.

    Attributes
    ----------
    begin, end
        (ROOM,) float64: from and to where along the ray.
    content
        (ROOM,) int64: `pack`.
    tau, moment
        (ROOM,) float64: the segment's optical depth and its part of the hit distance.
    key
        (ROOM,) int8: what segments are sorted by.
    order
        (ROOM,) int32: segments, sorted.
    rays
        (packets.RAY_ROWS * LANES,) float64: what is known of each ray.
    bins
        (packets.BINS + 1,) int64.
    """

    begin: NDArray[np.float64]
    end: NDArray[np.float64]
    content: NDArray[np.int64]
    tau: NDArray[np.float64]
    moment: NDArray[np.float64]
    key: NDArray[np.int8]
    order: NDArray[np.int32]
    rays: NDArray[np.float64]
    bins: NDArray[np.int64]


class Rays(NamedTuple):
    """A packet of rays o + t d in local voxels; each field is (x, y, z) of FLOATS or MASK.

    Attributes
    ----------
    o, d, inverse
        As in `traversal.Ray`.
    ahead
        1 where the next plane is the upper one of a cell, 0 where it is the lower.
    still
        Where d is 0.
    """

    o: Any
    d: Any
    inverse: Any
    ahead: Any
    still: Any


class Walk(NamedTuple):
    """Where the rays stand in a cube of cells; each field is (x, y, z) of FLOATS.

    Attributes
    ----------
    cell
        The cell, counted from the cube's lowest.
    planes
        Distance to the next plane along each axis.
    spacing
        Distance between planes.
    step
        +1 or -1.
    """

    cell: Any
    planes: Any
    spacing: Any
    step: Any


@jit
def absolute(x):
    """|x|."""
    return max(x, -x)


@jit
def make_rays(o, d, inverse):
    """`Rays` from origins, directions and 1 / directions."""
    return Rays(
        o,
        d,
        inverse,
        (pick(d[0] > 0.0, 1.0, 0.0), pick(d[1] > 0.0, 1.0, 0.0), pick(d[2] > 0.0, 1.0, 0.0)),
        (d[0] == 0.0, d[1] == 0.0, d[2] == 0.0),
    )


@jit
def clip_axis(lo, hi, o, d, t_near, t_far):
    """Keep of [t_near, t_far] what lies between two planes across one axis."""
    a = (lo - o) / d
    b = (hi - o) / d
    still = d == 0.0
    never = still & ((o < lo) | (o > hi))
    first = pick(still, floats(-math.inf), min(a, b))
    last = pick(still, floats(math.inf), max(a, b))
    return max(t_near, pick(never, floats(math.inf), first)), min(t_far, last)


@jit
def enter_axis(rays, axis, t, lo, width, count):
    """(cell, distance to the next plane) along one axis."""
    cell = math.floor((rays.o[axis] + t * rays.d[axis] - lo) * (1.0 / width))
    cell = min(max(cell, 0.0), count - 1.0)
    plane = (lo + (cell + rays.ahead[axis]) * width - rays.o[axis]) * rays.inverse[axis]
    return cell, pick(rays.still[axis], floats(math.inf), plane)


@jit
def enter_cube(rays, t, corner, width, count):
    """Enter a cube of count^3 cells of ``width``, a power of two, at distance t: a `Walk`."""
    i, tx = enter_axis(rays, 0, t, corner[0], width, count)
    j, ty = enter_axis(rays, 1, t, corner[1], width, count)
    k, tz = enter_axis(rays, 2, t, corner[2], width, count)
    return Walk(
        (i, j, k),
        (tx, ty, tz),
        (
            absolute(rays.inverse[0]) * width,
            absolute(rays.inverse[1]) * width,
            absolute(rays.inverse[2]) * width,
        ),
        (rays.ahead[0] * 2.0 - 1.0, rays.ahead[1] * 2.0 - 1.0, rays.ahead[2] * 2.0 - 1.0),
    )


@jit
def nearest_plane(planes):
    """Masks (x, y, z), one of which holds: the plane that is crossed next, x before y before z."""
    x = (planes[0] <= planes[1]) & (planes[0] <= planes[2])
    y = (planes[1] <= planes[2]) & ~x
    return x, y, ~(x | y)


@jit
def cross(walk):
    """The walk beyond the nearest plane."""
    x, y, z = nearest_plane(walk.planes)
    i, j, k = walk.cell
    tx, ty, tz = walk.planes
    return Walk(
        (
            pick(x, i + walk.step[0], i),
            pick(y, j + walk.step[1], j),
            pick(z, k + walk.step[2], k),
        ),
        (
            pick(x, tx + walk.spacing[0], tx),
            pick(y, ty + walk.spacing[1], ty),
            pick(z, tz + walk.spacing[2], tz),
        ),
        walk.spacing,
        walk.step,
    )


@jit
def exit_of(walk, t1):
    """Where the rays leave their cells, or end."""
    return min(min(walk.planes[0], walk.planes[1]), min(walk.planes[2], t1))


@jit
def within(walk, count):
    """Where the cell is one of the cube's."""
    i, j, k = walk.cell
    return (min(i, min(j, k)) >= 0.0) & (max(i, max(j, k)) <= count - 1.0)


@jit
def flat(cell, count):
    """The index of a cell in a table of count^3, z fastest."""
    return to_ints((cell[0] * count + cell[1]) * count + cell[2])


@jit
def corner_of(corner, walk, width):
    """The lowest local voxel of the cells of a cube with lowest voxel ``corner``."""
    return (
        corner[0] + walk.cell[0] * width,
        corner[1] + walk.cell[1] * width,
        corner[2] + walk.cell[2] * width,
    )


@jit
def pack(entry, root, corner):
    """An entry, where, in bricks from its root cell's corner, it lies, and the ray: its lane."""
    x = to_ints((corner[0] - root[0]) * (1.0 / BRICK))
    y = to_ints((corner[1] - root[1]) * (1.0 / BRICK))
    z = to_ints((corner[2] - root[2]) * (1.0 / BRICK))
    place = (((((entry << PLACE_BITS) | x) << PLACE_BITS) | y) << PLACE_BITS) | z
    return (place << LANE_BITS) | numbers()


@jit
def unpack(content):
    """(entry, (x, y, z), ray): the inverse of `pack`, x, y and z in bricks."""
    below = (1 << PLACE_BITS) - 1
    place = content >> LANE_BITS
    return (
        place >> (3 * PLACE_BITS),
        ((place >> (2 * PLACE_BITS)) & below, (place >> PLACE_BITS) & below, place & below),
        content & (LANES - 1),
    )


@jit
def put(buffer, used, t0, t1, content, mask):
    """Add a segment for some of the rays; returns how many segments there are now."""
    append(buffer.begin, used, t0, mask)
    append(buffer.end, used, t1, mask)
    append(buffer.content, used, content, mask)
    return used + count(mask)


@jit
def root_segments(grid, skip_background, rays, entry, corner, t, t1, mask, buffer):
    """Write the segments of one root cell for each ray: those that cross it between t and t1.

    Returns how many each ray has. See `traversal.root_segments`.
    """
    used = 0
    constant = mask & (entry < 0)
    if skip_background:
        constant = constant & ~(entry == BACKGROUND)
    if any_of(constant):
        used = put(buffer, used, t, t1, pack(entry, corner, corner), constant)
    mask = mask & (entry >= 0)
    walk = enter_cube(rays, t, corner, float(BLOCK), 32.0)
    while any_of(mask):
        t_exit = exit_of(walk, t1)
        child = gather(grid.upper, entry * 32768 + flat(walk.cell, 32.0), mask)
        met = mask & (t_exit > t)
        if skip_background:
            met = met & ~(child == BACKGROUND)
        block = corner_of(corner, walk, float(BLOCK))
        constant = met & (child < 0)
        if any_of(constant):
            used = put(buffer, used, t, t_exit, pack(child, corner, block), constant)
        met = met & (child >= 0)
        if any_of(met):
            used = block_segments(
                grid, skip_background, rays, child, corner, block, t, t_exit, met, buffer, used
            )
        t = max(t, t_exit)
        walk = cross(walk)
        mask = mask & (t_exit < t1) & within(walk, 32.0)
    return used


@jit
def block_segments(grid, skip_background, rays, entry, root, corner, t, t1, mask, buffer, used):
    """As `root_segments`, for the occupied macro cells of a block with lowest voxel ``corner``."""
    occupied = gather(grid.occupied, entry, mask)
    walk = enter_cube(rays, t, corner, float(MACRO), 4.0)
    while any_of(mask):
        t_exit = exit_of(walk, t1)
        met = mask & (t_exit > t)
        if skip_background:
            met = met & (((occupied >> flat(walk.cell, 4.0)) & 1) == 1)
        if any_of(met):
            macro = corner_of(corner, walk, float(MACRO))
            first = entry * 4096 + flat(walk.cell, 16.0) * 4
            used = macro_segments(
                grid, skip_background, rays, first, root, macro, t, t_exit, met, buffer, used
            )
        t = max(t, t_exit)
        walk = cross(walk)
        mask = mask & (t_exit < t1) & within(walk, 4.0)
    return used


@jit
def macro_segments(grid, skip_background, rays, first, root, corner, t, t1, mask, buffer, used):
    """As `root_segments`, for the bricks of a macro cell, whose entries begin at ``first``."""
    walk = enter_cube(rays, t, corner, float(BRICK), 4.0)
    while any_of(mask):
        t_exit = exit_of(walk, t1)
        entry = gather(grid.lower, first + flat(walk.cell, 16.0), mask)
        met = mask & (t_exit > t)
        if skip_background:
            met = met & ~(entry == BACKGROUND)
        if any_of(met):
            brick = corner_of(corner, walk, float(BRICK))
            used = put(buffer, used, t, t_exit, pack(entry, root, brick), met)
        t = max(t, t_exit)
        walk = cross(walk)
        mask = mask & (t_exit < t1) & within(walk, 4.0)
    return used


@jit
def last_below(ascending, x, mask):
    """As `traversal.last_below`, for each lane its own x."""
    low, high = ints(0), ints(len(ascending))
    while True:
        apart = (low < high) & mask
        if not any_of(apart):
            return low - 1
        middle = (low + high) >> 1
        below = gather(ascending, middle, apart) <= x
        low = pick(apart & below, middle + 1, low)
        high = pick(apart & ~below, middle, high)


@jit
def interval(planes, x, d, mask):
    """As `traversal.interval`."""
    cell = min(max(last_below(planes, x, mask), 0), len(planes) - 2)
    return pick((d < 0.0) & (cell > 0) & (x == gather(planes, cell, mask)), cell - 1, cell)


@jit
def interval_end(planes, rays, axis, cell, mask):
    """As `traversal.interval_end`."""
    plane = gather(planes, cell + to_ints(rays.ahead[axis]), mask)
    t = (plane - rays.o[axis]) * rays.inverse[axis]
    return pick(rays.still[axis], floats(math.inf), t)


@jit
def enter(grid, rays, mask):
    """As `traversal.enter`: the root cells (i, j, k), INTS, in which the rays begin."""
    return (
        interval(grid.planes_x, rays.o[0], rays.d[0], mask),
        interval(grid.planes_y, rays.o[1], rays.d[1], mask),
        interval(grid.planes_z, rays.o[2], rays.d[2], mask),
    )


@jit
def root_planes(grid, rays, at, mask):
    """Distances (x, y, z) at which the rays cross the far planes of their root cells."""
    return (
        interval_end(grid.planes_x, rays, 0, at[0], mask),
        interval_end(grid.planes_y, rays, 1, at[1], mask),
        interval_end(grid.planes_z, rays, 2, at[2], mask),
    )


@jit
def root_cell(grid, at, mask):
    """As `traversal.root_cell`: (entry, corner), the corner as FLOATS."""
    i, j, k = at
    key = (i * (len(grid.planes_y) - 1) + j) * (len(grid.planes_z) - 1) + k
    found = last_below(grid.root_keys, key, mask)
    known = mask & (found >= 0)
    known = known & (gather(grid.root_keys, found, known) == key)
    entry = pick(known, gather(grid.root_entries, found, known), BACKGROUND)
    corner = (
        gather(grid.planes_x, i, mask),
        gather(grid.planes_y, j, mask),
        gather(grid.planes_z, k, mask),
    )
    return entry, corner


@jit
def root_next(grid, rays, at, planes):
    """(root cells beyond the nearest planes, where those are cells of the grid)."""
    x, y, z = nearest_plane(planes)
    i = pick(x, at[0] + to_ints(rays.ahead[0]) * 2 - 1, at[0])
    j = pick(y, at[1] + to_ints(rays.ahead[1]) * 2 - 1, at[1])
    k = pick(z, at[2] + to_ints(rays.ahead[2]) * 2 - 1, at[2])
    known = (i >= 0) & (j >= 0) & (k >= 0)
    known = known & (i < len(grid.planes_x) - 1) & (j < len(grid.planes_y) - 1)
    return (i, j, k), known & (k < len(grid.planes_z) - 1)
