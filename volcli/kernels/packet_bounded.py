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

A segment is one part of a ray where its brick's fit is good, and else as many as there are octants
that it crosses; only the brick's box counts, and octants that hold anything. What a ray may give
away is shared out among its parts by length, at one rate, and what those that cost less leave over
among the others, a few times over. A part that costs no more than the rate is taken by its fit; all
others are walked cell by cell, exactly. All sums are of one ray, in its own order: its result does
not depend on its packet.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import literal_unroll
from numpy.typing import NDArray

from volcli.kernels.bounds import FIT, REGIONS
from volcli.kernels.cell import absorbed
from volcli.kernels.compiler import jit
from volcli.kernels.lane_memory import gather, load, scatter, store
from volcli.kernels.lanes import (
    LANES,
    any_of,
    floats,
    ints,
    numbers,
    pick,
    to_floats,
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
from volcli.kernels.packet_walk import ROOM, Buffer

PARTS = 4
"""Octants of a brick that a ray crosses at most."""

BEYOND = 500.0
"""Optical depth beyond which nothing is told apart: its exponential is in float64's range."""


BEGIN_ROW, END_ROW, GIVE_ROW, RATE_ROW, SUM_ROW, DOUBT_ROW, SHARE_ROWS = 0, 1, 2, 3, 4, 5, 6
"""Numbers of each ray while its allowance is shared out: where it enters and leaves the root cell,
what it may give away there in all and in a unit of distance; a sum, and the length in doubt."""

ROUNDS = 1
"""How often what cheap parts leave over is shared out."""

CONSTANT = -1
"""In place of the number of a region: none, but a constant."""


class BoundedBuffer(NamedTuple):
    """Room for the parts that the segments of a packet are cut into.

    Attributes
    ----------
    parts
        `packet_walk.Buffer`; ``key`` is the region of a part, or `CONSTANT`. It has one array of
        ``rays`` with the buffer of segments.
    slack
        (PARTS * ROOM,) float64: what the optical depth of each part is off by at most.
    cheap, dear
        (PARTS * ROOM,) int32: the parts taken by their fits, and those that are walked.
    shares
        (SHARE_ROWS * LANES,) float64.
    starts
        (LANES,) int64: where the parts of a segment begin.
    """

    parts: Buffer
    slack: NDArray[np.float64]
    cheap: NDArray[np.int32]
    dear: NDArray[np.int32]
    shares: NDArray[np.float64]
    starts: NDArray[np.int64]


def bounded_buffer(segments: Buffer) -> BoundedBuffer:
    """An empty `BoundedBuffer` beside that of segments."""
    room = PARTS * ROOM
    return BoundedBuffer(
        make_buffer(room)._replace(rays=segments.rays),
        np.empty(room),
        np.empty(room, np.int32),
        np.empty(room, np.int32),
        np.empty(SHARE_ROWS * LANES),
        np.empty(LANES, np.int64),
    )


class Part(NamedTuple):
    """A part of each of some segments; FLOATS, INTS and a MASK.

    Attributes
    ----------
    begin, end, region, r
        From and to where, of which region, and the r of its fit.
    here
        Where there is a part.
    """

    begin: Any
    end: Any
    region: Any
    r: Any
    here: Any


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
def middle_planes(seg, t, t1, mask):
    """Where the segments cross the planes between the octants of their bricks, in order; t1 where
    they do not, or the mask does not hold."""
    planes = (seg.end, seg.end, seg.end)
    for axis in range(3):
        plane = (seg.corner[axis] + 4.0 - seg.rays.o[axis]) * seg.rays.inverse[axis]
        plane = pick(mask & ~seg.rays.still[axis], min(max(plane, t), t1), t1)
        planes = (planes[1], planes[2], plane)
    a, b = min(planes[0], planes[1]), max(planes[0], planes[1])
    return min(a, planes[2]), max(a, min(b, planes[2])), max(b, planes[2])


@jit
def octant_part(fits, seg, t, t_exit, mask):
    """The `Part` of each segment from t to t_exit; none where its octant is 0."""
    tm = 0.5 * (t + t_exit)
    o, d = seg.rays.o, seg.rays.d
    region = (
        pick(o[0] + tm * d[0] - seg.corner[0] < 4.0, ints(1), 5)
        + pick(o[1] + tm * d[1] - seg.corner[1] < 4.0, ints(0), 2)
        + pick(o[2] + tm * d[2] - seg.corner[2] < 4.0, ints(0), 1)
    )
    mask = mask & (t < t_exit)
    at = (seg.brick * REGIONS + region) * FIT
    r = gather(fits, at + 4, mask)
    return Part(t, t_exit, region, r, mask & ((r > 0.0) | ~(gather(fits, at, mask) == 0.0)))


@jit
def cut(grid, bounds, scale, segments, buffer, total):
    """Cut the segments into parts; returns how many. ``parts.tau`` is a lower bound of the optical
    depth of each.

    The rate by which it is judged whether a brick is a part is twice that of a ray all of which is
    in doubt.
    """
    parts = 0
    for first in range(0, total, LANES):
        here = numbers() + first < total
        seg = fetch_at(segments, numbers() + first, here)
        content = load(segments.content, first)
        solid = here & (seg.brick < 0)
        here = here & ~solid
        t, t1 = clip_to_box(bounds.boxes, seg, here)
        t, t1 = pick(solid, seg.begin, t), pick(solid, seg.end, t1)
        r = gather(bounds.density, seg.brick * (REGIONS * FIT) + 4, here)
        rate = gather(buffer.shares, (content & (LANES - 1)) + RATE_ROW * LANES, here)
        whole = here & (scale * r <= 2.0 * rate)
        finest = gather(bounds.finest, seg.brick, here)
        whole = whole | (here & (scale * finest > 2.0 * rate))  # its octants would be no better
        divided = here & ~whole
        least = gather(bounds.least, seg.brick, here)
        if any_of(solid):
            least = pick(solid, gather(grid.constants, -1 - seg.brick, solid), least)
        region = pick(solid, ints(CONSTANT), 0)
        if any_of(divided):
            m = middle_planes(seg, t, t1, divided)
            a = octant_part(bounds.density, seg, t, m[0], divided)
            b = octant_part(bounds.density, seg, m[0], m[1], divided)
            c = octant_part(bounds.density, seg, m[1], m[2], divided)
            e = octant_part(bounds.density, seg, m[2], t1, divided)
            whole = (whole | solid) & (t < t1)
            a = Part(
                t,
                pick(divided, a.end, t1),
                pick(divided, a.region, region),
                pick(divided, a.r, r),
                a.here | whole,
            )
            parts = put_parts(buffer, parts, (a, b, c, e), content, scale, least)
        else:
            one = Part(t, t1, region, r, (whole | solid) & (t < t1))
            parts = put_parts(buffer, parts, (one,), content, scale, least)
    return parts


@jit
def put_parts(buffer, parts, some, content, scale, least):
    """Put down the parts of some segments, those of each in order; returns how many parts there
    are then."""
    number = ints(0)
    for part in literal_unroll(some):
        number = pick(part.here, number + 1, number)
    store(buffer.starts, 0, number)
    for lane in range(LANES):
        more = buffer.starts[lane]
        buffer.starts[lane] = parts
        parts += more
    place = load(buffer.starts, 0)
    for part in literal_unroll(some):
        length = scale * (part.end - part.begin)
        scatter(buffer.parts.begin, place, part.begin, part.here)
        scatter(buffer.parts.end, place, part.end, part.here)
        scatter(buffer.parts.content, place, content, part.here)
        scatter(buffer.parts.key, place, part.region, part.here)
        scatter(buffer.parts.tau, place, least * length, part.here)
        scatter(buffer.slack, place, part.r * length, part.here)
        place = pick(part.here, place + 1, place)
    return parts


@jit
def clear(shares):
    """Begin sums anew."""
    for lane in range(LANES):
        shares[SUM_ROW * LANES + lane] = 0.0
        shares[DOUBT_ROW * LANES + lane] = 0.0


@jit
def first_rate(error, tint, buffer):
    """The rate of each ray were all of it in doubt and its optical depth 0."""
    shares, sums = buffer.shares, buffer.parts.rays
    give = allowance(error, 0.0, tint)
    for lane in range(LANES):
        length = max(sums[FAR_ROW * LANES + lane] - shares[BEGIN_ROW * LANES + lane], 0.0)
        shares[RATE_ROW * LANES + lane] = give / length if length > 0.0 else 0.0


@jit
def share_out(error, tint, buffer, total):
    """Work out what each ray may give away in this root cell, and its rate.

    The rows of where the rays enter and leave the root cell are filled. What a ray may still give
    away is shared out by length among the root cells to come, this one first.
    """
    parts, shares, sums = buffer.parts, buffer.shares, buffer.parts.rays
    clear(shares)
    for n in range(total):
        lane = parts.content[n] & (LANES - 1)
        length = parts.end[n] - parts.begin[n]
        shares[SUM_ROW * LANES + lane] += parts.tau[n]
        shares[DOUBT_ROW * LANES + lane] += pick(buffer.slack[n] > 0.0, length, 0.0)
    for lane in range(LANES):
        tau = sums[TAU_ROW * LANES + lane] + shares[SUM_ROW * LANES + lane]
        give = max(allowance(error, tau, tint) - sums[SLACK_ROW * LANES + lane], 0.0)
        begin, end = shares[BEGIN_ROW * LANES + lane], shares[END_ROW * LANES + lane]
        far, doubt = sums[FAR_ROW * LANES + lane], shares[DOUBT_ROW * LANES + lane]
        if end < far:
            give *= (end - begin) / (far - begin)
        shares[GIVE_ROW * LANES + lane] = give
        shares[RATE_ROW * LANES + lane] = give / doubt if doubt > 0.0 else 0.0
    for _ in range(ROUNDS):
        share_out_again(buffer, total)


@jit
def share_out_again(buffer, total):
    """Raise the rates by what the parts leave over that cost no more than the rate.

    (Which of them do is chance: to branch on it costs more than to add both numbers up.)
    """
    parts, shares = buffer.parts, buffer.shares
    clear(shares)
    for n in range(total):
        lane = parts.content[n] & (LANES - 1)
        length, slack = parts.end[n] - parts.begin[n], buffer.slack[n]
        cheap = slack <= shares[RATE_ROW * LANES + lane] * length
        shares[SUM_ROW * LANES + lane] += pick(cheap, slack, 0.0)
        shares[DOUBT_ROW * LANES + lane] += pick(cheap, 0.0, length)
    for lane in range(LANES):
        doubt = shares[DOUBT_ROW * LANES + lane]
        if doubt > 0.0:
            left = shares[GIVE_ROW * LANES + lane] - shares[SUM_ROW * LANES + lane]
            rate = shares[RATE_ROW * LANES + lane]
            shares[RATE_ROW * LANES + lane] = max(rate, left / doubt)


@jit
def choose(buffer, total):
    """List the parts that are taken by their fits, adding up their slacks, and the others, those
    of one brick joined that meet. Returns the lengths of the lists."""
    parts, shares, sums = buffer.parts, buffer.shares, buffer.parts.rays
    cheap = dear = 0
    first, met = -1, -1  # the part that others may join, and the one that would be next to do so
    for n in range(total):
        lane = parts.content[n] & (LANES - 1)
        slack = buffer.slack[n]
        settled = slack <= shares[RATE_ROW * LANES + lane] * (parts.end[n] - parts.begin[n])
        sums[SLACK_ROW * LANES + lane] += pick(settled, slack, 0.0)
        buffer.cheap[cheap] = n
        cheap += int(settled)
        if not settled:
            joins = met == n and parts.content[first] == parts.content[n]
            if joins and parts.end[first] == parts.begin[n]:
                parts.end[first] = parts.end[n]
                parts.tau[n] = parts.moment[n] = 0.0
            else:
                buffer.dear[dear] = n
                dear += 1
                first = n
            met = n + 1
    return cheap, dear


@jit
def take_fits(grid, fits, scale, depth, buffer, total):
    """The listed parts by the fits of their regions, or exactly where they are of a constant."""
    parts = buffer.parts
    zero = floats(0.0)
    for first in range(0, total, LANES):
        here = numbers() + first < total
        place = pick(here, load(buffer.cheap, first), 0)
        seg = fetch_at(parts, place, here)
        region = gather(parts.key, place, here)
        solid = here & (region == CONSTANT)
        octant = region - 1
        whole = region <= 0
        half = pick(whole, floats(4.0), 2.0)
        x = seg.corner[0] + half + pick(whole, 0.0, to_floats((octant >> 2) & 1) * 4.0)
        y = seg.corner[1] + half + pick(whole, 0.0, to_floats((octant >> 1) & 1) * 4.0)
        z = seg.corner[2] + half + pick(whole, 0.0, to_floats(octant & 1) * 4.0)
        fitted = here & ~solid
        at = (seg.brick * REGIONS + region) * FIT
        gx, gy = gather(fits, at + 1, fitted), gather(fits, at + 2, fitted)
        gz = gather(fits, at + 3, fitted)
        tm = 0.5 * (seg.begin + seg.end)
        o, d = seg.rays.o, seg.rays.d
        value = (
            gather(fits, at, fitted)
            + gx * (o[0] + tm * d[0] - x)
            + gy * (o[1] + tm * d[1] - y)
            + gz * (o[2] + tm * d[2] - z)
        )
        if any_of(solid):
            value = pick(solid, gather(grid.constants, -1 - seg.brick, solid), value)
        p = (value, gx * d[0] + gy * d[1] + gz * d[2], zero, zero)
        sums = Sums(zero, floats(1.0), zero)
        sums = add_cells(sums, p, scale, seg.begin, seg.end, here, depth, seg.t_far)
        scatter(parts.tau, place, sums.tau, here)
        scatter(parts.moment, place, sums.moment, here)


@jit
def bounded_segments(grid, bounds, scale, nearest, depth, tint, t, t_exit, segments, buffer, total):
    """The certified rule on the segments of one root cell, which rays cross from t to t_exit.

    Their sums are added to those of the rays. Returns parts and cells that they are made of, INTS.
    """
    store(buffer.shares, BEGIN_ROW * LANES, t)
    store(buffer.shares, END_ROW * LANES, t_exit)
    first_rate(bounds.max_error, tint, buffer)
    parts = cut(grid, bounds, scale, segments, buffer, total)
    share_out(bounds.max_error, tint, buffer, parts)
    cheap, dear = choose(buffer, parts)
    take_fits(grid, bounds.density, scale, depth, buffer, cheap)
    sort_by_length(buffer.parts, dear, buffer.dear)
    cells = exact_segments(grid, scale, nearest, depth, buffer.parts, dear)
    compose(buffer.parts, parts, depth)
    return cells + pick(numbers() == 0, ints(cheap), 0)
