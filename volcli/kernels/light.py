"""What a ray sees of sources of radiance: spans of the ray, sampled and weighted.

A span is a part of the ray over which density is one cubic and each source is one cell of its own
lattice. Each span adds the colour of what is hit, ``T (1 - exp(-tau)) sum_i w_i c(t_i)``, with the
weights of `cell.hit_weights`; the expected hit distance is the same sum with c = t; and what is
emitted whatever the density, ``sum_i g_i T(t_i) e(t_i) dt``. A source may lie on another lattice
than the density: then a density cell is cut where the ray crosses the planes of that lattice, and
the rule keeps its order; and so where its table of colours turns sharply. (A table of many knots
stands for a smooth curve, to which Gauss' rule does justice.)

``colour``, ``emission``, ``tint`` and ``depth`` are None where the scene has no such term; numba
compiles a version without it.
"""

from __future__ import annotations

import math

from volcli.kernels.bounded_light import add_bounded_span
from volcli.kernels.cell import (
    MAX_TAU,
    SHORTEST,
    WEIGHT,
    absorbed,
    antiderivative,
    hit_weights,
)
from volcli.kernels.compiler import jit
from volcli.kernels.doubt import colour_doubt, emission_doubt
from volcli.kernels.source import kink_exit, source_at, source_cell
from volcli.kernels.state import State, darken, strongest, weakest

OUTER_SHARE, INNER_SHARE = WEIGHT / (2.0 + 2.0 * WEIGHT), 1.0 / (2.0 + 2.0 * WEIGHT)
"""The shares of the nodes of Gauss' rule."""

FADED = 2.0**-24
"""What is less than this part of a number cannot change it in float32."""

STOP_TAU = -math.log(FADED)
"""The optical depth beyond which T < FADED."""


@jit
def samples_of(source, nearest, cell, ray, tm, at):
    """The source's (r, g, b) at the four nodes."""
    return (
        source_at(source, nearest, cell, ray, tm + at[0]),
        source_at(source, nearest, cell, ray, tm + at[1]),
        source_at(source, nearest, cell, ray, tm + at[2]),
        source_at(source, nearest, cell, ray, tm + at[3]),
    )


@jit
def weighted(c, channel, w):
    """The sum of one channel of four samples with weights."""
    return w[0] * c[0][channel] + w[1] * c[1][channel] + w[2] * c[2][channel] + w[3] * c[3][channel]


@jit
def colour_weights(state, part, p, scale, u, to, w, tint):
    """The weights of four samples of colour for each channel: what is hit between u and ``to``,
    shared out.

    Under a tint each channel has an extinction of its own, and so its own weights.
    """
    if tint is None:
        wr = wg = wb = times(w, state.T * absorbed(part))
    else:
        hr = math.exp(-tint[0] * state.tau) * absorbed(tint[0] * part)
        hg = math.exp(-tint[1] * state.tau) * absorbed(tint[1] * part)
        hb = math.exp(-tint[2] * state.tau) * absorbed(tint[2] * part)
        wr = times(hit_weights(p, scale * tint[0], u, to)[2], hr)
        wg = times(hit_weights(p, scale * tint[1], u, to)[2], hg)
        wb = times(hit_weights(p, scale * tint[2], u, to)[2], hb)
    return wr, wg, wb


@jit
def times(w, factor):
    """Four weights times a factor."""
    return w[0] * factor, w[1] * factor, w[2] * factor, w[3] * factor


@jit
def emission_weights(state, p, scale, u, to, at, tint):
    """The weights of four samples of emission for each channel: lengths, times what reaches the
    eye from there.

    The integral of e T du by Gauss' rule, at the nodes that `hit_weights` gave: T falls by at most
    exp(-`MAX_TAU`), and where nothing absorbs it is 1 to the bit.
    """
    outer, inner = (to - u) * OUTER_SHARE, (to - u) * INNER_SHARE
    begin = antiderivative(p, u)
    a = max(0.0, scale * (antiderivative(p, at[0]) - begin))
    b = max(0.0, scale * (antiderivative(p, at[1]) - begin))
    c = max(0.0, scale * (antiderivative(p, at[2]) - begin))
    d = max(0.0, scale * (antiderivative(p, at[3]) - begin))
    if tint is None:
        T = state.T
        wr = wg = wb = (
            outer * T * (1.0 - absorbed(a)),
            inner * T * (1.0 - absorbed(b)),
            inner * T * (1.0 - absorbed(c)),
            outer * T * (1.0 - absorbed(d)),
        )
    else:
        tau = state.tau
        wr = through(outer, inner, tint[0], tau + a, tau + b, tau + c, tau + d)
        wg = through(outer, inner, tint[1], tau + a, tau + b, tau + c, tau + d)
        wb = through(outer, inner, tint[2], tau + a, tau + b, tau + c, tau + d)
    return wr, wg, wb


@jit
def through(outer, inner, factor, a, b, c, d):
    """`emission_weights` of a channel whose extinction has a factor."""
    return (
        outer * math.exp(-factor * a),
        inner * math.exp(-factor * b),
        inner * math.exp(-factor * c),
        outer * math.exp(-factor * d),
    )


@jit
def add_span(state, span, colour, emission, tint, nearest, estimate, depth, colour_at, emission_at):
    """Add the light of a span to the state.

    ``span`` is (p, scale, tm, t0, t1): over [t0, t1], density is the cubic ``p`` about the distance
    ``tm``. ``colour_at`` is the cell of the colour, and the ray in its voxels; and so for emission.
    A span of optical depth above `MAX_TAU` is added in parts, each half or twice as long as the one
    before, or the same, so that none is above. With ``estimate`` what the light is off by is
    estimated and added up as well.
    """
    p, scale, tm, t0, t1 = span
    cell, ray = colour_at
    emission_cell, emission_ray = emission_at
    u, end = t0 - tm, t1 - tm
    begin = antiderivative(p, u)
    whole = max(0.0, scale * (antiderivative(p, end) - begin))
    if emission is None and whole <= 0.0:
        return state
    thickest = scale * strongest(tint)
    shortest = (end - u) * SHORTEST
    length = end - u
    final = state.tau + whole
    while u < end:
        to = min(u + length, end)
        if thickest * (antiderivative(p, to) - begin) > MAX_TAU and length > shortest:
            length *= 0.5
            continue
        tau, T, r, g, b, moment, t_far, error = state
        part, at, w = hit_weights(p, scale, u, to)
        hit = T * absorbed(part)
        if colour is not None:
            c = samples_of(colour, nearest, cell, ray, tm, at)
            wr, wg, wb = colour_weights(state, part, p, scale, u, to, w, tint)
            r, g, b = r + weighted(c, 0, wr), g + weighted(c, 1, wg), b + weighted(c, 2, wb)
            if estimate is not None:
                of = (state, p, scale, u, to, part, tint)
                error += colour_doubt(colour.table, c, of, wr, wg, wb)
        if emission is not None:
            c = samples_of(emission, nearest, emission_cell, emission_ray, tm, at)
            wr, wg, wb = emission_weights(state, p, scale, u, to, at, tint)
            r, g, b = r + weighted(c, 0, wr), g + weighted(c, 1, wg), b + weighted(c, 2, wb)
            if estimate is not None:
                of = (state, p, scale, u, to, part, tint)
                error += emission_doubt(emission.table, c, of, wr, wg, wb)
        if depth is not None:
            mean = at[0] * w[0] + at[1] * w[1] + at[2] * w[2] + at[3] * w[3]
            moment += hit * (tm + mean)
        state = State(tau + part, T - hit, r, g, b, moment, t_far, error)
        if faded(state, colour, emission, tint, depth):
            break
        u = to
        begin = antiderivative(p, u)
        length *= 2.0
    _, T, r, g, b, moment, t_far, error = state
    return State(final, T, r, g, b, moment, t_far, error)


@jit
def add_spans(
    state,
    p,
    scale,
    tm,
    t0,
    t1,
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
):
    """As `add_span`, cut where the ray crosses the planes of a source's own lattice.

    ``own`` and ``emission_own`` are as in `source_cell`. With ``bounds`` the error of the span is
    added up as well, and kept to what they allow.
    """
    t = t0
    cell = emission_cell = (0, 0, 0, 0)
    while t < t1:
        if bounds is None and faded(state, colour, emission, tint, depth):
            rest = antiderivative(p, t1 - tm) - antiderivative(p, t - tm)
            return darken(state, max(0.0, scale * rest))
        t_exit = t1
        if colour is not None:
            t_exit, cell = source_cell(colour, own, path, t, t_exit)
            t_exit = kink_exit(colour.grid, colour.table, nearest, cell, path.ray, t, t_exit)
        if emission is not None:
            t_exit, emission_cell = source_cell(emission, emission_own, emission_path, t, t_exit)
            t_exit = kink_exit(
                emission.grid, emission.table, nearest, emission_cell, emission_path.ray, t, t_exit
            )
        span = (p, scale, tm, t, t_exit)
        colour_at, emission_at = (cell, path.ray), (emission_cell, emission_path.ray)
        if bounds is not None:
            state = add_bounded_span(
                state, span, colour, emission, tint, nearest, bounds, depth, colour_at, emission_at
            )
        else:
            state = add_span(
                state,
                span,
                colour,
                emission,
                tint,
                nearest,
                estimate,
                depth,
                colour_at,
                emission_at,
            )
        t = t_exit
    return state


@jit
def faded(state, colour, emission, tint, depth):
    """Whether light that is still to come is less than 2^-24 of what the ray's brightest channel
    has seen (and distance likewise): then only optical depth goes on.

    T alone does not tell: what is behind may be brighter than what is in front.
    """
    if not faded_out(state, tint):
        return False
    T = math.exp(-weakest(tint) * state.tau)
    seen = brightest_channel(state)
    if colour is not None and T * colour.brightest > FADED * seen:
        return False
    if emission is not None and T * emission.brightest * state.t_far > FADED * seen:
        return False
    return depth is None or T * state.t_far <= FADED * state.moment


@jit
def faded_out(state, tint):
    """Whether no channel of what is still to come reaches the eye with more than `FADED` of it."""
    return weakest(tint) * state.tau > STOP_TAU


@jit
def brightest_channel(state):
    """The largest magnitude of what the ray has seen."""
    return max(abs(state.r), max(abs(state.g), abs(state.b)))
