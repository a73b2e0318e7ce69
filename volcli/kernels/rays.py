"""The loop over rays: world rays in; optical depth, radiance and hit distance out.

One call does a batch of rays, without the interpreter lock, on arrays that the caller owns; the
caller shares batches out among threads. A ray's result depends on nothing but the ray, so images
are the same bit by bit for any number of threads.

A term that a scene does not use is None (``transfer``, ``colour``, ``emission``, ``tint``,
``depth``, ``step``, ``nearest``, ``bounds``, ``estimate``): numba compiles a version of the loop
without it.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from volcli.kernels.bounded import bounded_segment, spend_rest
from volcli.kernels.compiler import jit, kernel
from volcli.kernels.light import FADED, brightest_channel, faded_out
from volcli.kernels.rules import exact_segment, midpoint_segment
from volcli.kernels.source import NOWHERE, Path
from volcli.kernels.state import State, refresh
from volcli.kernels.traversal import (
    clip,
    enter,
    inside,
    make_ray,
    put,
    root_cell,
    root_exit,
    root_next,
    root_segments,
    straight,
)


class Density(NamedTuple):
    """The density that rays cross.

    Attributes
    ----------
    grid
        `BrickArrays` with one channel; values >= 0, but where there is a transfer function.
    local_from_world
        (3, 4) float64.
    support
        (2, 3) float64, local voxels: the box outside which nothing is integrated.
    scale
        Extinction per unit of density, 1 / world unit.
    skip_background
        Whether there is nothing where the grid is its background.
    """

    grid: Any
    local_from_world: NDArray[np.float64]
    support: NDArray[np.float64]
    scale: float
    skip_background: bool


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


@jit
def clip_to(box, o, d):
    """`traversal.clip` to a box (2, 3); an interval that is empty is (inf, -inf)."""
    lo, hi = (box[0, 0], box[0, 1], box[0, 2]), (box[1, 0], box[1, 1], box[1, 2])
    t_near, t_far = clip(lo, hi, o, d)
    if t_near < t_far:
        return t_near, t_far
    return math.inf, -math.inf


@jit
def path_of(source, origins, directions, n, t_start, shift, everywhere):
    """`Path` of ray n through a source, distances counted from t_start."""
    o = to_local(source.local_from_world, origins, n, 1.0)
    d = straight(to_local(source.local_from_world, directions, n, 0.0))
    ray = make_ray(move(o, d, t_start, shift), d)
    if everywhere:
        return Path(ray, -math.inf, math.inf)
    begin, end = clip_to(source.support, o, d)
    return Path(ray, begin - t_start, end - t_start)


@jit
def add_segment(
    state,
    faded,
    density,
    entry,
    corner,
    ray,
    t0,
    t1,
    step,
    step_voxels,
    t_far,
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
    """Add one segment by the rule that was asked for: (state, evaluated)."""
    grid, scale = density.grid, density.scale
    if colour is not None or emission is not None or depth is not None or bounds is not None:
        state = refresh(state)
    if bounds is not None:
        return bounded_segment(
            state,
            faded,
            density,
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
            depth,
            path,
            emission_path,
        )
    if step_voxels is not None:
        return midpoint_segment(
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
        )
    return exact_segment(
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
    )


@kernel
def integrate_rays(
    origins,
    directions,
    density,
    transfer,
    colour,
    emission,
    tint,
    step_voxels,
    nearest,
    bounds,
    estimate,
    depth,
    error,
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
    transfer
        `transfer.Transfer`, density by the grid's value; or None: the value itself.
    colour
        `source.Source`, or None: a constant colour needs no walk.
    emission
        `source.Source`, radiance per world unit; or None.
    tint
        (r, g, b) that extinction is multiplied by for each channel's light; or None.
    step_voxels
        Length of a step of the midpoint rule, in voxels; None: the exact rule.
    nearest
        True for nearest-voxel interpolation of all grids, None for trilinear.
    bounds
        `bounds.Bounds`: what may be used in place of cells, and the error that this may make; None
        for a rule that certifies nothing.
    estimate
        True for an estimate of what the exact rule is off by; else None.
    depth
        (n,) float64, written: the expected distance to a hit, +inf where nothing can be hit; or
        None. A tint has no part in it.
    error
        (n,) float64, written with bounds: what transmittance (of any channel), and radiance as a
        share of the brightest, is off by at most, but for rounding; with ``estimate`` what radiance
        is estimated to be off by; else None.
    optical_depth
        (n,) float64, written: without the tint.
    radiance
        (n, 3) float64, written where there is colour or emission; else left alone.
    buffer
        `traversal.segment_buffer`, room for the work of one thread.

    Returns
    -------
    Cells (or samples, for the midpoint rule) evaluated; a part taken as a whole counts as one.
    """
    grid = density.grid
    # With nearest, voxel (i, j, k) is the unit cube around its lattice point: half a voxel's
    # shift makes it the cell (i, j, k).
    shift = 0.0 if nearest is None else 0.5
    evaluated = 0
    for n in range(len(origins)):
        eye = to_local(density.local_from_world, origins, n, 1.0)
        d = straight(to_local(density.local_from_world, directions, n, 0.0))
        begin, end = clip_to(density.support, eye, d)
        t_near, t_far = begin, end
        if emission is not None:
            o = to_local(emission.local_from_world, origins, n, 1.0)
            to = straight(to_local(emission.local_from_world, directions, n, 0.0))
            emission_begin, emission_end = clip_to(emission.support, o, to)
            t_near, t_far = min(t_near, emission_begin), max(t_far, emission_end)
        state = State(0.0, 1.0, 0.0, 0.0, 0.0, 0.0, t_far - t_near, 0.0)
        faded = False
        if t_near < t_far:
            t_far -= t_near
            begin = min(begin - t_near, t_far)
            ray = make_ray(move(eye, d, t_near, shift), d)
            path = emission_path = Path(ray, -math.inf, math.inf)
            if colour is not None:
                path = path_of(colour, origins, directions, n, t_near, shift, True)
            if emission is not None:
                emission_path = path_of(emission, origins, directions, n, t_near, shift, False)
            step = 0.0
            if step_voxels is not None:
                step = step_voxels / math.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])

            t = 0.0
            end = max(end - t_near, begin)
            at = enter(grid, move(ray.o, d, begin, 0.0), d)
            while t < t_far:
                buffer.used[0] = 0
                if t < begin:  # before the density's box there is emission at most
                    put(buffer, t, begin, NOWHERE, 0, 0, 0)
                    t = begin
                elif t < end and inside(grid, at):
                    t_exit, axis = root_exit(grid, ray, at)
                    t_exit = min(t_exit, end)
                    if t_exit > t:
                        entry, corner = root_cell(grid, at)
                        skip = density.skip_background
                        root_segments(grid, skip, entry, corner, ray, t, t_exit, buffer)
                        t = t_exit
                    at = root_next(ray, at, axis)
                else:  # and so behind it
                    if emission is not None:
                        put(buffer, t, t_far, NOWHERE, 0, 0, 0)
                    t = t_far
                for s in range(buffer.used[0]):
                    if bounds is not None:
                        state, faded = spend_rest(state, faded, tint, bounds)
                    state, cells = add_segment(
                        state,
                        faded,
                        density,
                        int(buffer.entries[s]),
                        (buffer.corners[s, 0], buffer.corners[s, 1], buffer.corners[s, 2]),
                        ray,
                        buffer.times[s, 0],
                        buffer.times[s, 1],
                        step,
                        step_voxels,
                        t_far,
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
                    )
                    evaluated += cells

        optical_depth[n] = state.tau
        if colour is not None or emission is not None:
            radiance[n, 0] = state.r
            radiance[n, 1] = state.g
            radiance[n, 2] = state.b
        if error is not None:
            error[n] = state.error
            if estimate is not None and faded_out(state, tint):
                error[n] += FADED * brightest_channel(state)
        if depth is not None:
            hit = -math.expm1(-state.tau)
            depth[n] = t_near + state.moment / hit if hit > 0.0 else math.inf
    return evaluated
