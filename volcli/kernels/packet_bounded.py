"""The certified rule over the segments of a packet: bricks and octants as a whole where that is
right enough.

A segment's optical depth by the linear fit of its brick is off by at most its **slack**, the fit's
r times the extinction's scale times the segment's length (`bounds`). With the slacks of all parts
of a ray summed up to D, its optical depth tau is off by at most D, and what it transmits by at most

    exp(-tau) (exp(min(D, tau)) - 1)

for true and computed tau are both at least 0. So a ray may give away D as long as that stays below
the error E that is allowed. Before any brick is refined, the sum of all (tau - slack) is known, a
lower bound of the ray's tau; behind an optical depth of log(1 / E) nearly everything may be taken
as a whole.

What a ray may give away is shared out in proportion to length: what costs less than its share is
taken as a whole, and what that leaves over is shared out again among the rest. A brick that costs
more is cut into the octants that the ray crosses, and those that cost more than the brick's share
(less what its octants before did not use) are walked cell by cell, exactly. All sums are of one
ray, in its own order: its result does not depend on its packet.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from volcli.kernels.bounds import FIT, REGIONS
from volcli.kernels.cell import absorbed
from volcli.kernels.compiler import jit
from volcli.kernels.lane_memory import append, gather, load, scatter, store
from volcli.kernels.lanes import LANES, any_of, count, floats, ints, numbers, pick, to_ints
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
from volcli.kernels.packet_walk import ROOM, Buffer, cross, enter_cube, exit_of, within

PARTS = 4
"""Octants of a brick that a ray crosses at most."""

ROUNDS = 3
"""How often what is left over is shared out."""

BEYOND = 500.0
"""Optical depth beyond which nothing is told apart: its exponential is in float64's range."""


BEGIN_ROW, END_ROW, RATE_ROW, GIVE_ROW, LOW_ROW, DOUBT_ROW, SHARE_ROWS = 0, 1, 2, 3, 4, 5, 6
"""Numbers of each ray while its allowance is shared out: where it enters and leaves the root cell,
what it may give away in a unit of distance and in all, and two sums."""


class BoundedBuffer(NamedTuple):
    """Room for the segments of a packet as bricks, as the octants of bricks, and as both.

    Attributes
    ----------
    bricks, parts, flat
        Parts ``PARTS * n`` and following are those of segment n; flat is what the rays are put
        together from. They have one array of ``rays``.
    slack, part_slack
        (ROOM,), (PARTS * ROOM,) float64: what each optical depth is off by at most.
    shares
        (SHARE_ROWS * LANES,) float64.
    """

    bricks: Buffer
    parts: Buffer
    flat: Buffer
    slack: NDArray[np.float64]
    part_slack: NDArray[np.float64]
    shares: NDArray[np.float64]


def bounded_buffer(bricks: Buffer) -> BoundedBuffer:
    """An empty `BoundedBuffer` beside that of bricks."""
    parts, flat = (make_buffer(PARTS * ROOM)._replace(rays=bricks.rays) for _ in range(2))
    shares = np.empty(SHARE_ROWS * LANES)
    return BoundedBuffer(bricks, parts, flat, np.empty(ROOM), np.empty(PARTS * ROOM), shares)


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
def whole_bricks(grid, fits, scale, depth, buffer, total):
    """Every segment by the fit of its brick, or exactly where it is a constant."""
    bricks = buffer.bricks
    for first in range(0, total, LANES):
        here = numbers() + first < total
        seg = fetch_at(bricks, numbers() + first, here)
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
        store(bricks.tau, first, sums.tau)
        store(bricks.moment, first, sums.moment)
        store(buffer.slack, first, slack)


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
        return math.exp(off - tau) * absorbed(off)
    most = 0.0
    for channel in range(3):
        k = tint[channel]
        most = max(most, math.exp(k * (off - tau)) * absorbed(k * off))
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
    for n in range(total):  # a lower bound of tau, and how much of the ray is in doubt
        lane = bricks.content[n] & (LANES - 1)
        slack = buffer.slack[n]
        shares[LOW_ROW * LANES + lane] += max(bricks.tau[n] - slack, 0.0)
        if slack > 0.0:
            shares[DOUBT_ROW * LANES + lane] += bricks.end[n] - bricks.begin[n]
    for lane in range(LANES):
        tau = sums[TAU_ROW * LANES + lane] + shares[LOW_ROW * LANES + lane]
        left = allowance(error, tau, tint) - sums[SLACK_ROW * LANES + lane]
        begin, end = shares[BEGIN_ROW * LANES + lane], shares[END_ROW * LANES + lane]
        far = sums[FAR_ROW * LANES + lane]
        give = max(left, 0.0) * ((end - begin) / (far - begin) if end < far else 1.0)
        doubt = shares[DOUBT_ROW * LANES + lane]
        shares[GIVE_ROW * LANES + lane] = give
        shares[RATE_ROW * LANES + lane] = give / doubt if doubt > 0.0 else 0.0
    for _ in range(ROUNDS):
        share_out_again(buffer, total)


@jit
def share_out_again(buffer, total):
    """Share out among the bricks that cost more than their share what the others leave over."""
    bricks, shares = buffer.bricks, buffer.shares
    for row in (LOW_ROW, DOUBT_ROW):  # used, and how much of the ray is still in doubt
        for lane in range(LANES):
            shares[row * LANES + lane] = 0.0
    for n in range(total):
        lane = bricks.content[n] & (LANES - 1)
        length = bricks.end[n] - bricks.begin[n]
        if buffer.slack[n] <= shares[RATE_ROW * LANES + lane] * length:
            shares[LOW_ROW * LANES + lane] += buffer.slack[n]
        else:
            shares[DOUBT_ROW * LANES + lane] += length
    for lane in range(LANES):
        doubt = shares[DOUBT_ROW * LANES + lane]
        if doubt > 0.0:
            left = shares[GIVE_ROW * LANES + lane] - shares[LOW_ROW * LANES + lane]
            rate = shares[RATE_ROW * LANES + lane]
            shares[RATE_ROW * LANES + lane] = max(rate, left / doubt)


@jit
def list_dear(buffer, total):
    """List the segments, in ``bricks.order``, that cost more than their share; returns how many."""
    bricks = buffer.bricks
    listed = 0
    for first in range(0, total, LANES):
        place = numbers() + first
        here = place < total
        rate = gather(
            buffer.shares, (load(bricks.content, first) & (LANES - 1)) + RATE_ROW * LANES, here
        )
        length = load(bricks.end, first) - load(bricks.begin, first)
        dear = here & ~(load(buffer.slack, first) <= rate * length)
        store(bricks.key, first, ints(0))
        append(bricks.order, listed, place, dear)
        listed += count(dear)
    return listed


@jit
def octants(fits, scale, depth, buffer, listed):
    """Cut the listed segments into octants, each by its fit; ``bricks.key`` says how many.

    Those that cost too much are listed in ``flat.order``, to be walked cell by cell. Returns
    (octants that are not, INTS, how many are listed).
    """
    bricks, parts = buffer.bricks, buffer.parts
    settled, used = ints(0), 0
    for first in range(0, listed, LANES):
        here = numbers() + first < listed
        place = pick(here, load(bricks.order, first), 0)
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
            dear = met & ~cheap
            part = place * PARTS + number
            scatter(parts.begin, part, t, met)
            scatter(parts.end, part, t_exit, met)
            scatter(parts.content, part, content, met)
            scatter(parts.tau, part, sums.tau, met)
            scatter(parts.moment, part, sums.moment, met)
            scatter(buffer.part_slack, part, pick(cheap, slack, 0.0), met)
            append(buffer.flat.order, used, part, dear)
            used += count(dear)
            given = pick(cheap, given + slack, given)
            settled = pick(cheap, settled + 1, settled)
            number = pick(met, number + 1, number)
            t = max(t, t_exit)
            walk = cross(walk)
            active = active & (t_exit < t1) & within(walk, 2.0)
        scatter(bricks.key, place, number, here)
    return settled, used


@jit
def flatten(buffer, total):
    """Put bricks and parts of bricks into one list, in order, and add up slacks; returns how many
    there are."""
    bricks, parts, flat = buffer.bricks, buffer.parts, buffer.flat
    used = 0
    for n in range(total):
        at = SLACK_ROW * LANES + (bricks.content[n] & (LANES - 1))
        if bricks.key[n] == 0:
            flat.content[used] = bricks.content[n]
            flat.tau[used] = bricks.tau[n]
            flat.moment[used] = bricks.moment[n]
            bricks.rays[at] += buffer.slack[n]
            used += 1
        for part in range(n * PARTS, n * PARTS + bricks.key[n]):
            flat.content[used] = parts.content[part]
            flat.tau[used] = parts.tau[part]
            flat.moment[used] = parts.moment[part]
            bricks.rays[at] += buffer.part_slack[part]
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
    whole_bricks(grid, bounds.density, scale, depth, buffer, total)
    share_out(bounds.max_error, tint, buffer, total)
    listed = list_dear(buffer, total)
    settled, dear = octants(bounds.density, scale, depth, buffer, listed)
    sort_by_length(buffer.parts, dear, buffer.flat.order)
    cells = exact_segments(grid, scale, nearest, depth, buffer.parts, dear)
    compose(buffer.flat, flatten(buffer, total), depth)
    return settled + cells + pick(numbers() == 0, ints(total - listed), 0)
