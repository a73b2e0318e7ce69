"""The mathematics of one cell: what a ray sees between eight lattice points.

Letters, used by all kernels:

    v      the eight corner values, v001 at +z; density, not yet scaled
    x,y,z  a position in the cell, 0 to 1 each
    d      direction, in voxels per world unit of distance
    u      distance along the ray from the middle of the cell, world units
    p      coefficients of density along the ray: p0 + p1 u + p2 u^2 + p3 u^3
    tau    optical depth; T = exp(-tau)

A trilinear function along a straight line is a cubic, so its integral is exact from p0 and p2 alone
(the odd terms cancel about the middle). Functions here allocate nothing, and know neither grids nor
images. They take scalars, or registers of `lanes` in place of any float.
"""

from __future__ import annotations

import math

import numpy as np

from volcli.kernels.compiler import jit
from volcli.kernels.lanes import any_of, pick

INNER = math.sqrt(3 / 7 - 2 / 7 * math.sqrt(6 / 5)) / 2
OUTER = math.sqrt(3 / 7 + 2 / 7 * math.sqrt(6 / 5)) / 2
"""The nodes of the 4-point Gauss-Legendre rule on an interval of length 1 lie at +-INNER, +-OUTER.
Density times colour is of degree 6 along a ray; four nodes integrate degree 7."""

WEIGHT = (18 - math.sqrt(30)) / (18 + math.sqrt(30))
"""The weight of an outer node, that of an inner one being 1."""

MAX_TAU = 0.5
"""A span of larger optical depth is cut before its source is sampled: within it exp(-tau) has to be
close to the polynomials that four nodes integrate."""

SHORTEST = 2.0**-20
"""A part of a span is no shorter than this share of it, however dense it is."""


THIRD, TWELFTH = 1.0 / 3.0, 1.0 / 12.0
"""A division takes as long as all the rest of an integral."""


@jit
def load(atlas, brick, i, j, k):
    """The eight corner values of cell (i, j, k) of a brick, as float64, z fastest.

    (Numba's ``float()`` leaves a float32 as it is, and then so does all that is computed from it.)
    """
    b = (i * 9 + j) * 9 + k
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


@jit
def trilinear(v, x, y, z):
    """The value at (x, y, z) between eight corners."""
    v00 = v[0] + (v[1] - v[0]) * z
    v01 = v[2] + (v[3] - v[2]) * z
    v10 = v[4] + (v[5] - v[4]) * z
    v11 = v[6] + (v[7] - v[6]) * z
    v0 = v00 + (v01 - v00) * y
    v1 = v10 + (v11 - v10) * y
    return v0 + (v1 - v0) * x


@jit
def cubic(v, x, y, z, dx, dy, dz):
    """Coefficients (p0, p1, p2, p3) of the value along (x, y, z) + u d.

    With the trilinear function written as its value f, its gradient (fx, fy, fz) and its mixed
    derivatives at (x, y, z), the powers of u collect to

        p0 = f,  p1 = fx dx + fy dy + fz dz,
        p2 = fxy dx dy + fxz dx dz + fyz dy dz,  p3 = fxyz dx dy dz.
    """
    d00 = v[1] - v[0]
    d01 = v[3] - v[2]
    d10 = v[5] - v[4]
    d11 = v[7] - v[6]
    v00 = v[0] + d00 * z
    v01 = v[2] + d01 * z
    v10 = v[4] + d10 * z
    v11 = v[6] + d11 * z
    fy0 = v01 - v00
    fy1 = v11 - v10
    v0 = v00 + fy0 * y
    v1 = v10 + fy1 * y
    fx = v1 - v0
    fxy = fy1 - fy0
    fyz0 = d01 - d00
    fyz1 = d11 - d10
    fxyz = fyz1 - fyz0
    fyz = fyz0 + fxyz * x
    fz0 = d00 + fyz0 * y
    fz1 = d10 + fyz1 * y
    fxz = fz1 - fz0
    fz = fz0 + fxz * x
    fy = fy0 + fxy * x
    p0 = v0 + fx * x
    p1 = fx * dx + fy * dy + fz * dz
    p2 = (fxy * dy + fxz * dz) * dx + fyz * dy * dz
    p3 = fxyz * dx * dy * dz
    return p0, p1, p2, p3


@jit
def integral(p, length):
    """The integral of a cubic over [-length/2, length/2]: exact, never below 0."""
    return max(0.0, length * (p[0] + p[2] * (length * length * TWELFTH)))


@jit
def value(p, u):
    """The cubic at u."""
    return p[0] + u * (p[1] + u * (p[2] + u * p[3]))


@jit
def antiderivative(p, u):
    """The integral of the cubic over [0, u]."""
    return u * (p[0] + u * (p[1] * 0.5 + u * (p[2] * THIRD + u * (p[3] * 0.25))))


@jit
def absorbed(x):
    """1 - exp(-x), to the last bits of float64, relatively; x >= 0.

    Up to 1 it is x times a polynomial of degree 11 (Chebyshev interpolation of (1 - exp(-x)) / x,
    error 3e-17), in two interleaved halves: a fifth of the time of `math.expm1`.
    """
    thin = min(x, 1.0)
    y = thin * thin
    odd = -2.7289403227036547e-07 + y * -1.3221480811326931e-09
    odd = -2.4800032289946006e-05 + y * odd
    odd = -0.0013888887104824001 + y * odd
    odd = -0.041666666663443576 + y * odd
    odd = -0.4999999999999964 + y * odd
    even = 2.753231109497008e-06 + y * 2.3200975871202737e-08
    even = 0.0001984120502317959 + y * even
    even = 0.008333333302138762 + y * even
    even = 0.1666666666664944 + y * even
    even = 1.0 + y * even
    part = thin * (even + thin * odd)
    if any_of(x > 1.0):
        part = pick(x > 1.0, 1.0 - math.exp(-x), part)
    return part


@jit
def hit_weights(p, scale, u0, u1):
    """How the light of a span [u0, u1] divides among four samples of its source.

    Returns (tau, u, w): the span's optical depth, where to sample, and the weights, which sum to 1.
    They are proportional to g sigma exp(-tau) at the Gauss nodes, so that the source seen is

        integral of c sigma exp(-tau) du  =  (1 - exp(-tau_span)) sum_i w_i c(u_i)

    (Tagliasacchi and Mildenhall, eq. for piecewise c, with the weights normalised: a convex
    combination cannot leave the range of c, and a constant c comes back exactly.)
    """
    middle = 0.5 * (u0 + u1)
    length = u1 - u0
    u = (
        middle - OUTER * length,
        middle - INNER * length,
        middle + INNER * length,
        middle + OUTER * length,
    )
    begin = antiderivative(p, u0)
    tau = max(0.0, scale * (antiderivative(p, u1) - begin))
    wa = WEIGHT * hit_density(p, scale, begin, u[0])
    wb = hit_density(p, scale, begin, u[1])
    wc = hit_density(p, scale, begin, u[2])
    wd = WEIGHT * hit_density(p, scale, begin, u[3])
    total = wa + wb + wc + wd
    some = total > 0.0  # else nothing is hit here, or nothing that float64 can tell apart
    total = pick(some, total, 1.0)
    return (
        tau,
        u,
        (
            pick(some, wa / total, 0.0),
            pick(some, wb / total, 0.5),
            pick(some, wc / total, 0.5),
            pick(some, wd / total, 0.0),
        ),
    )


@jit
def hit_density(p, scale, begin, u):
    """Proportional to sigma(u) exp(-tau) where tau counts from antiderivative ``begin`` to u."""
    tau = max(0.0, scale * (antiderivative(p, u) - begin))
    return max(0.0, value(p, u)) * (1.0 - absorbed(tau))
