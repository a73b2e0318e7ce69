"""What a ray sees of sources of radiance in a span, and how far off that can be.

As `light.add_span`, a span at a time, over which density is one cubic. The rule is the same: the
exact opacity of the span, shared out among four Gauss nodes, and emission summed at the same nodes.
Here a span, or a part of one, is taken only if a bound of what the rule is off by fits into what is
left of the error that is allowed; else it is halved.

**The bound.** Let x in [-1, 1] run over the part, of half length h, and write at x

    s(x) = s0 + s1 x + s2 x^2 + s3 x^3     extinction
    a(x) = h (s0 x + s1 x^2 / 2 + ...)     optical depth, counted from the middle
    c(x) = c0 + c1 x + c2 x^2 + c3 x^3     a channel of the colour

With f = s exp(-a), m = c0 and primes for Gauss' rule, the part's radiance is, but for what reaches
it, N + m D, where N is the integral of (c - m) f and D that of f, which is known exactly. The
normalised rule gives D N' / D' + m D. N' / D' is a mean of c - m at the nodes, so no larger than
r = |c1| + |c2| + |c3|, and the difference is

    D N' / D' - N = (D - D') N' / D' + (N' - N),   at most   r |D' - D| + |N' - N|.

Both are errors of a 4-point Gauss rule, which is exact for polynomials up to degree 7. Now
(c - m) s (1 - h s0 x) is of degree 7, and s (1 - a) too, so that what is left to be wrong about is

    (c - m) s (exp(-a) - 1 + h s0 x)   and   s (exp(-a) - 1 + a).

A function that is analytic in the Bernstein ellipse of parameter rho, and no larger than M there,
has Chebyshev coefficients of at most 2 M rho^-k (Trefethen, Approximation Theory and Approximation
Practice, theorem 8.1). Gauss' rule is off by at most 2 + 2 / (k^2 - 1) for the k-th polynomial, and
by nothing for odd k or k < 8: in sum by less than 4.07 M rho^-8 / (1 - rho^-2). In the ellipse
|x| <= z = (rho + 1/rho) / 2, so that polynomials are bounded by their coefficients, and

    |exp(-a) - 1 + a| <= exp(A) - 1 - A <= A^2 / 2 / (1 - A / 3)   with A the bound of |a|, A < 3.

Any rho will do; two are tried. Emission e, a cubic as well, is multiplied by exp(-a) alone:
e (1 - a) is of degree 7, and e (exp(-a) - 1 + a) is what is wrong.

**What is thin** needs no nodes. With the mean k = O / t of exp(-a) over the part's depth t, O being
its opacity, the part's radiance is taken as k times the integral of c s, a polynomial: that is O
times the mean colour, weighted with density. What that is off by is the integral of
(c - m) (exp(-a) - k) over depth, at most r times that of |exp(-a) - k|, which is at most r t^2 / 3:
a function that falls by less than its argument grows differs from its mean, on average over [0, t],
by no more than two points of [0, t] do from each other. Emission is left to the nodes.

**What always holds** is that both the rule and the truth lie between the least and the largest
colour of the part: they differ by at most 2 r D. So the bound of ever smaller parts goes to 0.

**A table of colours** is bent at its knots. Over a part it is replaced by the chord between the
colours of the least and the largest value there; where its slope varies by V in between, it is
nowhere farther from its chord than V / 4 of that range of values. (With slopes from p to q the
farthest is a triangle of height (q - s)(s - p) / (q - p), s being the chord's slope, of the range.)

Under a tint each channel has its own extinction and its own bound; the largest counts.
"""

from __future__ import annotations

import math

import numpy as np

from volcli.kernels.cell import (
    INNER,
    OUTER,
    THIRD,
    WEIGHT,
    absorbed,
    antiderivative,
    cubic,
    hit_weights,
    value,
)
from volcli.kernels.compiler import jit
from volcli.kernels.source import NOWHERE, channel_values, colour_in, scalars, table_colour
from volcli.kernels.state import State
from volcli.kernels.traversal import last_below

OUTER_SHARE, INNER_SHARE = WEIGHT / (2.0 + 2.0 * WEIGHT), 1.0 / (2.0 + 2.0 * WEIGHT)
"""The shares of the nodes of Gauss' rule."""


def _ellipse(rho: float) -> tuple[float, float]:
    """What Gauss' rule is off by on [-1, 1] for a function of magnitude 1 in the ellipse, and the
    largest abs(x) of that ellipse."""
    return 4.07 * rho**-8 / (1 - rho**-2), (rho + 1 / rho) / 2


SMALL, LARGE = _ellipse(4.0), _ellipse(16.0)
"""The ellipses that are tried: small ones suit densities that are rough, large ones light smoke."""

SHORTEST = 2.0**-40
"""A part of a span is no shorter than this share of it, whatever its error: that is below 2^-39 of
what is seen of it."""

TWO_THIRDS, TWO_SEVENTHS = 2.0 / 3.0, 2.0 / 7.0

NOTHING = (0.0, 0.0, 0.0, 0.0)
"""A cubic that is 0."""


@jit
def shifted(p, middle, half):
    """The cubic p(u) as one of x in [-1, 1], where u = middle + half x."""
    return (
        value(p, middle),
        (p[1] + middle * (2.0 * p[2] + 3.0 * middle * p[3])) * half,
        (p[2] + 3.0 * middle * p[3]) * half * half,
        p[3] * half * half * half,
    )


@jit
def scaled(p, factor):
    """The cubic times a factor."""
    return factor * p[0], factor * p[1], factor * p[2], factor * p[3]


@jit
def swing(p):
    """How far a cubic of x in [-1, 1] is from its value at 0, at most."""
    return abs(p[1]) + abs(p[2]) + abs(p[3])


@jit
def largest(p, z):
    """The largest magnitude of a cubic where abs(x) <= z."""
    return abs(p[0]) + z * (abs(p[1]) + z * (abs(p[2]) + z * abs(p[3])))


@jit
def gauss_errors(s, half, colour, r, emission, ellipse):
    """Bounds of what the rule is off by: of colour (normalised), and of emission.

    ``colour`` holds a bound of the magnitude of each coefficient over the channels, and so
    ``emission``; ``r`` is the swing of the colour. (inf, inf) where the ellipse is too large.
    """
    factor, z = ellipse
    depth = half * z * largest((s[0], s[1] * 0.5, s[2] * THIRD, s[3] * 0.25), z)
    if not depth < 2.9:
        return math.inf, math.inf
    curved = 0.5 * depth * depth / (1.0 - depth * THIRD)
    bent = depth - half * z * abs(s[0])
    scale = factor * half
    density = largest(s, z)
    sums = density * ((largest(colour, z) - abs(colour[0])) * (bent + curved) + r * curved)
    return scale * sums, scale * largest(emission, z) * curved


@jit
def source_cubics(source, nearest, cell, ray, tm):
    """The source along the ray, about the distance tm, in a cell (entry, i, j, k): a cubic for each
    channel; with a table, that of the value first and nothing else."""
    if source is None:
        return NOTHING, NOTHING, NOTHING
    if cell[0] == NOWHERE:
        return NOTHING, NOTHING, NOTHING
    return cubics_in(source.grid, source.table, source.scale, nearest, cell, ray, tm)


@jit
def cubics_in(grid, table, scale, nearest, cell, ray, tm):
    """`source_cubics` where there is something. (Numba leaves out what hangs on an argument that is
    None, not on a field.)"""
    entry, i, j, k = cell
    d = ray.d
    first = ((i & 7) * 9 + (j & 7)) * 9 + (k & 7)
    x, y, z = ray.o[0] + tm * d[0] - i, ray.o[1] + tm * d[1] - j, ray.o[2] + tm * d[2] - k
    if table is not None:
        if entry < 0:
            v = np.float64(grid.constants[-1 - entry])
            return (v, 0.0, 0.0, 0.0), NOTHING, NOTHING
        if nearest is not None:
            v = np.float64(grid.atlas[entry, first])
            return (v, 0.0, 0.0, 0.0), NOTHING, NOTHING
        v = scalars(grid.atlas, entry, first)
        return cubic(v, x, y, z, d[0], d[1], d[2]), NOTHING, NOTHING
    if scale is not None:
        if entry < 0 or nearest is not None:
            r, g, b = colour_in(grid, None, scale, nearest, entry, first, x, y, z)
            return (r, 0.0, 0.0, 0.0), (g, 0.0, 0.0, 0.0), (b, 0.0, 0.0, 0.0)
        return (
            scaled(channel_cubic(grid, entry, first, 0, x, y, z, d), scale),
            scaled(channel_cubic(grid, entry, first, 1, x, y, z, d), scale),
            scaled(channel_cubic(grid, entry, first, 2, x, y, z, d), scale),
        )
    return NOTHING, NOTHING, NOTHING


@jit
def channel_cubic(grid, entry, first, c, x, y, z, d):
    """`cell.cubic` of one channel."""
    return cubic(channel_values(grid.atlas, entry, first, c), x, y, z, d[0], d[1], d[2])


@jit
def curves(source, cell, cubics, middle, half):
    """(red, green, blue, residual): the colour as cubics of x in [-1, 1] over a part, and how far
    from the source they are at most."""
    if source is None:
        return NOTHING, NOTHING, NOTHING, 0.0
    if cell[0] == NOWHERE:
        return NOTHING, NOTHING, NOTHING, 0.0
    red, green, blue = cubics
    red = shifted(red, middle, half)
    return chord(source.table, red, shifted(green, middle, half), shifted(blue, middle, half))


@jit
def chord(table, p, green, blue):
    """The cubics as they are; with a table, the chord of its colours, of which p is the value."""
    if table is None:
        return p, green, blue, 0.0
    low, high = p[0] - swing(p), p[0] + swing(p)
    r0, g0, b0 = table_colour(table, low)
    if not low < high:
        return (r0, 0.0, 0.0, 0.0), (g0, 0.0, 0.0, 0.0), (b0, 0.0, 0.0, 0.0), 0.0
    r1, g1, b1 = table_colour(table, high)
    before, behind = last_below(table.knots, low), last_below(table.knots, high)
    varied = table.bends[behind + 1] - table.bends[before + 1]
    return (
        along(p, low, high, r0, r1),
        along(p, low, high, g0, g1),
        along(p, low, high, b0, b1),
        0.25 * varied * (high - low),
    )


@jit
def along(p, low, high, at_low, at_high):
    """A linear function of the cubic, from its values at two of the cubic's."""
    slope = (at_high - at_low) / (high - low)
    return at_low + slope * (p[0] - low), slope * p[1], slope * p[2], slope * p[3]


@jit
def magnitudes(red, green, blue):
    """The largest magnitude of each coefficient over the channels."""
    return (
        max(abs(red[0]), max(abs(green[0]), abs(blue[0]))),
        max(abs(red[1]), max(abs(green[1]), abs(blue[1]))),
        max(abs(red[2]), max(abs(green[2]), abs(blue[2]))),
        max(abs(red[3]), max(abs(green[3]), abs(blue[3]))),
    )


@jit
def span_error(s, half, hit, colour, emission):
    """A bound of what the rule is off by in a part that all light reaches; ``s`` is its extinction
    about the middle, ``hit`` its opacity, and the others are `curves`."""
    of_colour = magnitudes(colour[0], colour[1], colour[2])
    of_emission = magnitudes(emission[0], emission[1], emission[2])
    r = swing(of_colour)
    a, b = gauss_errors(s, half, of_colour, r, of_emission, SMALL)
    c, d = gauss_errors(s, half, of_colour, r, of_emission, LARGE)
    seen = min(2.0 * r * hit, min(a, c)) + colour[3] * hit
    brightest = of_emission[0] + swing(of_emission)
    return seen + min(4.0 * half * brightest, min(b, d)) + 2.0 * half * emission[3]


@jit
def largest_error(state, s, half, part, lit, glow, tint):
    """What the rule is off by at most in a part of optical depth ``part``, in any channel."""
    if tint is None:
        return state.T * span_error(s, half, absorbed(part), lit, glow)
    return max(
        tinted_error(state, s, half, part, lit, glow, tint[0]),
        max(
            tinted_error(state, s, half, part, lit, glow, tint[1]),
            tinted_error(state, s, half, part, lit, glow, tint[2]),
        ),
    )


@jit
def tinted_error(state, s, half, part, lit, glow, factor):
    """`largest_error` of a channel whose extinction has a factor."""
    off = span_error(scaled(s, factor), half, absorbed(factor * part), lit, glow)
    return math.exp(-factor * state.tau) * off


@jit
def add_bounded_span(
    state, span, colour, emission, tint, nearest, bounds, depth, colour_at, emission_at
):
    """Add the light of a span to the state, and what it may be off by. (As `light.add_span`.)"""
    p, scale, tm, t0, t1 = span
    u, end = t0 - tm, t1 - tm
    begin = antiderivative(p, u)
    whole = max(0.0, scale * (antiderivative(p, end) - begin))
    if whole <= 0.0 and (emission is None or emission_at[0][0] == NOWHERE):
        return state
    colours = source_cubics(colour, nearest, colour_at[0], colour_at[1], tm)
    glows = source_cubics(emission, nearest, emission_at[0], emission_at[1], tm)
    length = end - u
    shortest = length * SHORTEST
    final = state.tau + whole
    while u < end:
        to = min(u + length, end)
        tau, T, r, g, b, moment, t_far, error = state
        middle, half = 0.5 * (u + to), 0.5 * (to - u)
        lit = curves(colour, colour_at[0], colours, middle, half)
        s = scaled(shifted(p, middle, half), scale)
        if emission is None:
            part = max(0.0, scale * (antiderivative(p, to) - antiderivative(p, u)))
            thin = error + share(thin_error(state, part, lit, tint), bounds)
            if thin <= bounds.max_error * (tm + to) / t_far:
                state = add_thin(state, thin, s, tm + middle, half, part, lit, tint)
                u = to
                length *= 2.0
                continue
        glow = curves(emission, emission_at[0], glows, middle, half)
        part, at, w = hit_weights(p, scale, u, to)
        error += share(largest_error(state, s, half, part, lit, glow, tint), bounds)
        if error > bounds.max_error * (tm + to) / t_far and length > shortest:
            length *= 0.5
            continue
        hit = T * absorbed(part)
        if colour is not None:
            r, g, b = seen_colour((r, g, b), state, p, scale, u, to, part, w, lit, tint)
        if emission is not None:
            r, g, b = seen_emission((r, g, b), state, p, scale, u, to, at, glow, tint)
        if depth is not None:
            mean = at[0] * w[0] + at[1] * w[1] + at[2] * w[2] + at[3] * w[3]
            moment += hit * (tm + mean)
        state = State(tau + part, T - hit, r, g, b, moment, t_far, error)
        u = to
        length *= 2.0
    _, T, r, g, b, moment, t_far, error = state
    return State(final, T, r, g, b, moment, t_far, error)


@jit
def thin_error(state, part, lit, tint):
    """What `add_thin` is off by at most in a part of that optical depth, in any channel."""
    r = swing(magnitudes(lit[0], lit[1], lit[2]))
    if tint is None:
        return state.T * channel_thin(part, r, lit[3])
    return max(
        math.exp(-tint[0] * state.tau) * channel_thin(tint[0] * part, r, lit[3]),
        max(
            math.exp(-tint[1] * state.tau) * channel_thin(tint[1] * part, r, lit[3]),
            math.exp(-tint[2] * state.tau) * channel_thin(tint[2] * part, r, lit[3]),
        ),
    )


@jit
def channel_thin(part, r, residual):
    """`thin_error` of a channel, if all light reaches the part."""
    return r * part * part * THIRD + residual * absorbed(part)


@jit
def add_thin(state, error, s, t, half, part, lit, tint):
    """The state after a part about the distance t, all of the colour that is its mean, weighted
    with its extinction ``s``."""
    tau, T, r, g, b, moment, t_far, _ = state
    # The integrals of x s, x^2 s and x^3 s over [-1, 1], as shares of that of s.
    whole = half / part if part > 0.0 else 0.0
    x1 = whole * (TWO_THIRDS * s[1] + 0.4 * s[3])
    x2 = whole * (TWO_THIRDS * s[0] + 0.4 * s[2])
    x3 = whole * (0.4 * s[1] + TWO_SEVENTHS * s[3])
    hit = T * absorbed(part)
    if tint is None:
        hr = hg = hb = hit
    else:
        hr = math.exp(-tint[0] * tau) * absorbed(tint[0] * part)
        hg = math.exp(-tint[1] * tau) * absorbed(tint[1] * part)
        hb = math.exp(-tint[2] * tau) * absorbed(tint[2] * part)
    red, green, blue, _ = lit
    r += hr * (red[0] + x1 * red[1] + x2 * red[2] + x3 * red[3])
    g += hg * (green[0] + x1 * green[1] + x2 * green[2] + x3 * green[3])
    b += hb * (blue[0] + x1 * blue[1] + x2 * blue[2] + x3 * blue[3])
    moment += hit * (t + half * x1)
    return State(tau + part, T - hit, r, g, b, moment, t_far, error)


@jit
def share(light, bounds):
    """Light as a share of the brightest."""
    return light / bounds.brightest if bounds.brightest > 0.0 else 0.0


@jit
def mean_of(p, w):
    """The mean of a cubic of x in [-1, 1] at the nodes."""
    a, b = 2.0 * OUTER, 2.0 * INNER
    return w[0] * value(p, -a) + w[1] * value(p, -b) + w[2] * value(p, b) + w[3] * value(p, a)


@jit
def seen_colour(rgb, state, p, scale, u, to, part, w, lit, tint):
    """(r, g, b) with what particles between u and ``to`` emit, in cubics ``lit``."""
    r, g, b = rgb
    red, green, blue, _ = lit
    if tint is None:
        hit = state.T * absorbed(part)
        return r + hit * mean_of(red, w), g + hit * mean_of(green, w), b + hit * mean_of(blue, w)
    tau = state.tau
    wr = hit_weights(p, scale * tint[0], u, to)[2]
    wg = hit_weights(p, scale * tint[1], u, to)[2]
    wb = hit_weights(p, scale * tint[2], u, to)[2]
    r += math.exp(-tint[0] * tau) * absorbed(tint[0] * part) * mean_of(red, wr)
    g += math.exp(-tint[1] * tau) * absorbed(tint[1] * part) * mean_of(green, wg)
    b += math.exp(-tint[2] * tau) * absorbed(tint[2] * part) * mean_of(blue, wb)
    return r, g, b


@jit
def seen_emission(rgb, state, p, scale, u, to, at, glow, tint):
    """(r, g, b) with what is emitted between u and ``to``, in cubics ``glow``."""
    r, g, b = rgb
    red, green, blue, _ = glow
    begin, length = antiderivative(p, u), to - u
    tau = (
        max(0.0, scale * (antiderivative(p, at[0]) - begin)),
        max(0.0, scale * (antiderivative(p, at[1]) - begin)),
        max(0.0, scale * (antiderivative(p, at[2]) - begin)),
        max(0.0, scale * (antiderivative(p, at[3]) - begin)),
    )
    if tint is None:
        w = shares_of(tau, 1.0)
        reached = length * state.T
        r += reached * mean_of(red, w)
        g += reached * mean_of(green, w)
        b += reached * mean_of(blue, w)
        return r, g, b
    r += length * math.exp(-tint[0] * state.tau) * mean_of(red, shares_of(tau, tint[0]))
    g += length * math.exp(-tint[1] * state.tau) * mean_of(green, shares_of(tau, tint[1]))
    b += length * math.exp(-tint[2] * state.tau) * mean_of(blue, shares_of(tau, tint[2]))
    return r, g, b


@jit
def shares_of(tau, factor):
    """The shares of the nodes times what reaches them through optical depths ``factor`` tau."""
    return (
        OUTER_SHARE * (1.0 - absorbed(factor * tau[0])),
        INNER_SHARE * (1.0 - absorbed(factor * tau[1])),
        INNER_SHARE * (1.0 - absorbed(factor * tau[2])),
        OUTER_SHARE * (1.0 - absorbed(factor * tau[3])),
    )
