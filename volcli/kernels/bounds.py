"""What is known of a brick and of its octants as a whole: a linear fit, and how far off it is;
and where in a brick there is anything at all.

A region is a brick (8 cells an edge) or one of its octants (4); ``REGIONS`` of them belong to a
brick: the brick itself, then the octants, the z half fastest. Over a region the field is close to

    a + g (x - m)        m: the region's middle, x and m in voxels

and nowhere farther from it than r. In each cell, field less fit is trilinear, for a linear function
is trilinear as well; so it is largest at a corner of a cell, and to have looked at all lattice
points of the region, those on its far faces included, is a proof. With ``nearest`` a cell has one
value, a is constant, and all cells were looked at.

a, g and r are float32; r is taken after a and g were rounded, and rounded upwards.

The **box** of a brick holds all its cells that are not 0 throughout: outside of it a ray has
nothing to add up. Its least and largest corners, 0 to 8, take four bits each.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from volcli.kernels.compiler import jit, kernel

REGIONS = 9
FIT = 5
"""Numbers of a fit: a, gx, gy, gz, r."""

UPWARDS = 1.0 + 2.0**-22
"""Makes up for rounding to float32, and more."""

SMALLEST = 2.0**-149
"""The smallest number of float32: what an r that is not 0 may not be rounded below."""


class Bounds(NamedTuple):
    """What the rules may use in place of cells, and the error that they may make with it.

    Attributes
    ----------
    density
        (n, REGIONS, FIT) float32: of each brick of the density's atlas; under a transfer function
        of densities, not of the grid's values.
    least, finest
        (n,) float32: the least value of each brick, and the smallest r of its octants; None under a
        transfer function.
    boxes
        (n,) int32: `pack_box`; None as above.
    colour, emission
        (m, REGIONS, 2, 3) float32: the least and the largest of each channel in each region of the
        bricks of the source, scale and table applied; None where there is no such source.
    max_error
        The error of transmittance, and of radiance as a share of ``brightest``, that is allowed.
    brightest
        The light that errors of radiance are measured by: the largest that the scene can show.
    contrast
        The difference between any two radiances that the scene can show, as a share of that at
        most: 1, or up to 2 where some are negative.
    """

    density: NDArray[np.float32]
    least: NDArray[np.float32] | None
    finest: NDArray[np.float32] | None
    boxes: NDArray[np.int32] | None
    colour: NDArray[np.float32] | None
    emission: NDArray[np.float32] | None
    max_error: float
    brightest: float
    contrast: float


@jit
def region_of(number):
    """(first lattice point x, y, z; cells an edge) of a region of a brick."""
    if number == 0:
        return 0, 0, 0, 8
    octant = number - 1
    return (octant >> 2) * 4, (octant >> 1 & 1) * 4, (octant & 1) * 4, 4


@jit
def fit_region(values, number, nearest, fit):
    """Write the fit of one region of a brick, whose 729 values are ``values``."""
    x, y, z, width = region_of(number)
    points = width if nearest else width + 1
    middle = 0.5 * width
    total = sx = sy = sz = 0.0
    low, high = np.inf, -np.inf
    for i in range(points):
        for j in range(points):
            row = ((x + i) * 9 + y + j) * 9 + z
            across = along = 0.0
            for k in range(points):
                value = np.float64(values[row + k])
                across += value
                along += value * (k - middle)
                low, high = min(low, value), max(high, value)
            total += across
            sx += across * (i - middle)
            sy += across * (j - middle)
            sz += along
    gx = gy = gz = 0.0
    if not nearest and low < high:
        # Least squares on a lattice that is symmetric about its middle: each slope by itself.
        spread = points * points * width * (width + 1) * (width + 2) / 12.0
        gx = np.float64(np.float32(sx / spread))
        gy = np.float64(np.float32(sy / spread))
        gz = np.float64(np.float32(sz / spread))
        low, high = np.inf, -np.inf
        for i in range(points):
            for j in range(points):
                row = ((x + i) * 9 + y + j) * 9 + z
                flat = gx * (i - middle) + gy * (j - middle)
                for k in range(points):
                    off = np.float64(values[row + k]) - (flat + gz * (k - middle))
                    low, high = min(low, off), max(high, off)
    a = np.float64(np.float32(0.5 * (low + high)))
    r = max(high - a, a - low)
    fit[0], fit[1], fit[2], fit[3] = a, gx, gy, gz
    fit[4] = max(r * UPWARDS, SMALLEST) if r > 0.0 else 0.0


@jit
def outline_brick(values, nearest):
    """(least value, `pack_box`) of a brick."""
    least = np.inf
    reach = 0 if nearest else 1  # the cells that a value touches
    lx = ly = lz = 8
    hx = hy = hz = 0
    points = 8 if nearest else 9
    for i in range(points):
        for j in range(points):
            for k in range(points):
                value = np.float64(values[(i * 9 + j) * 9 + k])
                least = min(least, value)
                if value != 0.0:
                    lx, hx = min(lx, max(i - reach, 0)), max(hx, min(i + 1, 8))
                    ly, hy = min(ly, max(j - reach, 0)), max(hy, min(j + 1, 8))
                    lz, hz = min(lz, max(k - reach, 0)), max(hz, min(k + 1, 8))
    return least, pack_box(min(lx, hx), min(ly, hy), min(lz, hz), hx, hy, hz)


@jit
def pack_box(lx, ly, lz, hx, hy, hz):
    """A box as one number; its corners count cells from the brick's lowest."""
    return lx | ly << 4 | lz << 8 | hx << 12 | hy << 16 | hz << 20


@kernel
def fit_bricks(atlas, nearest, fits, least, finest, boxes):
    """Write what is known of bricks.

    Parameters
    ----------
    atlas
        (n, 729) float32.
    nearest
        Whether values are those of cells.
    fits
        (n, REGIONS, FIT) float32, to be filled.
    least, finest, boxes
        (n,) float32, (n,) float32 and (n,) int32, to be filled.
    """
    for brick in range(len(atlas)):
        for number in range(REGIONS):
            fit_region(atlas[brick], number, nearest, fits[brick, number])
        finest[brick] = fits[brick, 1, 4]
        for octant in range(2, REGIONS):
            finest[brick] = min(finest[brick], fits[brick, octant, 4])
        least[brick], boxes[brick] = outline_brick(atlas[brick], nearest)
