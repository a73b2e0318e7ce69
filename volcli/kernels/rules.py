"""The rules of integration over one segment of a ray: exact and midpoint.

A segment lies in one brick, or in a region of one constant. Each rule returns the new `State` and
the number of cells or samples that it evaluated.
"""

from __future__ import annotations

import math

import numpy as np

from volcli.kernels.cell import absorbed, antiderivative, cubic, integral, load, trilinear
from volcli.kernels.compiler import jit
from volcli.kernels.light import add_spans, faded
from volcli.kernels.source import NOWHERE, WALK, source_at, source_cell
from volcli.kernels.state import State, darken
from volcli.kernels.transfer import linear_piece, transferred
from volcli.kernels.traversal import advance, brick_entry, start_all


@jit
def own_cell(source, entry, x, y, z):
    """(entry, i, j, k): the source's brick and lowest local voxel for the density's brick at
    (x, y, z), if the two share a lattice; else an entry of `NOWHERE`."""
    if source is None:
        return NOWHERE, 0, 0, 0
    i, j, k = x + source.shift[0], y + source.shift[1], z + source.shift[2]
    own = NOWHERE
    if source.same_lattice is not None and entry >= 0:
        own = brick_entry(source.grid, i, j, k)[0]
    return own, i, j, k


@jit
def exact_segment(
    state,
    grid,
    scale,
    entry,
    corner,
    ray,
    t0,
    t1,
    transfer,
    colour,
    emission,
    tint,
    nearest,
    bounds,
    estimate,
    depth,
    path,
    emission_path,
):
    """Walk a segment cell by cell; optical depth is exact in each. A constant is one cell.

    With ``nearest`` a cell has one value. With ``bounds`` the error of its light is added up,
    with ``estimate`` an estimate of it.
    """
    x, y, z = corner
    i, j, k, tx, ty, tz, sx, sy, sz, ddx, ddy, ddz = start_all(ray, t0, x, y, z, 1.0, 8.0)
    dx, dy, dz = ray.d
    if entry < 0:
        i, j, k, tx, ty, tz = 0, 0, 0, math.inf, math.inf, math.inf
    lit = False
    if colour is not None or emission is not None or depth is not None:
        lit = bounds is not None or not faded(state, colour, emission, tint, depth)
    own, cx, cy, cz = own_cell(colour, entry, x, y, z)
    emission_own, ex, ey, ez = own_cell(emission, entry, x, y, z)
    cells = 0
    t = t0
    while True:
        t_exit = min(min(tx, ty), min(tz, t1))
        if t_exit > t:
            cells += 1
            tm = 0.5 * (t + t_exit)
            if entry < 0:
                p = (constant_density(grid, entry, transfer), 0.0, 0.0, 0.0)
            elif nearest is not None:
                value = np.float64(grid.atlas[entry, (i * 9 + j) * 9 + k])
                p = (transferred(transfer, value), 0.0, 0.0, 0.0)
            else:
                px = ray.o[0] + tm * dx - (x + i)
                py = ray.o[1] + tm * dy - (y + j)
                pz = ray.o[2] + tm * dz - (z + k)
                p = cubic(load(grid.atlas, entry, i, j, k), px, py, pz, dx, dy, dz)
            if not lit and transfer is None:
                state = darken(state, scale * integral(p, t_exit - t))
            else:
                state = add_cell(
                    state,
                    p,
                    scale,
                    t,
                    t_exit,
                    transfer,
                    entry < 0 or nearest is not None,
                    colour,
                    emission,
                    tint,
                    nearest,
                    bounds,
                    estimate,
                    depth,
                    lit,
                    (own, cx + i, cy + j, cz + k),
                    path,
                    (emission_own, ex + i, ey + j, ez + k),
                    emission_path,
                )
            t = t_exit
        if t_exit >= t1:
            return state, cells
        i, j, k, tx, ty, tz = advance(i, j, k, tx, ty, tz, sx, sy, sz, ddx, ddy, ddz)
        if (i | j | k) & ~7:
            return state, cells


@jit
def constant_density(grid, entry, transfer):
    """The density where the grid is a constant; 0 where it is nothing at all."""
    if entry == NOWHERE:
        return 0.0
    return transferred(transfer, np.float64(grid.constants[-1 - entry]))


@jit
def add_cell(
    state,
    p,
    scale,
    t0,
    t1,
    transfer,
    settled,
    colour,
    emission,
    tint,
    nearest,
    bounds,
    estimate,
    depth,
    lit,
    own,
    path,
    emission_own,
    emission_path,
):
    """Add [t0, t1], over which ``p`` is the cubic of the grid's values about the middle, to the
    state: piece by piece of the transfer function, if there is one and p is not density already
    (``settled``).

    Unless ``lit``, only its optical depth counts.
    """
    tm = 0.5 * (t0 + t1)
    t = t0
    while t < t1:
        t_exit, q = t1, p
        if transfer is not None and not settled:
            u, q = linear_piece(p, t - tm, t1 - tm, transfer)
            if u < t1 - tm:
                t_exit = max(tm + u, np.nextafter(t, math.inf))
        if lit:
            state = add_spans(
                state,
                q,
                scale,
                tm,
                t,
                t_exit,
                colour,
                emission,
                tint,
                nearest,
                bounds,
                estimate,
                depth,
                own,
                path,
                emission_own,
                emission_path,
            )
        else:
            tau = scale * (antiderivative(q, t_exit - tm) - antiderivative(q, t - tm))
            state = darken(state, max(0.0, tau))
        t = t_exit
    return state


@jit
def value_in(grid, entry, corner, ray, t, nearest):
    """The grid's value at distance t, in a brick with lowest voxel ``corner``."""
    x = ray.o[0] + t * ray.d[0] - corner[0]
    y = ray.o[1] + t * ray.d[1] - corner[1]
    z = ray.o[2] + t * ray.d[2] - corner[2]
    i = min(max(math.floor(x), 0), 7)
    j = min(max(math.floor(y), 0), 7)
    k = min(max(math.floor(z), 0), 7)
    if nearest is not None:
        return np.float64(grid.atlas[entry, (i * 9 + j) * 9 + k])
    return max(0.0, trilinear(load(grid.atlas, entry, i, j, k), x - i, y - j, z - k))


@jit
def midpoint_segment(
    state,
    grid,
    scale,
    entry,
    corner,
    ray,
    t0,
    t1,
    step,
    t_far,
    transfer,
    colour,
    emission,
    tint,
    nearest,
    depth,
    path,
    emission_path,
):
    """The digest's piecewise-constant rule: the samples of the ray that lie in [t0, t1).

    Steps of length ``step`` (world units) begin at t = 0, a sample in the middle of each; the last
    is cut at ``t_far`` and sampled in its own middle.
    """
    last = max(math.ceil(t_far / step) - 1, 0)
    n = min(max(math.ceil(t0 / step - 0.5) - 1, 0), last)
    samples = 0
    while n <= last:
        length = min(step, t_far - n * step)
        t = n * step + 0.5 * length
        n += 1
        if t < t0:
            continue
        if t >= t1:
            break
        samples += 1
        if entry < 0:
            density = constant_density(grid, entry, transfer)
        else:
            density = transferred(transfer, value_in(grid, entry, corner, ray, t, nearest))
        tau = scale * density * length
        if (colour is None and emission is None and depth is None) or faded(
            state, colour, emission, tint, depth
        ):
            state = darken(state, tau)
            continue
        hit = state.T * absorbed(tau)
        _, T, r, g, b, moment, _, error = state
        if colour is not None and hit > 0.0:
            cell = source_cell(colour, WALK, path, t, t_far)[1]
            cr, cg, cb = source_at(colour, nearest, cell, path.ray, t)
            hr, hg, hb = hits(state, tau, hit, tint)
            r += hr * cr
            g += hg * cg
            b += hb * cb
        if emission is not None:
            cell = source_cell(emission, WALK, emission_path, t, t_far)[1]
            er, eg, eb = source_at(emission, nearest, cell, emission_path.ray, t)
            lr, lg, lb = reaches(state, tau, tint)
            r += length * lr * er
            g += length * lg * eg
            b += length * lb * eb
        if depth is not None:
            moment += hit * t
        state = State(state.tau + tau, T - hit, r, g, b, moment, t_far, error)
    return state, samples


@jit
def hits(state, tau, hit, tint):
    """The probability, by channel, of the first hit in a step of optical depth tau."""
    if tint is None:
        return hit, hit, hit
    return (
        math.exp(-tint[0] * state.tau) * absorbed(tint[0] * tau),
        math.exp(-tint[1] * state.tau) * absorbed(tint[1] * tau),
        math.exp(-tint[2] * state.tau) * absorbed(tint[2] * tau),
    )


@jit
def reaches(state, tau, tint):
    """The mean transmittance, by channel, over a step of optical depth tau and constant extinction:
    T (1 - exp(-tau)) / tau."""
    if tint is None:
        mean = state.T * mean_transmittance(tau)
        return mean, mean, mean
    return (
        math.exp(-tint[0] * state.tau) * mean_transmittance(tint[0] * tau),
        math.exp(-tint[1] * state.tau) * mean_transmittance(tint[1] * tau),
        math.exp(-tint[2] * state.tau) * mean_transmittance(tint[2] * tau),
    )


@jit
def mean_transmittance(tau):
    """(1 - exp(-tau)) / tau, 1 at 0."""
    return absorbed(tau) / tau if tau > 0.0 else 1.0
