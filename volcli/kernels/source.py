"""Sources of colour and of emission: what they are at a point of a ray.

A source is a grid of three channels, or of one and a table of the colours of its values. It may lie
on another lattice than the density.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from volcli.kernels.cell import cubic, trilinear
from volcli.kernels.compiler import jit
from volcli.kernels.crossing import first_crossing
from volcli.kernels.traversal import brick_entry, last_below

NOWHERE = -(2**30)
"""In place of an entry: neither a brick nor a constant, but nothing at all."""

WALK = (NOWHERE, 0, 0, 0)
"""In place of a cell: none that is known beforehand."""


class Table(NamedTuple):
    """The colour of a value: piecewise linear, constant beyond the ends.

    Attributes
    ----------
    knots
        (k,) float64, ascending.
    colours
        (k, 3) float64.
    kinks
        (m,) float64, ascending: values at which the colour turns sharply. Gauss' rule is off across
        them, so spans end there.
    bends
        (k + 1,) float64: 0, then how much the slope has changed up to each knot, that one included,
        all changes counted as positive and each that of the channel where it is largest.
    """

    knots: NDArray[np.float64]
    colours: NDArray[np.float64]
    kinks: NDArray[np.float64]
    bends: NDArray[np.float64]


class Source(NamedTuple):
    """A grid of colour, or of emission, beside a density grid.

    Attributes
    ----------
    grid
        `BrickArrays` with three channels; with a table, with one.
    table
        `Table`, or None.
    scale
        What the channels are multiplied by; None with a table.
    local_from_world
        (3, 4) float64.
    support
        (2, 3) float64, local voxels: the box outside which there is no emission. (Colour is the
        grid's background there.)
    same_lattice
        True, or None when its lattice is another than the density's.
    shift
        (3,) int64: local voxel of this grid minus that of the density; of use on the same lattice
        only.
    brightest
        The largest magnitude of any channel: no light that is still to come is brighter.
    """

    grid: Any
    table: Any
    scale: Any
    local_from_world: NDArray[np.float64]
    support: NDArray[np.float64]
    same_lattice: Any
    shift: NDArray[np.int64]
    brightest: float


class Path(NamedTuple):
    """A ray as a source sees it.

    Attributes
    ----------
    ray
        `traversal.Ray`, in local voxels of the source.
    begin, end
        Distances between which there is a source at all.
    """

    ray: Any
    begin: float
    end: float


@jit
def source_cell(source, own, path, t, t_end):
    """The cell of a source that the ray is in just after t, and where the ray leaves it.

    Returns (t_exit, cell): cell is (entry, i, j, k), a brick and the local voxel of the cell, or a
    constant, and then t_exit is where the ray leaves the cube that it fills; or `NOWHERE`. ``own``
    is the cell that is known to reach up to t_end, or `WALK` if none is.
    """
    if t < path.begin:
        return min(path.begin, t_end), (NOWHERE, 0, 0, 0)
    if t >= path.end:
        return t_end, (NOWHERE, 0, 0, 0)
    t_end = min(path.end, t_end)
    if own[0] != NOWHERE:
        return t_end, own
    i, tx = cell_after(path.ray, 0, t, 1)
    j, ty = cell_after(path.ray, 1, t, 1)
    k, tz = cell_after(path.ray, 2, t, 1)
    entry, width = brick_entry(source.grid, i, j, k)
    if entry < 0:
        tx = cell_after(path.ray, 0, t, width)[1]
        ty = cell_after(path.ray, 1, t, width)[1]
        tz = cell_after(path.ray, 2, t, width)[1]
    return min(min(tx, ty), min(tz, t_end)), (entry, i, j, k)


@jit
def kink_exit(grid, table, nearest, cell, ray, t, t_exit):
    """Where, up to t_exit, a ray in a cell of a source comes to a kink of its table, at the
    latest."""
    if table is not None and nearest is None:
        entry, i, j, k = cell
        if entry >= 0 and len(table.kinks) > 0:
            d = ray.d
            x, y, z = ray.o[0] + t * d[0] - i, ray.o[1] + t * d[1] - j, ray.o[2] + t * d[2] - k
            v = scalars(grid.atlas, entry, ((i & 7) * 9 + (j & 7)) * 9 + (k & 7))
            p = cubic(v, x, y, z, d[0], d[1], d[2])
            to = first_crossing(p, 0.0, t_exit - t, table.kinks)[0]
            if to < t_exit - t:
                return max(t + to, np.nextafter(t, math.inf))
    return t_exit


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
def source_at(source, nearest, cell, ray, t):
    """(r, g, b) at distance t, in a cell (entry, i, j, k) of a source."""
    if cell[0] == NOWHERE:
        return 0.0, 0.0, 0.0
    entry, i, j, k = cell
    first = ((i & 7) * 9 + (j & 7)) * 9 + (k & 7)
    x = ray.o[0] + t * ray.d[0] - i
    y = ray.o[1] + t * ray.d[1] - j
    z = ray.o[2] + t * ray.d[2] - k
    return colour_in(source.grid, source.table, source.scale, nearest, entry, first, x, y, z)


@jit
def colour_in(grid, table, scale, nearest, entry, first, x, y, z):
    """(r, g, b) at (x, y, z) in the cell whose first corner is value ``first`` of a brick, or in a
    constant.

    ``scale`` is None with a table and ``table`` without: numba compiles what an argument that is
    None leaves.
    """
    atlas, constants = grid.atlas, grid.constants
    r = g = b = 0.0
    if table is not None:
        if entry < 0:
            value = np.float64(constants[-1 - entry])
        elif nearest is not None:
            value = np.float64(atlas[entry, first])
        else:
            value = trilinear(scalars(atlas, entry, first), x, y, z)
        r, g, b = table_colour(table, value)
    if scale is not None:
        if entry < 0:
            at = -1 - entry
            r, g, b = constants[at, 0], constants[at, 1], constants[at, 2]
        elif nearest is not None:
            r, g, b = atlas[entry, first, 0], atlas[entry, first, 1], atlas[entry, first, 2]
        else:
            r = channel(atlas, entry, first, 0, x, y, z)
            g = channel(atlas, entry, first, 1, x, y, z)
            b = channel(atlas, entry, first, 2, x, y, z)
        r, g, b = scale * r, scale * g, scale * b
    return r, g, b


@jit
def table_colour(table, value):
    """(r, g, b) of a value."""
    knots, colours = table.knots, table.colours
    low = min(max(last_below(knots, value), 0), len(knots) - 2)
    share = (value - knots[low]) / (knots[low + 1] - knots[low])
    share = min(max(share, 0.0), 1.0)
    return (
        colours[low, 0] + share * (colours[low + 1, 0] - colours[low, 0]),
        colours[low, 1] + share * (colours[low + 1, 1] - colours[low, 1]),
        colours[low, 2] + share * (colours[low + 1, 2] - colours[low, 2]),
    )


@jit
def channel(atlas, brick, b, c, x, y, z):
    """Channel c at (x, y, z) in the cell of a brick whose first corner is value b."""
    return trilinear(channel_values(atlas, brick, b, c), x, y, z)


@jit
def channel_values(atlas, brick, b, c):
    """The corners of the cell of a brick whose first is value b, of channel c."""
    return (
        np.float64(atlas[brick, b, c]),
        np.float64(atlas[brick, b + 1, c]),
        np.float64(atlas[brick, b + 9, c]),
        np.float64(atlas[brick, b + 10, c]),
        np.float64(atlas[brick, b + 81, c]),
        np.float64(atlas[brick, b + 82, c]),
        np.float64(atlas[brick, b + 90, c]),
        np.float64(atlas[brick, b + 91, c]),
    )


@jit
def scalars(atlas, brick, b):
    """The corners of the cell of a brick whose first is value b, in a grid of one channel."""
    return (
        np.float64(atlas[brick, b]),
        np.float64(atlas[brick, b + 1]),
        np.float64(atlas[brick, b + 9]),
        np.float64(atlas[brick, b + 10]),
        np.float64(atlas[brick, b + 81]),
        np.float64(atlas[brick, b + 82]),
        np.float64(atlas[brick, b + 90]),
        np.float64(atlas[brick, b + 91]),
    )
