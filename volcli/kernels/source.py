"""What a ray sees of a source of radiance: spans of the ray, sampled and weighted.

A span is a part of the ray over which density is one cubic and colour is one cell of its own
lattice. Each span adds ``T (1 - exp(-tau)) sum_i w_i c(t_i)``, with the weights of
`cell.hit_weights`; the expected hit distance is the same sum with c = t. The colour grid may lie on
another lattice than the density: then a density cell is cut where the ray crosses the planes of
that lattice, and the rule keeps its order.

``colour`` and ``depth`` are None where the scene has no such term; numba compiles a version without
it.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from volcli.kernels.cell import (
    MAX_TAU,
    SHORTEST,
    absorbed,
    antiderivative,
    hit_weights,
    trilinear,
)
from volcli.kernels.compiler import jit
from volcli.kernels.traversal import brick_entry

FADED = 2.0**-24
"""What is less than this part of a number cannot change it in float32."""

STOP_TAU = -math.log(FADED)
"""The optical depth beyond which T < FADED."""


class State(NamedTuple):
    """What is known of a ray up to some distance.

    Attributes
    ----------
    tau
        Optical depth.
    T
        Transmittance, exp(-tau): kept up within a brick, taken afresh from tau at the next.
    r, g, b
        Radiance.
    moment
        The integral of t T sigma dt, for the expected hit distance.
    t_far
        Where the ray leaves the volume: no hit is farther.
    """

    tau: float
    T: float
    r: float
    g: float
    b: float
    moment: float
    t_far: float


class Colour(NamedTuple):
    """A colour grid beside a density grid.

    Attributes
    ----------
    grid
        `BrickArrays` with three channels.
    local_from_world
        (3, 4) float64.
    same_lattice
        True, or None when its lattice is another than the density's.
    shift
        (3,) int64: local voxel of the colour grid minus that of the density; of use on the same
        lattice only.
    brightest
        The largest magnitude in the grid: no light that is still to come is brighter.
    """

    grid: Any
    local_from_world: NDArray[np.float64]
    same_lattice: Any
    shift: NDArray[np.int64]
    brightest: float


@jit
def colour_cell(colour, ray, t, t_end):
    """The colour cell that the ray is in just after t, and where the ray leaves it.

    Returns (t_exit, cell): cell is (entry, i, j, k), a brick and the local voxel of the cell, or a
    constant, and then t_exit is where the ray leaves the cube that it fills. ``ray`` is in voxels
    of the colour grid.
    """
    i, tx = cell_after(ray, 0, t, 1)
    j, ty = cell_after(ray, 1, t, 1)
    k, tz = cell_after(ray, 2, t, 1)
    entry, width = brick_entry(colour.grid, i, j, k)
    if entry < 0:
        tx = cell_after(ray, 0, t, width)[1]
        ty = cell_after(ray, 1, t, width)[1]
        tz = cell_after(ray, 2, t, width)[1]
    return min(min(tx, ty), min(tz, t_end)), (entry, i, j, k)


@jit
def cell_after(ray, axis, t, width):
    """(lowest voxel of the aligned cell just after t, where it ends), along one axis."""
    o, d, inverse = ray.o[axis], ray.d[axis], ray.inverse[axis]
    crossed = t + 1e-13 * max(abs(width * inverse), t)  # a plane nearer than this is behind us
    cell = math.floor((o + t * d) / width)
    if d > 0.0:
        end = ((cell + 1) * width - o) * inverse
        if end <= crossed:
            cell += 1
            end = ((cell + 1) * width - o) * inverse
        return cell * width, end
    if d < 0.0:
        end = (cell * width - o) * inverse
        if end <= crossed:
            cell -= 1
            end = (cell * width - o) * inverse
        return cell * width, end
    return cell * width, math.inf


@jit
def colour_at(colour, nearest, cell, ray, t):
    """(r, g, b) at distance t, in a cell (entry, i, j, k) of the colour grid."""
    entry, i, j, k = cell
    if entry < 0:
        constants = colour.grid.constants
        at = -1 - entry
        return (
            np.float64(constants[at, 0]),
            np.float64(constants[at, 1]),
            np.float64(constants[at, 2]),
        )
    atlas = colour.grid.atlas
    b = ((i & 7) * 9 + (j & 7)) * 9 + (k & 7)
    if nearest is not None:
        return (
            np.float64(atlas[entry, b, 0]),
            np.float64(atlas[entry, b, 1]),
            np.float64(atlas[entry, b, 2]),
        )
    x = ray.o[0] + t * ray.d[0] - i
    y = ray.o[1] + t * ray.d[1] - j
    z = ray.o[2] + t * ray.d[2] - k
    return (
        channel(atlas, entry, b, 0, x, y, z),
        channel(atlas, entry, b, 1, x, y, z),
        channel(atlas, entry, b, 2, x, y, z),
    )


@jit
def channel(atlas, brick, b, c, x, y, z):
    """Channel c at (x, y, z) in the cell of a brick whose first corner is value b."""
    v = (
        np.float64(atlas[brick, b, c]),
        np.float64(atlas[brick, b + 1, c]),
        np.float64(atlas[brick, b + 9, c]),
        np.float64(atlas[brick, b + 10, c]),
        np.float64(atlas[brick, b + 81, c]),
        np.float64(atlas[brick, b + 82, c]),
        np.float64(atlas[brick, b + 90, c]),
        np.float64(atlas[brick, b + 91, c]),
    )
    return trilinear(v, x, y, z)


@jit
def add_span(state, p, scale, tm, t0, t1, colour, nearest, depth, cell, ray):
    """Add the light of [t0, t1] to the state.

    ``p`` is the density's cubic about the distance ``tm``; ``cell`` is the colour's, and ``ray`` is
    in voxels of the colour grid. A span of optical depth above `MAX_TAU` is added in parts, each
    half or twice as long as the one before, or the same, so that none is above.
    """
    u, end = t0 - tm, t1 - tm
    begin = antiderivative(p, u)
    whole = max(0.0, scale * (antiderivative(p, end) - begin))
    if whole <= 0.0:
        return state
    _, T, r, g, b, moment, t_far = state
    shortest = (end - u) * SHORTEST
    length = end - u
    tau = state.tau
    while u < end:
        to = min(u + length, end)
        if scale * (antiderivative(p, to) - begin) > MAX_TAU and length > shortest:
            length *= 0.5
            continue
        part, at, w = hit_weights(p, scale, u, to)
        hit = T * absorbed(part)
        T -= hit
        if colour is not None:
            for n in range(4):
                cr, cg, cb = colour_at(colour, nearest, cell, ray, tm + at[n])
                r += hit * w[n] * cr
                g += hit * w[n] * cg
                b += hit * w[n] * cb
        if depth is not None:
            mean = at[0] * w[0] + at[1] * w[1] + at[2] * w[2] + at[3] * w[3]
            moment += hit * (tm + mean)
        tau += part
        if faded(State(tau, T, r, g, b, moment, t_far), colour, depth):
            break
        u = to
        begin = antiderivative(p, u)
        length *= 2.0
    return State(state.tau + whole, T, r, g, b, moment, t_far)


@jit
def add_spans(state, p, scale, tm, t0, t1, colour, nearest, depth, ray):
    """As `add_span`, cut where the ray crosses the planes of the colour's own lattice."""
    t = t0
    while t < t1:
        if faded(state, colour, depth):
            rest = antiderivative(p, t1 - tm) - antiderivative(p, t - tm)
            return darken(state, max(0.0, scale * rest))
        t_exit, cell = colour_cell(colour, ray, t, t1)
        state = add_span(state, p, scale, tm, t, t_exit, colour, nearest, depth, cell, ray)
        t = t_exit
    return state


@jit
def faded(state, colour, depth):
    """Whether light that is still to come is less than 2^-24 of what the ray's brightest channel
    has seen (and distance likewise): then only optical depth goes on.

    T alone does not tell: what is behind may be brighter than what is in front.
    """
    if state.tau <= STOP_TAU:
        return False
    T = math.exp(-state.tau)
    if colour is not None:
        seen = max(abs(state.r), max(abs(state.g), abs(state.b)))
        if T * colour.brightest > FADED * seen:
            return False
    return depth is None or T * state.t_far <= FADED * state.moment


@jit
def darken(state, tau):
    """The state after an optical depth of tau whose light is not asked for, or too weak to count.

    T is left behind: it is taken afresh from tau before it is used again.
    """
    return State(state.tau + tau, state.T, state.r, state.g, state.b, state.moment, state.t_far)


@jit
def refresh(state):
    """The state with T taken from tau, so that no product of many factors builds up."""
    return State(
        state.tau,
        math.exp(-state.tau),
        state.r,
        state.g,
        state.b,
        state.moment,
        state.t_far,
    )
