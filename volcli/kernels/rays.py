"""The loop over rays: world rays in; optical depth, radiance and hit distance out.

One call does a batch of rays, without the interpreter lock, on arrays that the caller owns; the
caller shares batches out among threads. A ray's result depends on nothing but the ray, so images
are the same bit by bit for any number of threads.

A term that a scene does not use is None (``colour``, ``depth``, ``step``, ``nearest``): numba
compiles a version of the loop without it.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from volcli.kernels.compiler import jit, kernel
from volcli.kernels.rules import exact_brick, exact_constant, midpoint_segment
from volcli.kernels.source import State, refresh
from volcli.kernels.traversal import (
    clip,
    enter,
    inside,
    make_ray,
    root_cell,
    root_exit,
    root_next,
    root_segments,
)


class Density(NamedTuple):
    """The density that rays cross.

    Attributes
    ----------
    grid
        `BrickArrays` with one channel, values >= 0.
    local_from_world
        (3, 4) float64.
    support
        (2, 3) float64, local voxels: the box outside which nothing is integrated.
    scale
        Extinction per unit of density, 1 / world unit.
    """

    grid: Any
    local_from_world: NDArray[np.float64]
    support: NDArray[np.float64]
    scale: float


@jit
def to_local(m, vectors, n, w):
    """The affine matrix m (3, 4) on vector n: a point (w = 1) or a direction (w = 0)."""
    x, y, z = vectors[n, 0], vectors[n, 1], vectors[n, 2]
    return (
        m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3] * w,
        m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3] * w,
        m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3] * w,
    )


@jit
def move(o, d, t, shift):
    """The point o + t d, moved by ``shift`` voxels along each axis."""
    return o[0] + t * d[0] + shift, o[1] + t * d[1] + shift, o[2] + t * d[2] + shift


@kernel
def integrate_rays(
    origins,
    directions,
    density,
    colour,
    step_voxels,
    nearest,
    depth,
    optical_depth,
    radiance,
    buffer,
):
    """Integrate a batch of rays.

    Parameters
    ----------
    origins, directions
        (n, 3) float64, world units; directions have length 1.
    density
        `Density`.
    colour
        `source.Colour`, or None: radiance is then left alone (a constant colour needs no walk).
    step_voxels
        Length of a step of the midpoint rule, in voxels; None: the exact rule.
    nearest
        True for nearest-voxel interpolation of density and colour, None for trilinear.
    depth
        (n,) float64, written: the expected distance to a hit, +inf where nothing can be hit; or
        None.
    optical_depth, radiance
        (n,) and (n, 3) float64, written.
    buffer
        `traversal.segment_buffer`, room for the work of one thread.

    Returns
    -------
    Cells (or samples, for the midpoint rule) evaluated.
    """
    grid = density.grid
    skip_background = grid.constants[0] == 0.0
    box = density.support
    lo, hi = (box[0, 0], box[0, 1], box[0, 2]), (box[1, 0], box[1, 1], box[1, 2])
    # With nearest, voxel (i, j, k) is the unit cube around its lattice point: half a voxel's
    # shift makes it the cell (i, j, k).
    shift = 0.0 if nearest is None else 0.5
    evaluated = 0
    for n in range(len(origins)):
        eye = to_local(density.local_from_world, origins, n, 1.0)
        d = to_local(density.local_from_world, directions, n, 0.0)
        t_near, t_far = clip(lo, hi, eye, d)
        ray = make_ray(move(eye, d, t_near, shift), d)
        t_far -= t_near
        colour_ray = ray
        if colour is not None:
            colour_d = to_local(colour.local_from_world, directions, n, 0.0)
            eye = to_local(colour.local_from_world, origins, n, 1.0)
            colour_ray = make_ray(move(eye, colour_d, t_near, shift), colour_d)
        step = 0.0
        if step_voxels is not None:
            step = step_voxels / math.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])

        state = State(0.0, 1.0, 0.0, 0.0, 0.0, 0.0, t_far)
        at = enter(grid, ray)
        t = 0.0
        while t < t_far and inside(grid, at):
            t_exit, axis = root_exit(grid, ray, at)
            t_exit = min(t_exit, t_far)
            buffer.used[0] = 0
            if t_exit > t:
                entry, corner = root_cell(grid, at)
                root_segments(grid, skip_background, entry, corner, ray, t, t_exit, buffer)
                t = t_exit
            for s in range(buffer.used[0]):
                t0, t1 = buffer.times[s, 0], buffer.times[s, 1]
                entry = int(buffer.entries[s])
                corner = (buffer.corners[s, 0], buffer.corners[s, 1], buffer.corners[s, 2])
                if colour is not None or depth is not None:
                    state = refresh(state)
                if step_voxels is not None:
                    state, cells = midpoint_segment(
                        state,
                        grid,
                        density.scale,
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
                    )
                elif entry < 0:
                    value = np.float64(grid.constants[-1 - entry])
                    state, cells = exact_constant(
                        state,
                        value,
                        density.scale,
                        t0,
                        t1,
                        colour,
                        nearest,
                        depth,
                        colour_ray,
                    )
                else:
                    state, cells = exact_brick(
                        state,
                        grid,
                        density.scale,
                        entry,
                        corner,
                        ray,
                        t0,
                        t1,
                        colour,
                        nearest,
                        depth,
                        colour_ray,
                    )
                evaluated += cells
            at = root_next(ray, at, axis)

        optical_depth[n] = state.tau
        if colour is not None:
            radiance[n, 0] = state.r
            radiance[n, 1] = state.g
            radiance[n, 2] = state.b
        if depth is not None:
            hit = -math.expm1(-state.tau)
            depth[n] = t_near + state.moment / hit if hit > 0.0 else math.inf
    return evaluated
