"""The certified rule over the segments of a packet: bricks and octants as a whole where that is
right enough.

A segment's optical depth by the linear fit of its brick is off by at most its **slack**, the fit's
r times the extinction's scale times the segment's length (`bounds`). With the slacks of all parts
of a ray summed up to D, its optical depth tau is off by at most D, and what it transmits by at most

    exp(min(D, tau) - tau) (1 - exp(-D))

for the lesser of true and computed tau is at least tau - D and 0, and the greater at most D more.
So a ray may give away D as long as that stays below
the error E that is allowed. A lower bound of tau is known beforehand, from the least values of the
bricks: behind an optical depth of log(1 / E) nearly everything may be taken as a whole.

What a ray may give away is shared out in proportion to length. A brick that costs less than its
share is taken as a whole. One whose octants mostly would is cut into those that the ray crosses,
each taken as a whole if it costs less than the brick's share, less what its octants before did not
use. All else is walked cell by cell, exactly, within the brick's box. All sums are of one ray, in
its own order: its result does not depend on its packet.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from volcli.kernels.bounds import FIT, LEAST, OCTANTS_FIT, OUTLINE, REGIONS
from volcli.kernels.cell import absorbed
from volcli.kernels.compiler import jit
from volcli.kernels.lane_memory import append, gather, load, scatter, store
from volcli.kernels.lanes import (
    LANES,
    any_of,
    count,
    floats,
    ints,
    numbers,
    pick,
    to_floats,
    to_ints,
)
from volcli.kernels.packet_rules import (
    FAR_ROW,
    SLACK_ROW,
    TAU_ROW,
    Sums,
    add_cells,
    compose,
    exact_segments,
    fetch_at,
    make_buffer,
    sort_by_length,
)
from volcli.kernels.packet_walk import ROOM, Buffer, cross, enter_cube, exit_of, unpack, within

PARTS = 4
"""Octants of a brick that a ray crosses at most."""

BEYOND = 500.0
"""Optical depth beyond which nothing is told apart: its exponential is in float64's range."""


BEGIN_ROW, END_ROW, RATE_ROW, LOW_ROW, DOUBT_ROW, SHARE_ROWS = 0, 1, 2, 3, 4, 5
"""Numbers of each ray while its allowance is shared out: where it enters and leaves the root cell,
what it may give away in a unit of distance, a lower bound of its optical depth in the root cell,
and the length of what is in doubt."""


class BoundedBuffer(NamedTuple):
    """Room for the segments of a packet as bricks, and as what those are taken as.

    Attributes
    ----------
    bricks, parts, flat
        Segment n is taken as the ``bricks.key[n]`` parts from ``PARTS * n`` on; flat is what the
        rays are put together from. All three have one array of ``rays``.
    slack, part_slack
        (ROOM,), (PARTS * ROOM,) float64: what each optical depth is off by at most.
    dear
        (PARTS * ROOM,) int32: the parts that are walked cell by cell.
    shares
        (SHARE_ROWS * LANES,) float64.
    """

    bricks: Buffer
    parts: Buffer
    flat: Buffer
    slack: NDArray[np.float64]
    part_slack: NDArray[np.float64]
    dear: NDArray[np.int32]
    shares: NDArray[np.float64]


def bounded_buffer(bricks: Buffer) -> BoundedBuffer:
    """An empty `BoundedBuffer` beside that of bricks."""
    parts, flat = (make_buffer(PARTS * ROOM)._replace(rays=bricks.rays) for _ in range(2))
    return BoundedBuffer(
        bricks,
        parts,
        flat,
        np.empty(ROOM),
        np.empty(PARTS * ROOM),
        np.empty(PARTS * ROOM, np.int32),
        np.empty(SHARE_ROWS * LANES),
    )


@jit
def region_sums(fits, scale, seg, region, corner, width, t, t_exit, mask, depth):
    """(sums, slack) of [t, t_exit] by the fit of a region with lowest local voxel ``corner``."""
    at = (seg.brick * REGIONS + region) * FIT
    tm = 0.5 * (t + t_exit)
    half = 0.5 * width
    o, d = seg.rays.o, seg.rays.d
    value = gather(fits, at, mask)
    gx, gy, gz = gather(fits, at + 1, mask), gather(fits, at + 2, mask), gather(fits, at + 3, mask)
    value = (
        value
        + gx * (o[0] + tm * d[0] - corner[0] - half)
        + gy * (o[1] + tm * d[1] - corner[1] - half)
        + gz * (o[2] + tm * d[2] - corner[2] - half)
    )
    zero = floats(0.0)
    p = (value, gx * d[0] + gy * d[1] + gz * d[2], zero, zero)
    sums = add_cells(Sums(zero, floats(1.0), zero), p, scale, t, t_exit, mask, depth, seg.t_far)
    return sums, scale * gather(fits, at + 4, mask) * max(t_exit - t, 0.0)


@jit
def survey(grid, bounds, scale, buffer, total):
    """Of every segment a lower bound of its optical depth, in ``bricks.tau``, and its slack; those
    of a constant are exact."""
    bricks = buffer.bricks
    for first in range(0, total, LANES):
        here = numbers() + first < total
        brick = unpack(load(bricks.content, first))[0]
        solid = here & (brick < 0)
        fitted = here & ~solid
        length = scale * (load(bricks.end, first) - load(bricks.begin, first))
        least = gather(bounds.outlines, brick * OUTLINE + LEAST, fitted)
        if any_of(solid):
            least = pick(solid, gather(grid.constants, -1 - brick, solid), least)
        store(bricks.tau, first, least * length)
        store(
            buffer.slack,
            first,
            gather(bounds.density, brick * (REGIONS * FIT) + 4, fitted) * length,
        )


@jit
def allowance(error, tau, tint):
    """What the optical depth of a ray may be off by, if it is at least tau: the error is then no
    more in any channel."""
    if tint is None:
        return math.log1p(error * math.exp(min(tau, BEYOND)))
    least = math.inf
    for channel in range(3):
        k = tint[channel]
        if k > 0.0:
            least = min(least, math.log1p(error * math.exp(min(k * tau, BEYOND))) / k)
    return least


@jit
def error_of(tau, slack, tint):
    """What the transmittance of a ray is off by at most, in any channel: `allowance`, backwards."""
    off = min(slack, tau)
    if tint is None:
        return math.exp(off - tau) * absorbed(slack)
    most = 0.0
    for channel in range(3):
        k = tint[channel]
        most = max(most, math.exp(k * (off - tau)) * absorbed(k * slack))
    return most


@jit
def share_out(error, tint, buffer, total):
    """Work out the rate of each ray: what it may give away in a unit of distance.

    The rows of where the rays enter and leave the root cell are filled. What a ray may still give
    away is shared out by length among the root cells to come, this one first.
    """
    bricks, shares, sums = buffer.bricks, buffer.shares, buffer.bricks.rays
    for row in (LOW_ROW, DOUBT_ROW):
        for lane in range(LANES):
            shares[row * LANES + lane] = 0.0
    for n in range(total):
        lane = bricks.content[n] & (LANES - 1)
        shares[LOW_ROW * LANES + lane] += bricks.tau[n]
        if buffer.slack[n] > 0.0:
            shares[DOUBT_ROW * LANES + lane] += bricks.end[n] - bricks.begin[n]
    for lane in range(LANES):
        tau = sums[TAU_ROW * LANES + lane] + shares[LOW_ROW * LANES + lane]
        left = max(allowance(error, tau, tint) - sums[SLACK_ROW * LANES + lane], 0.0)
        begin, end = shares[BEGIN_ROW * LANES + lane], shares[END_ROW * LANES + lane]
        far, doubt = sums[FAR_ROW * LANES + lane], shares[DOUBT_ROW * LANES + lane]
        if end < far:
            left *= (end - begin) / (far - begin)
        shares[RATE_ROW * LANES + lane] = left / doubt if doubt > 0.0 else 0.0


@jit
def clip_to_box(boxes, seg, mask):
    """(t, t1): the part of each segment in the box of its brick; t >= t1 where there is none."""
    box = gather(boxes, seg.brick, mask)
    t, t1 = seg.begin, seg.end
    for axis in range(3):
        low = seg.corner[axis] + to_floats((box >> (4 * axis)) & 15) - seg.rays.o[axis]
        high = seg.corner[axis] + to_floats((box >> (4 * axis + 12)) & 15) - seg.rays.o[axis]
        still = seg.rays.still[axis]
        a, b = low * seg.rays.inverse[axis], high * seg.rays.inverse[axis]
        t = max(t, pick(still, t, min(a, b)))
        t1 = min(t1, pick(still, t1, max(a, b)))
        t1 = pick(still & ((low > 0.0) | (high < 0.0)), t, t1)
    return t, t1


@jit
def choose(bounds, scale, buffer, total):
    """Say what each segment is taken as: listed in ``bricks.order``, a whole; in ``flat.order``,
    octants; in ``dear``, cells. Returns the lengths of the three lists."""
    bricks, parts = buffer.bricks, buffer.parts
    whole = cut = dear = 0
    for first in range(0, total, LANES):
        place = numbers() + first
        here = place < total
        content = load(bricks.content, first)
        rate = gather(buffer.shares, (content & (LANES - 1)) + RATE_ROW * LANES, here)
        length = load(bricks.end, first) - load(bricks.begin, first)
        cheap = here & (load(buffer.slack, first) <= rate * length)
        brick = unpack(content)[0]
        doubtful = here & ~cheap
        fit = gather(bounds.outlines, brick * OUTLINE + OCTANTS_FIT, doubtful)
        divided = doubtful & (scale * fit <= rate)
        walked = doubtful & ~divided
        append(bricks.order, whole, place, cheap)
        append(buffer.flat.order, cut, place, divided)
        whole += count(cheap)
        cut += count(divided)
        store(bricks.key, first, ints(1))
        if any_of(walked):
            seg = fetch_at(bricks, place, walked)
            t, t1 = clip_to_box(bounds.boxes, seg, walked)
            part = place * PARTS
            scatter(parts.begin, part, t, walked)
            scatter(parts.end, part, t1, walked)
            scatter(parts.content, part, content, walked)
            scatter(parts.tau, part, floats(0.0), walked)
            scatter(parts.moment, part, floats(0.0), walked)
            scatter(buffer.part_slack, part, floats(0.0), walked)
            walked = walked & (t < t1)
            append(buffer.dear, dear, part, walked)
            dear += count(walked)
    return whole, cut, dear


@jit
def take_whole(grid, fits, scale, depth, buffer, listed):
    """The listed segments by the fits of their bricks, or exactly where they are of a constant."""
    bricks, parts = buffer.bricks, buffer.parts
    for first in range(0, listed, LANES):
        here = numbers() + first < listed
        place = pick(here, load(bricks.order, first), 0)
        seg = fetch_at(bricks, place, here)
        solid = here & (seg.brick < 0)
        fitted = here & ~solid
        t, t1 = seg.begin, seg.end
        sums, slack = region_sums(fits, scale, seg, ints(0), seg.corner, 8.0, t, t1, fitted, depth)
        if any_of(solid):
            zero = floats(0.0)
            value = gather(grid.constants, -1 - seg.brick, solid)
            p = (value, zero, zero, zero)
            sums = add_cells(sums, p, scale, t, t1, solid, depth, seg.t_far)
            slack = pick(solid, 0.0, slack)
        part = place * PARTS
        scatter(parts.content, part, gather(bricks.content, place, here), here)
        scatter(parts.tau, part, sums.tau, here)
        scatter(parts.moment, part, sums.moment, here)
        scatter(buffer.part_slack, part, slack, here)


@jit
def take_octants(fits, scale, depth, buffer, listed, dear):
    """The listed segments as octants, each by its fit; ``bricks.key`` says how many.

    Those that cost too much are added to the ``dear`` parts. Returns (octants that are not, INTS,
    how many parts are dear).
    """
    bricks, parts = buffer.bricks, buffer.parts
    settled = ints(0)
    for first in range(0, listed, LANES):
        here = numbers() + first < listed
        place = pick(here, load(buffer.flat.order, first), 0)
        seg = fetch_at(bricks, place, here)
        content = gather(bricks.content, place, here)
        rate = gather(buffer.shares, (content & (LANES - 1)) + RATE_ROW * LANES, here)
        t, t1 = seg.begin, seg.end
        walk = enter_cube(seg.rays, t, seg.corner, 4.0, 2.0)
        given, number, active = floats(0.0), ints(0), here
        while any_of(active):
            t_exit = exit_of(walk, t1)
            x, y, z = walk.cell
            corner = (seg.corner[0] + 4.0 * x, seg.corner[1] + 4.0 * y, seg.corner[2] + 4.0 * z)
            met = active & (t_exit > t)
            region = to_ints(4.0 * x + 2.0 * y + z) + 1
            sums, slack = region_sums(fits, scale, seg, region, corner, 4.0, t, t_exit, met, depth)
            cheap = met & (given + slack <= rate * (t_exit - seg.begin))
            part = place * PARTS + number
            scatter(parts.begin, part, t, met)
            scatter(parts.end, part, t_exit, met)
            scatter(parts.content, part, content, met)
            scatter(parts.tau, part, sums.tau, met)
            scatter(parts.moment, part, sums.moment, met)
            scatter(buffer.part_slack, part, pick(cheap, slack, 0.0), met)
            append(buffer.dear, dear, part, met & ~cheap)
            dear += count(met & ~cheap)
            given = pick(cheap, given + slack, given)
            settled = pick(cheap, settled + 1, settled)
            number = pick(met, number + 1, number)
            t = max(t, t_exit)
            walk = cross(walk)
            active = active & (t_exit < t1) & within(walk, 2.0)
        scatter(bricks.key, place, number, here)
    return settled, dear


@jit
def flatten(buffer, total):
    """Put the parts of all segments into one list, in order, and add up slacks; returns how many
    there are."""
    parts, flat = buffer.parts, buffer.flat
    used = 0
    for n in range(total):
        for part in range(n * PARTS, n * PARTS + buffer.bricks.key[n]):
            content = parts.content[part]
            flat.content[used] = content
            flat.tau[used] = parts.tau[part]
            flat.moment[used] = parts.moment[part]
            flat.rays[SLACK_ROW * LANES + (content & (LANES - 1))] += buffer.part_slack[part]
            used += 1
    return used


@jit
def bounded_segments(grid, bounds, scale, nearest, depth, tint, t, t_exit, buffer, total):
    """The certified rule on the segments of one root cell, which rays cross from t to t_exit.

    Their sums are added to those of the rays. Returns bricks, octants and cells that they are made
    of, INTS.
    """
    store(buffer.shares, BEGIN_ROW * LANES, t)
    store(buffer.shares, END_ROW * LANES, t_exit)
    survey(grid, bounds, scale, buffer, total)
    share_out(bounds.max_error, tint, buffer, total)
    whole, cut, dear = choose(bounds, scale, buffer, total)
    take_whole(grid, bounds.density, scale, depth, buffer, whole)
    settled, dear = take_octants(bounds.density, scale, depth, buffer, cut, dear)
    sort_by_length(buffer.parts, dear, buffer.dear)
    cells = exact_segments(grid, scale, nearest, depth, buffer.parts, dear)
    compose(buffer.flat, flatten(buffer, total), depth)
    return settled + cells + pick(numbers() == 0, ints(whole), 0)
