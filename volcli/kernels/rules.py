"""The rules of integration over one segment of a ray: exact and midpoint.

A segment lies in one brick, or in a region of one constant. Each rule returns the new `State` and
the number of cells or samples that it evaluated.
"""

from __future__ import annotations

import math

import numpy as np

from volcli.kernels.cell import absorbed, cubic, integral, load, trilinear
from volcli.kernels.compiler import jit
from volcli.kernels.source import (
    State,
    add_span,
    add_spans,
    colour_at,
    colour_cell,
    darken,
    faded,
)
from volcli.kernels.traversal import advance, brick_entry, start_all


@jit
def exact_brick(state, grid, scale, brick, corner, ray, t0, t1, colour, nearest, depth, colour_ray):
    """Walk the brick with lowest voxel ``corner`` cell by cell; optical depth is exact in each.

    With ``nearest`` a cell has one value.
    """
    x, y, z = corner
    i, j, k, tx, ty, tz, sx, sy, sz, ddx, ddy, ddz = start_all(ray, t0, x, y, z, 1.0, 8.0)
    dx, dy, dz = ray.d
    lit = (colour is not None or depth is not None) and not faded(state, colour, depth)
    colour_entry, cx, cy, cz = 0, 0, 0, 0
    if colour is not None and colour.same_lattice is not None:
        cx, cy, cz = x + colour.shift[0], y + colour.shift[1], z + colour.shift[2]
        colour_entry = brick_entry(colour.grid, cx, cy, cz)[0]
    cells = 0
    t = t0
    while True:
        t_exit = min(min(tx, ty), min(tz, t1))
        if t_exit > t:
            cells += 1
            tm = 0.5 * (t + t_exit)
            if nearest is not None:
                p = (np.float64(grid.atlas[brick, (i * 9 + j) * 9 + k]), 0.0, 0.0, 0.0)
            else:
                px = ray.o[0] + tm * dx - (x + i)
                py = ray.o[1] + tm * dy - (y + j)
                pz = ray.o[2] + tm * dz - (z + k)
                p = cubic(load(grid.atlas, brick, i, j, k), px, py, pz, dx, dy, dz)
            if not lit:
                state = darken(state, scale * integral(p, t_exit - t))
            elif colour is not None and colour.same_lattice is None:
                state = add_spans(
                    state, p, scale, tm, t, t_exit, colour, nearest, depth, colour_ray
                )
            else:
                cell = (colour_entry, cx + i, cy + j, cz + k)
                state = add_span(
                    state, p, scale, tm, t, t_exit, colour, nearest, depth, cell, colour_ray
                )
            t = t_exit
        if t_exit >= t1:
            return state, cells
        i, j, k, tx, ty, tz = advance(i, j, k, tx, ty, tz, sx, sy, sz, ddx, ddy, ddz)
        if (i | j | k) & ~7:
            return state, cells


@jit
def exact_constant(state, density, scale, t0, t1, colour, nearest, depth, colour_ray):
    """A region of one density, in closed form (where colour varies, a colour cell at a time)."""
    p = (density, 0.0, 0.0, 0.0)
    tm = 0.5 * (t0 + t1)
    if (colour is None and depth is None) or faded(state, colour, depth):
        state = darken(state, scale * density * (t1 - t0))
    elif colour is not None:
        state = add_spans(state, p, scale, tm, t0, t1, colour, nearest, depth, colour_ray)
    else:
        cell = (0, 0, 0, 0)
        state = add_span(state, p, scale, tm, t0, t1, colour, nearest, depth, cell, colour_ray)
    return state, 1


@jit
def density_at(grid, entry, corner, ray, t, nearest):
    """The density at distance t, in a brick with lowest voxel ``corner`` or in a constant."""
    if entry < 0:
        return np.float64(grid.constants[-1 - entry])
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
    colour,
    nearest,
    depth,
    colour_ray,
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
        tau = scale * density_at(grid, entry, corner, ray, t, nearest) * length
        if (colour is None and depth is None) or faded(state, colour, depth):
            state = darken(state, tau)
            continue
        hit = state.T * absorbed(tau)
        _, T, r, g, b, moment, _ = state
        if colour is not None and hit > 0.0:
            cell = colour_cell(colour, colour_ray, t, t_far)[1]
            cr, cg, cb = colour_at(colour, nearest, cell, colour_ray, t)
            r += hit * cr
            g += hit * cg
            b += hit * cb
        if depth is not None:
            moment += hit * t
        state = State(state.tau + tau, T - hit, r, g, b, moment, t_far)
    return state, samples
