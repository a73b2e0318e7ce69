"""The rules of integration over the segments of a packet: `rules`, for `LANES` segments at once.

A segment of a ray in one brick knows nothing of what lies before it, so segments of different rays
and bricks stand side by side, in the order of `packets.sort_by_length`. What is found goes to the
buffer, as if the ray began with the segment.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from volcli.kernels.cell import (
    MAX_TAU,
    SHORTEST,
    absorbed,
    antiderivative,
    cubic,
    hit_weights,
    integral,
    trilinear,
)
from volcli.kernels.compiler import jit
from volcli.kernels.lane_memory import gather, gather_square, load, scatter, store
from volcli.kernels.lanes import LANES, any_of, floats, ints, numbers, pick, to_floats, to_ints
from volcli.kernels.light import FADED
from volcli.kernels.packet_walk import Buffer, enter_cube, make_rays, nearest_plane, unpack
from volcli.kernels.traversal import BRICK

CORNER_ROW, STEP_ROW, FAR_ROW, SPEED_ROW, TAU_ROW, MOMENT_ROW, SLACK_ROW = 9, 12, 13, 14, 15, 16, 17
RED_ROW, RAY_ROWS = 18, 21
"""Numbers kept of each ray, a row of `LANES` for each: o, d and inverse come first (3 rows each),
then the root cell's corner, the step of the midpoint rule, t_far, the planes crossed per world unit
of distance, and the sums; the slack is what tau may be off by. Red is the first of three."""


BINS = 32
"""Lengths that the sort tells apart: a segment has at most 3 * (8 - 1) + 1 = 22 cells."""


def make_buffer(room):
    """An empty `Buffer` for so many segments."""
    return Buffer(
        begin=np.empty(room),
        end=np.empty(room),
        content=np.empty(room, np.int64),
        tau=np.empty(room),
        moment=np.empty(room),
        key=np.empty(room, np.int8),
        order=np.empty(room, np.int32),
        rays=np.empty(RAY_ROWS * LANES),
        bins=np.empty(BINS + 1, np.int64),
    )


class Segments(NamedTuple):
    """`LANES` segments, of any rays of the packet.

    Attributes
    ----------
    here
        MASK: which lanes have one.
    place
        INTS: where in the buffer they are.
    rays
        Their rays.
    begin, end
        FLOATS: from and to where.
    brick
        INTS: the brick; where negative, the constant ``-1 - brick``.
    corner
        (x, y, z) FLOATS: the brick's lowest local voxel.
    step, t_far
        FLOATS: length of a step of the midpoint rule, and where the ray leaves the volume.
    """

    here: Any
    place: Any
    rays: Any
    begin: Any
    end: Any
    brick: Any
    corner: Any
    step: Any
    t_far: Any


class Sums(NamedTuple):
    """What is known of segments up to some distance, all as if nothing were before them.

    Attributes
    ----------
    tau, T, moment
        FLOATS: as in `light.State`.
    """

    tau: Any
    T: Any
    moment: Any


@jit
def kept(buffer, row, ray, mask):
    """A number that was put down, for each lane that of its own ray."""
    return gather(buffer.rays, ray + row * LANES, mask)


@jit
def kept_vector(buffer, row, ray, mask):
    """Three."""
    return (
        kept(buffer, row, ray, mask),
        kept(buffer, row + 1, ray, mask),
        kept(buffer, row + 2, ray, mask),
    )


@jit
def sort_by_length(buffer, total, listed=None):
    """Sort the segments by the number of cells that they cross, about: all, or those listed."""
    for first in range(0, total, LANES):
        here = numbers() + first < total
        if listed is None:
            content = load(buffer.content, first)
            length = load(buffer.end, first) - load(buffer.begin, first)
        else:
            place = load(listed, first)
            content = gather(buffer.content, place, here)
            length = gather(buffer.end, place, here) - gather(buffer.begin, place, here)
        cells = length * kept(buffer, SPEED_ROW, content & (LANES - 1), here)
        store(buffer.key, first, to_ints(min(max(cells, 0.0), BINS - 1.0)))
    bins = buffer.bins
    for b in range(BINS + 1):
        bins[b] = 0
    for n in range(total):
        bins[buffer.key[n] + 1] += 1
    for b in range(BINS):
        bins[b + 1] += bins[b]
    for n in range(total):
        key = buffer.key[n]
        buffer.order[bins[key]] = n if listed is None else listed[n]
        bins[key] += 1


@jit
def compose(buffer, total, depth):
    """Put the segments behind what is known of their rays, front to back."""
    sums = buffer.rays
    for n in range(total):
        at = TAU_ROW * LANES + (buffer.content[n] & (LANES - 1))
        tau = sums[at]
        sums[at] = tau + buffer.tau[n]
        if depth is not None:
            buffer.tau[n] = tau  # what lies before the segment
    if depth is not None:
        for first in range(0, total, LANES):
            before = math.exp(-load(buffer.tau, first))
            store(buffer.moment, first, before * load(buffer.moment, first))
        for n in range(total):
            sums[MOMENT_ROW * LANES + (buffer.content[n] & (LANES - 1))] += buffer.moment[n]


@jit
def fetch(buffer, first, total):
    """`Segments` first to first + LANES, in sorted order."""
    here = numbers() + first < total
    return fetch_at(buffer, pick(here, load(buffer.order, first), 0), here)


@jit
def fetch_at(buffer, place, here):
    """`Segments` at places in the buffer, where ``here`` holds."""
    brick, (x, y, z), ray = unpack(gather(buffer.content, place, here))
    rays = make_rays(
        kept_vector(buffer, 0, ray, here),
        kept_vector(buffer, 3, ray, here),
        kept_vector(buffer, 6, ray, here),
    )
    root = kept_vector(buffer, CORNER_ROW, ray, here)
    corner = (
        root[0] + to_floats(x) * float(BRICK),
        root[1] + to_floats(y) * float(BRICK),
        root[2] + to_floats(z) * float(BRICK),
    )
    return Segments(
        here,
        place,
        rays,
        gather(buffer.begin, place, here),
        gather(buffer.end, place, here),
        brick,
        corner,
        kept(buffer, STEP_ROW, ray, here),
        kept(buffer, FAR_ROW, ray, here),
    )


@jit
def corners(atlas, at, mask):
    """The eight values about cells that begin at ``at`` in the atlas: `cell.load`."""
    return gather_square(atlas, at, 9, mask) + gather_square(atlas, at + 81, 9, mask)


@jit
def add_cells(sums, p, scale, t, t_exit, mask, depth, t_far):
    """Add [t, t_exit] to the sums; p is the density's cubic about the middle.

    Without depth only the optical depth is added; else see `light.add_span`, of which this is
    the same for lanes. Light has faded (`light.faded`) where it has within the segment alone: then
    it has in the ray.
    """
    if depth is None:
        tau = sums.tau + scale * integral(p, max(t_exit - t, 0.0))
        return Sums(pick(mask, tau, sums.tau), sums.T, sums.moment)
    tm = 0.5 * (t + t_exit)
    u, end = t - tm, t_exit - tm
    begin = antiderivative(p, u)
    whole = max(0.0, scale * (antiderivative(p, end) - begin))
    T, moment = sums.T, sums.moment
    length = end - u
    shortest = length * SHORTEST
    left = mask & (whole > 0.0) & (T * t_far > FADED * moment)
    while any_of(left):
        to = min(u + length, end)
        thick = scale * (antiderivative(p, to) - begin) > MAX_TAU
        halve = left & thick & (length > shortest)
        take = left & ~halve
        part, at, w = hit_weights(p, scale, u, to)
        hit = T * absorbed(part)
        mean = at[0] * w[0] + at[1] * w[1] + at[2] * w[2] + at[3] * w[3]
        moment = pick(take, moment + hit * (tm + mean), moment)
        T = pick(take, T - hit, T)
        u = pick(take, to, u)
        begin = antiderivative(p, u)
        length = pick(take, length * 2.0, pick(halve, length * 0.5, length))
        left = left & (u < end) & (T * t_far > FADED * moment)
    return Sums(pick(mask, sums.tau + whole, sums.tau), T, moment)


class Cells(NamedTuple):
    """Where segments stand in their bricks.

    Attributes
    ----------
    at
        INTS: where the cell is: low, its place in the brick; high, i, j and k, a byte each, whose
        fourth bit is set as soon as one is not in 0 to 7.
    corner
        (x, y, z) FLOATS: the cell's lowest local voxel.
    planes
        (x, y, z) FLOATS: distances at which the next planes are crossed.
    step, step_at, spacing
        What is added to the three when a plane across x, y or z is crossed.
    """

    at: Any
    corner: Any
    planes: Any
    step: Any
    step_at: Any
    spacing: Any


@jit
def enter_cells(rays, t, corner, width):
    """The `Cells` of a brick with lowest local voxel ``corner`` in which rays are at distance t.

    Where ``width`` is 8 and not 1, the whole brick is one cell.
    """
    walk = enter_cube(rays, t, corner, width, 8.0 / width)
    i, j, k = to_ints(walk.cell[0]), to_ints(walk.cell[1]), to_ints(walk.cell[2])
    return Cells(
        (i << 32) + (j << 40) + (k << 48) + ((i * 9 + j) * 9 + k),
        (
            corner[0] + walk.cell[0] * width,
            corner[1] + walk.cell[1] * width,
            corner[2] + walk.cell[2] * width,
        ),
        walk.planes,
        (walk.step[0] * width, walk.step[1] * width, walk.step[2] * width),
        (
            to_ints(walk.step[0] * width) * ((1 << 32) + 81),
            to_ints(walk.step[1] * width) * ((1 << 40) + 9),
            to_ints(walk.step[2] * width) * ((1 << 48) + 1),
        ),
        walk.spacing,
    )


@jit
def cells_exit(cells, t1):
    """Where the segments leave their cells, or end."""
    return min(min(cells.planes[0], cells.planes[1]), min(cells.planes[2], t1))


@jit
def next_cells(cells):
    """The cells beyond the nearest planes."""
    over_x, over_y, over_z = nearest_plane(cells.planes)
    x, y, z = cells.corner
    tx, ty, tz = cells.planes
    return Cells(
        cells.at + pick(over_x, cells.step_at[0], pick(over_y, cells.step_at[1], cells.step_at[2])),
        (
            pick(over_x, x + cells.step[0], x),
            pick(over_y, y + cells.step[1], y),
            pick(over_z, z + cells.step[2], z),
        ),
        (
            pick(over_x, tx + cells.spacing[0], tx),
            pick(over_y, ty + cells.spacing[1], ty),
            pick(over_z, tz + cells.spacing[2], tz),
        ),
        cells.step,
        cells.step_at,
        cells.spacing,
    )


@jit
def in_brick(cells):
    """Where a cell is one of its brick."""
    return (cells.at & ((8 << 32) + (8 << 40) + (8 << 48))) == 0


@jit
def along(v, rays, cells, tm):
    """`cell.cubic` of values v at the corners of cells, about distance tm."""
    o, d = rays.o, rays.d
    x, y, z = cells.corner
    return cubic(
        v,
        o[0] + tm * d[0] - x,
        o[1] + tm * d[1] - y,
        o[2] + tm * d[2] - z,
        d[0],
        d[1],
        d[2],
    )


@jit
def exact_segments(grid, scale, nearest, depth, buffer, total):
    """The exact rule on the first ``total`` segments in sorted order; returns cells, INTS."""
    evaluated = ints(0)
    for first in range(0, total, LANES):
        seg = fetch(buffer, first, total)
        sums = Sums(floats(0.0), floats(1.0), floats(0.0))
        t, t1 = seg.begin, seg.end
        zero = floats(0.0)

        constant = seg.here & (seg.brick < 0)
        if any_of(constant):
            value = gather(grid.constants, -1 - seg.brick, constant)
            sums = add_cells(
                sums, (value, zero, zero, zero), scale, t, t1, constant, depth, seg.t_far
            )
            evaluated = pick(constant, evaluated + 1, evaluated)

        active = seg.here & ~constant & (t < t1)
        cells = enter_cells(seg.rays, t, seg.corner, 1.0)
        while any_of(active):
            t_exit = cells_exit(cells, t1)
            at = seg.brick * 729 + (cells.at & 0xFFFF)
            if nearest is not None:
                p = (gather(grid.atlas, at, active), zero, zero, zero)
            else:
                p = along(corners(grid.atlas, at, active), seg.rays, cells, 0.5 * (t + t_exit))
            met = active & (t_exit > t)
            sums = add_cells(sums, p, scale, t, t_exit, met, depth, seg.t_far)
            evaluated = pick(met, evaluated + 1, evaluated)
            t = max(t, t_exit)
            cells = next_cells(cells)
            active = active & (t_exit < t1) & in_brick(cells)
        scatter(buffer.tau, seg.place, sums.tau, seg.here)
        if depth is not None:
            scatter(buffer.moment, seg.place, sums.moment, seg.here)
    return evaluated


@jit
def density_at(grid, seg, nearest, t, mask):
    """The density at distance t in each segment: `rules.density_at`."""
    x = seg.rays.o[0] + t * seg.rays.d[0] - seg.corner[0]
    y = seg.rays.o[1] + t * seg.rays.d[1] - seg.corner[1]
    z = seg.rays.o[2] + t * seg.rays.d[2] - seg.corner[2]
    i = min(max(math.floor(x), 0.0), 7.0)
    j = min(max(math.floor(y), 0.0), 7.0)
    k = min(max(math.floor(z), 0.0), 7.0)
    solid = seg.brick < 0
    at = seg.brick * 729 + to_ints((i * 9.0 + j) * 9.0 + k)
    inside = mask & ~solid
    if nearest is not None:
        value = gather(grid.atlas, at, inside)
    else:
        value = max(0.0, trilinear(corners(grid.atlas, at, inside), x - i, y - j, z - k))
    return pick(solid, gather(grid.constants, -1 - seg.brick, mask & solid), value)


@jit
def midpoint_segments(grid, scale, nearest, depth, buffer, total):
    """The midpoint rule on sorted segments (`rules.midpoint_segment`); returns samples, INTS."""
    evaluated = ints(0)
    for first in range(0, total, LANES):
        seg = fetch(buffer, first, total)
        step, t_far = seg.step, seg.t_far
        last = max(-math.floor(-t_far / step) - 1.0, 0.0)
        n = min(max(-math.floor(0.5 - seg.begin / step) - 1.0, 0.0), last)
        tau, T, moment = floats(0.0), floats(1.0), floats(0.0)
        active = seg.here
        while any_of(active):
            length = min(step, t_far - n * step)
            t = n * step + 0.5 * length
            active = active & (t < seg.end)
            met = active & (t >= seg.begin)
            part = scale * density_at(grid, seg, nearest, t, met) * length
            tau = pick(met, tau + part, tau)
            if depth is not None:
                hit = T * absorbed(part)
                moment = pick(met, moment + hit * t, moment)
                T = pick(met, T - hit, T)
            evaluated = pick(met, evaluated + 1, evaluated)
            n = n + 1.0
            active = active & (n <= last)
        scatter(buffer.tau, seg.place, tau, seg.here)
        if depth is not None:
            scatter(buffer.moment, seg.place, moment, seg.here)
    return evaluated
