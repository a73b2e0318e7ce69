"""What the exact rule is estimated to be off by in a span, from the samples that it took anyway.

Optical depth is exact; what is off is the light of sources that vary. An *estimate* is no bound:
see `bounded_light` for those. There are two kinds.

A source without a table is a cubic along the span, and four samples tell which. Then the bound of
`bounded_light` can be had from them, and is what is told.

With a table it is no polynomial, and only the samples speak. An **embedded rule** leaves out the
sample at an end; of degree 2, it differs from Gauss' rule by what is of degree 3. If the terms of a
series of polynomials fall like q^k, that tells q^3, and Gauss' rule, which is of degree 7, is off
by q^8, both as shares of the samples' size. What falls otherwise, as between two knots of a table
that turns slowly, may be off by more.
"""

from __future__ import annotations

from volcli.kernels.bounded_light import NOTHING, largest_error, scaled, shifted
from volcli.kernels.cell import INNER, OUTER, WEIGHT
from volcli.kernels.compiler import jit

EMBEDDED = OUTER * WEIGHT / INNER
"""What an inner sample counts, if an outer one counts 1 and the sides have opposite signs, in what
Gauss' rule and the embedded one differ by."""

DARK = (NOTHING, NOTHING, NOTHING, 0.0)
"""`bounded_light.curves` where there is no such source."""


@jit
def colour_doubt(table, c, of, wr, wg, wb):
    """An estimate of what the colour of a span is off by, in any channel.

    Parameters
    ----------
    table
        `source.Table` of the colour, or None.
    c
        Its (r, g, b) at the four nodes.
    of
        (state, p, scale, u, to, part, tint): the ray's state before the span, the span's cubic of
        density, its extinction's scale, its ends, and its optical depth.
    wr, wg, wb
        The samples' weights in what is seen.
    """
    if table is None:
        return cubic_error(c, of, True)
    r, g, b = mean_of(c, 0, wr), mean_of(c, 1, wg), mean_of(c, 2, wb)
    return max(doubt(c, 0, wr, r), max(doubt(c, 1, wg, g), doubt(c, 2, wb, b)))


@jit
def emission_doubt(table, c, of, wr, wg, wb):
    """As `colour_doubt`, of emission."""
    if table is None:
        return cubic_error(c, of, False)
    return max(doubt(c, 0, wr, 0.0), max(doubt(c, 1, wg, 0.0), doubt(c, 2, wb, 0.0)))


@jit
def cubic_error(c, of, is_colour):
    """The bound of a source that is a cubic."""
    state, p, scale, u, to, part, tint = of
    half = 0.5 * (to - u)
    s = scaled(shifted(p, 0.5 * (u + to), half), scale)
    source = interpolant(c, 0), interpolant(c, 1), interpolant(c, 2), 0.0
    if is_colour:
        return largest_error(state, s, half, part, source, DARK, tint)
    return largest_error(state, s, half, part, DARK, source, tint)


@jit
def interpolant(c, channel):
    """The cubic of x in [-1, 1] through one channel of four samples."""
    outer, inner = 2.0 * OUTER, 2.0 * INNER
    even = 0.5 * (c[0][channel] + c[3][channel])
    odd = 0.5 * (c[3][channel] - c[0][channel]) / outer
    inner_even = 0.5 * (c[1][channel] + c[2][channel])
    inner_odd = 0.5 * (c[2][channel] - c[1][channel]) / inner
    between = outer * outer - inner * inner
    p2, p3 = (even - inner_even) / between, (odd - inner_odd) / between
    return inner_even - p2 * inner * inner, inner_odd - p3 * inner * inner, p2, p3


@jit
def mean_of(c, channel, w):
    """The mean of one channel of four samples; 0 where nothing is hit."""
    total = w[0] + w[1] + w[2] + w[3]
    if not total > 0.0:
        return 0.0
    seen = w[0] * c[0][channel] + w[1] * c[1][channel]
    return (seen + w[2] * c[2][channel] + w[3] * c[3][channel]) / total


@jit
def doubt(c, channel, w, mean):
    """An estimate of what a weighted sum of samples less ``mean`` is off by."""
    x0, x1 = w[0] * (c[0][channel] - mean), w[1] * (c[1][channel] - mean)
    x2, x3 = w[2] * (c[2][channel] - mean), w[3] * (c[3][channel] - mean)
    size = abs(x0) + abs(x1) + abs(x2) + abs(x3)
    differs = abs((x0 - x3) - EMBEDDED * (x1 - x2))
    return size * min(1.0, differs / size) ** (8.0 / 3.0) if differs > 0.0 else 0.0
