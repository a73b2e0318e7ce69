"""The loop over packets of rays: `rays`, for scenes without a colour grid, `LANES` rays at once.

A segment of a ray in one brick knows nothing of what lies before it: transmittance is
multiplicative. So a packet takes three passes. `packet_walk` lists the segments of its rays; they
are integrated side by side, a segment a lane, sorted by length so that the lanes finish together;
and each ray is put together from its segments, front to back. What happens in a cell is `cell`'s,
for a register as for a scalar.

A ray's result depends on nothing but the ray: neither on its packet nor on the order of buffer.
"""

from __future__ import annotations

import math

from volcli.kernels.cell import absorbed
from volcli.kernels.compiler import jit, kernel
from volcli.kernels.lane_memory import gather, load, scatter, store
from volcli.kernels.lanes import LANES, any_of, floats, ints, numbers, pick
from volcli.kernels.packet_bounded import bounded_buffer, bounded_segments, error_of
from volcli.kernels.packet_light import light_buffer, light_segments
from volcli.kernels.packet_rules import (
    CORNER_ROW,
    FAR_ROW,
    MOMENT_ROW,
    RED_ROW,
    SLACK_ROW,
    SPEED_ROW,
    STEP_ROW,
    TAU_ROW,
    compose,
    exact_segments,
    make_buffer,
    midpoint_segments,
    sort_by_length,
)
from volcli.kernels.packet_walk import (
    ROOM,
    absolute,
    clip_axis,
    enter,
    make_rays,
    root_cell,
    root_next,
    root_planes,
    root_segments,
)
from volcli.kernels.traversal import straight


def packet_buffer(bounds, colour):
    """Room for the work of one thread: (`packet_walk.Buffer`, `packet_bounded.BoundedBuffer`,
    `packet_light.LightBuffer`), None for what has no work."""
    buffer = make_buffer(ROOM)
    return (
        buffer,
        None if bounds is None else bounded_buffer(buffer),
        None if colour is None else light_buffer(),
    )


@jit
def keep(buffer, row, values):
    """Put down a number of each ray."""
    store(buffer.rays, row * LANES, values)


@jit
def keep_vector(buffer, row, vector):
    """Put down three."""
    keep(buffer, row, vector[0])
    keep(buffer, row + 1, vector[1])
    keep(buffer, row + 2, vector[2])


@jit
def to_local(m, vectors, row, mask, w):
    """`rays.to_local`, for each lane its own row."""
    x = gather(vectors, row * 3, mask)
    y = gather(vectors, row * 3 + 1, mask)
    z = gather(vectors, row * 3 + 2, mask)
    return (
        m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3] * w,
        m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3] * w,
        m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3] * w,
    )


@jit
def packet(
    rays,
    t_far,
    alive,
    density,
    colour,
    step,
    nearest,
    bounds,
    tint,
    depth,
    skip_background,
    buffer,
    more,
    lit,
):
    """Integrate the rays of a packet, from where they enter the volume; returns cells, INTS.

    What becomes of them stands in the buffer's rows of sums.
    """
    grid = density.grid
    evaluated = ints(0)
    keep_vector(buffer, 0, rays.o)
    keep_vector(buffer, 3, rays.d)
    keep_vector(buffer, 6, rays.inverse)
    keep(buffer, FAR_ROW, t_far)
    speed = absolute(rays.d[0]) + absolute(rays.d[1]) + absolute(rays.d[2])
    keep(buffer, SPEED_ROW, speed)
    keep(buffer, STEP_ROW, speed if step is None else step)
    keep(buffer, TAU_ROW, floats(0.0))
    keep(buffer, MOMENT_ROW, floats(0.0))
    keep(buffer, SLACK_ROW, floats(0.0))
    if colour is not None:
        zero = floats(0.0)
        keep_vector(buffer, RED_ROW, (zero, zero, zero))
    at = enter(grid, rays, alive)
    t = floats(0.0)
    while any_of(alive):
        planes = root_planes(grid, rays, at, alive)
        t_exit = min(min(planes[0], planes[1]), min(planes[2], t_far))
        entry, corner = root_cell(grid, at, alive)
        met = alive & (t_exit > t)
        total = root_segments(grid, skip_background, rays, entry, corner, t, t_exit, met, buffer)
        if total > 0:
            keep_vector(buffer, CORNER_ROW, corner)
            if bounds is not None:
                cells = bounded_segments(
                    grid,
                    bounds,
                    density.scale,
                    nearest,
                    depth,
                    tint,
                    t,
                    t_exit,
                    buffer,
                    more,
                    total,
                )
            elif colour is not None:
                cells = light_segments(
                    grid, colour, density.scale, nearest, depth, buffer, lit, total
                )
            else:
                sort_by_length(buffer, total)
                if step is not None:
                    cells = midpoint_segments(grid, density.scale, nearest, depth, buffer, total)
                else:
                    cells = exact_segments(grid, density.scale, nearest, depth, buffer, total)
                compose(buffer, total, depth)
            evaluated = evaluated + cells
        t = max(t, t_exit)
        at, known = root_next(grid, rays, at, planes)
        alive = alive & known & (t < t_far)
    return evaluated


@jit
def write_errors(buffer, tint, first, error):
    """Write what the rays of a packet, ``first`` and following, are off by at most."""
    for lane in range(min(LANES, len(error) - first)):
        tau = buffer.rays[TAU_ROW * LANES + lane]
        error[first + lane] = error_of(tau, buffer.rays[SLACK_ROW * LANES + lane], tint)


@kernel
def integrate_packets(
    origins,
    directions,
    density,
    colour,
    step_voxels,
    nearest,
    bounds,
    tint,
    depth,
    error,
    optical_depth,
    radiance,
    buffer,
    more,
    lit,
):
    """Integrate a batch of rays; parameters and result are those of `rays.integrate_rays`, whose
    terms that are missing here are out.

    ``buffer``, ``more`` and ``lit`` are a `packet_buffer`.
    """
    skip_background = density.skip_background
    m, box = density.local_from_world, density.support
    shift = 0.0 if nearest is None else 0.5
    evaluated = ints(0)
    for first in range(0, len(origins), LANES):
        row = numbers() + first
        here = row < len(origins)
        eye = to_local(m, origins, row, here, 1.0)
        d = straight(to_local(m, directions, row, here, 0.0))
        t_near, t_far = floats(0.0), floats(math.inf)
        t_near, t_far = clip_axis(box[0, 0], box[1, 0], eye[0], d[0], t_near, t_far)
        t_near, t_far = clip_axis(box[0, 1], box[1, 1], eye[1], d[1], t_near, t_far)
        t_near, t_far = clip_axis(box[0, 2], box[1, 2], eye[2], d[2], t_near, t_far)
        alive = here & (t_near < t_far)
        tau, distance = floats(0.0), floats(math.inf)
        if any_of(alive):
            t_near = pick(alive, t_near, 0.0)
            start = (
                eye[0] + t_near * d[0] + shift,
                eye[1] + t_near * d[1] + shift,
                eye[2] + t_near * d[2] + shift,
            )
            rays = make_rays(start, d, (1.0 / d[0], 1.0 / d[1], 1.0 / d[2]))
            step = None
            if step_voxels is not None:
                step = step_voxels / math.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
            evaluated = evaluated + packet(
                rays,
                t_far - t_near,
                alive,
                density,
                colour,
                step,
                nearest,
                bounds,
                tint,
                depth,
                skip_background,
                buffer,
                more,
                lit,
            )
            tau = load(buffer.rays, TAU_ROW * LANES)
            if depth is not None:
                hit = absorbed(tau)
                some = hit > 0.0
                moment = load(buffer.rays, MOMENT_ROW * LANES)
                distance = pick(some, t_near + moment / pick(some, hit, 1.0), distance)
            if bounds is not None:
                write_errors(buffer, tint, first, error)
            if colour is not None:
                scatter(radiance, row * 3, load(buffer.rays, RED_ROW * LANES), here)
                scatter(radiance, row * 3 + 1, load(buffer.rays, (RED_ROW + 1) * LANES), here)
                scatter(radiance, row * 3 + 2, load(buffer.rays, (RED_ROW + 2) * LANES), here)
        scatter(optical_depth, row, tau, here)
        if depth is not None:
            scatter(depth, row, distance, here)
    store(buffer.content, 0, evaluated)
    cells = 0
    for lane in range(LANES):
        cells += buffer.content[lane]
    return cells
