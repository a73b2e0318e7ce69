"""What packets see of a colour grid that shares the lattice of the density: `light`, for lanes.

On one lattice a cell of the density is a cell of the colour, whose channels along the ray are three
more cubics; with the weights of `cell.hit_weights` nothing else is new. Two passes leave out what
is not seen: the first adds up optical depths alone, so that it is known what lies before each
segment; the second looks at the colour of those that are not hidden. What is hidden depends on how
bright the rest is (`light.faded`): first come the segments before an optical depth of `STOP_TAU`;
then, of rays that are dark so far, those that could still be brighter.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from volcli.kernels.cell import MAX_TAU, SHORTEST, absorbed, antiderivative, hit_weights, value
from volcli.kernels.compiler import jit
from volcli.kernels.lane_memory import append, gather, gather_square, load, scatter
from volcli.kernels.lanes import (
    LANES,
    any_of,
    count,
    floats,
    numbers,
    pick,
    to_ints,
)
from volcli.kernels.light import FADED, STOP_TAU
from volcli.kernels.packet_rules import (
    FAR_ROW,
    MOMENT_ROW,
    RED_ROW,
    TAU_ROW,
    along,
    cells_exit,
    corners,
    enter_cells,
    exact_segments,
    fetch,
    in_brick,
    kept,
    kept_vector,
    next_cells,
    sort_by_length,
)
from volcli.kernels.packet_walk import ROOM, last_below, root_cell
from volcli.kernels.traversal import BACKGROUND


class LightBuffer(NamedTuple):
    """Room for what is seen of the segments of a packet.

    Attributes
    ----------
    before
        (ROOM,) float64: the optical depth before each.
    rgb
        (3, ROOM) float64: the light of each, as if nothing were before it.
    seen
        (ROOM,) int32: the segments that are looked at.
    """

    before: NDArray[np.float64]
    rgb: NDArray[np.float64]
    seen: NDArray[np.int32]


def light_buffer() -> LightBuffer:
    """An empty `LightBuffer`."""
    return LightBuffer(np.empty(ROOM), np.empty((3, ROOM)), np.empty(ROOM, np.int32))


class Seen(NamedTuple):
    """What is seen of segments up to some distance, all as if nothing were before them.

    Attributes
    ----------
    T, r, g, b, moment
        FLOATS: as in `light.State`.
    """

    T: Any
    r: Any
    g: Any
    b: Any
    moment: Any


@jit
def own_bricks(colour, corner, mask):
    """The entries of the colour grid for bricks of the density with lowest local voxel ``corner``:
    `traversal.brick_entry`."""
    grid, shift = colour.grid, colour.shift
    x, y, z = corner[0] + float(shift[0]), corner[1] + float(shift[1]), corner[2] + float(shift[2])
    i = last_below(grid.planes_x, x, mask)
    j = last_below(grid.planes_y, y, mask)
    k = last_below(grid.planes_z, z, mask)
    known = mask & (i >= 0) & (j >= 0) & (k >= 0)
    known = known & (i < len(grid.planes_x) - 1) & (j < len(grid.planes_y) - 1)
    known = known & (k < len(grid.planes_z) - 1)
    entry = root_cell(grid, (i, j, k), known)[0]
    entry = pick(known, entry, BACKGROUND)
    i, j, k = to_ints(x), to_ints(y), to_ints(z)
    inner = known & (entry >= 0)
    block = ((((i >> 7) & 31) << 5 | ((j >> 7) & 31)) << 5) | ((k >> 7) & 31)
    entry = pick(inner, gather(grid.upper, (entry << 15) + block, inner), entry)
    inner = inner & (entry >= 0)
    brick = ((((i >> 3) & 15) << 4 | ((j >> 3) & 15)) << 4) | ((k >> 3) & 15)
    return pick(inner, gather(grid.lower, (entry << 12) + brick, inner), entry)


@jit
def colour_corners(atlas, at, mask):
    """Three tuples, a channel each, of the eight values about cells that begin at element ``at`` of
    the atlas.

    The channels of two neighbours along z are six numbers in a row.
    """
    near = four_corners(atlas, at, mask)
    far = four_corners(atlas, at + 243, mask)
    return near[0] + far[0], near[1] + far[1], near[2] + far[2]


@jit
def four_corners(atlas, at, mask):
    """`colour_corners` of the four with the lower x."""
    r0, g0, b0, r1 = gather_square(atlas, at, 2, mask)
    r2, g2, b2, r3 = gather_square(atlas, at + 27, 2, mask)
    g1, b1, g3, b3 = gather_square(atlas, at + 4, 27, mask)
    return (r0, r1, r2, r3), (g0, g1, g2, g3), (b0, b1, b2, b3)


@jit
def settle(p, constant, c):
    """The cubic p, or where ``constant`` holds the number c."""
    zero = floats(0.0)
    return (
        pick(constant, c, p[0]),
        pick(constant, zero, p[1]),
        pick(constant, zero, p[2]),
        pick(constant, zero, p[3]),
    )


@jit
def mean_of(p, at, w):
    """The mean of a cubic over four nodes."""
    return (
        w[0] * value(p, at[0])
        + w[1] * value(p, at[1])
        + w[2] * value(p, at[2])
        + w[3] * value(p, at[3])
    )


@jit
def hidden(seen, brightest, depth, t_far):
    """Where nothing that is still to come counts: `light.faded`."""
    r, g, b = max(seen.r, -seen.r), max(seen.g, -seen.g), max(seen.b, -seen.b)
    done = seen.T * brightest <= FADED * max(r, max(g, b))
    if depth is not None:
        done = done & (seen.T * t_far <= FADED * seen.moment)
    return done


@jit
def see_cells(seen, p, rgb, brightest, scale, t, t_exit, mask, depth, t_far):
    """Add the light of [t, t_exit]: `light.add_span`, for lanes.

    p and ``rgb`` are the cubics of density and colour about the middle; no colour is brighter than
    ``brightest``.
    """
    tm = 0.5 * (t + t_exit)
    u, end = t - tm, t_exit - tm
    begin = antiderivative(p, u)
    T, r, g, b, moment = seen
    length = end - u
    shortest = length * SHORTEST
    left = mask & (scale * (antiderivative(p, end) - begin) > 0.0)
    left = left & ~hidden(seen, brightest, depth, t_far)
    while any_of(left):
        to = min(u + length, end)
        thick = scale * (antiderivative(p, to) - begin) > MAX_TAU
        halve = left & thick & (length > shortest)
        take = left & ~halve
        part, at, w = hit_weights(p, scale, u, to)
        hit = T * absorbed(part)
        r = pick(take, r + hit * mean_of(rgb[0], at, w), r)
        g = pick(take, g + hit * mean_of(rgb[1], at, w), g)
        b = pick(take, b + hit * mean_of(rgb[2], at, w), b)
        if depth is not None:
            mean = at[0] * w[0] + at[1] * w[1] + at[2] * w[2] + at[3] * w[3]
            moment = pick(take, moment + hit * (tm + mean), moment)
        T = pick(take, T - hit, T)
        u = pick(take, to, u)
        begin = antiderivative(p, u)
        length = pick(take, length * 2.0, pick(halve, length * 0.5, length))
        seen = Seen(T, r, g, b, moment)
        left = left & (u < end) & ~hidden(seen, brightest, depth, t_far)
    return seen


@jit
def see_segments(grid, colour, scale, nearest, depth, buffer, more, total):
    """Look at the first ``total`` segments in sorted order, cell by cell.

    A segment of constant density is looked at by the bricks of the colour that it crosses; where
    that is constant as well, such a brick is one cell.
    """
    atlas = colour.grid.atlas
    brightest = colour.brightest / colour.scale  # cells are seen unscaled
    zero = floats(0.0)
    for first in range(0, total, LANES):
        seg = fetch(buffer, first, total)
        rays, t, t1 = seg.rays, seg.begin, seg.end
        solid = seg.here & (seg.brick < 0)
        density = gather(grid.constants, -1 - seg.brick, solid)
        corner = first_corner(seg, t, solid)
        seen = Seen(floats(1.0), zero, zero, zero, zero)
        work = seg.here & (t < t1)
        while any_of(work):
            own = own_bricks(colour, corner, work)
            flat = work & (own < 0)
            constant = constant_colour(colour.grid.constants, own, flat)
            cells = enter_cells(rays, t, corner, pick(solid & flat, floats(8.0), 1.0))
            active = work
            while any_of(active):
                t_exit = cells_exit(cells, t1)
                tm = 0.5 * (t + t_exit)
                met = active & (t_exit > t)
                varied, coloured = met & ~solid, met & ~flat
                at = cells.at & 0xFFFF
                place, first_value = seg.brick * 729 + at, (own * 729 + at) * 3
                if nearest is not None:
                    p = (gather(grid.atlas, place, varied), zero, zero, zero)
                    red = (gather(atlas, first_value, coloured), zero, zero, zero)
                    green = (gather(atlas, first_value + 1, coloured), zero, zero, zero)
                    blue = (gather(atlas, first_value + 2, coloured), zero, zero, zero)
                else:
                    p = along(corners(grid.atlas, place, varied), rays, cells, tm)
                    v = colour_corners(atlas, first_value, coloured)
                    red, green = along(v[0], rays, cells, tm), along(v[1], rays, cells, tm)
                    blue = along(v[2], rays, cells, tm)
                p = settle(p, solid, density)
                rgb = (
                    settle(red, flat, constant[0]),
                    settle(green, flat, constant[1]),
                    settle(blue, flat, constant[2]),
                )
                seen = see_cells(seen, p, rgb, brightest, scale, t, t_exit, met, depth, seg.t_far)
                t = pick(active, max(t, t_exit), t)
                cells = next_cells(cells)
                left = active & solid & ~in_brick(cells)
                if any_of(left):  # here and now: the cells of lanes that wait go on
                    corner = pick_vector(left, brick_of(cells.corner), corner)
                active = active & (t_exit < t1) & in_brick(cells)
            work = work & solid & (t < t1)
        before = math.exp(-gather(more.before, seg.place, seg.here))
        light = before * colour.scale
        scatter(more.rgb, seg.place, seen.r * light, seg.here)
        scatter(more.rgb, seg.place + ROOM, seen.g * light, seg.here)
        scatter(more.rgb, seg.place + 2 * ROOM, seen.b * light, seg.here)
        if depth is not None:
            scatter(buffer.moment, seg.place, seen.moment * before, seg.here)


@jit
def first_corner(seg, t, solid):
    """The lowest local voxel of the bricks in which segments begin."""
    o, d = seg.rays.o, seg.rays.d
    corner = brick_of((o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2]))
    return pick_vector(solid, corner, seg.corner)


@jit
def pick_vector(condition, a, b):
    """`pick`, for vectors of three."""
    return pick(condition, a[0], b[0]), pick(condition, a[1], b[1]), pick(condition, a[2], b[2])


@jit
def brick_of(position):
    """The lowest local voxel of the bricks that hold positions."""
    return (
        math.floor(position[0] * 0.125) * 8.0,
        math.floor(position[1] * 0.125) * 8.0,
        math.floor(position[2] * 0.125) * 8.0,
    )


@jit
def constant_colour(constants, entry, mask):
    """The colours of entries that are constants."""
    at = (-1 - entry) * 3
    return (
        gather(constants, at, mask),
        gather(constants, at + 1, mask),
        gather(constants, at + 2, mask),
    )


@jit
def put_before(buffer, more, total):
    """Put down what lies before each segment, and add optical depths to those of the rays."""
    sums = buffer.rays
    for n in range(total):
        at = TAU_ROW * LANES + (buffer.content[n] & (LANES - 1))
        more.before[n] = sums[at]
        sums[at] += buffer.tau[n]


@jit
def list_seen(colour, depth, buffer, more, total, again):
    """List the segments that are looked at first, or ``again``; returns how many."""
    listed = 0
    for first in range(0, total, LANES):
        place = numbers() + first
        here = (place < total) & (load(buffer.tau, first) > 0.0)
        before = load(more.before, first)
        if again:
            ray = load(buffer.content, first) & (LANES - 1)
            T = math.exp(-before)
            r, g, b = kept_vector(buffer, RED_ROW, ray, here)
            seen = Seen(T, r, g, b, kept(buffer, MOMENT_ROW, ray, here))
            far = kept(buffer, FAR_ROW, ray, here)
            here = here & (before > STOP_TAU) & ~hidden(seen, colour.brightest, depth, far)
        else:
            here = here & (before <= STOP_TAU)
        append(more.seen, listed, place, here)
        listed += count(here)
    return listed


@jit
def light_segments(grid, colour, scale, nearest, depth, buffer, more, total):
    """The exact rule on all segments, with what is seen of them added to their rays; returns cells,
    INTS."""
    sort_by_length(buffer, total)
    cells = exact_segments(grid, scale, nearest, None, buffer, total)
    put_before(buffer, more, total)
    sums = buffer.rays
    for again in range(2):
        listed = list_seen(colour, depth, buffer, more, total, again)
        if listed > 0:
            sort_by_length(buffer, listed, more.seen)
            see_segments(grid, colour, scale, nearest, depth, buffer, more, listed)
            for n in range(listed):
                place = more.seen[n]
                lane = buffer.content[place] & (LANES - 1)
                for channel in range(3):
                    sums[(RED_ROW + channel) * LANES + lane] += more.rgb[channel, place]
                if depth is not None:
                    sums[MOMENT_ROW * LANES + lane] += buffer.moment[place]
    return cells
