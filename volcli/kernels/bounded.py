"""The certified rule, ray by ray: parts of a ray taken as a whole, and the error of that.

A segment of a ray is tried as a whole brick, then octant by octant, and is walked cell by cell
where that is not good enough. A part that is taken as a whole costs one evaluation: its density is
the linear fit of its region, its colour and its emission the middles of their ranges there
(`bounds`).

**Why the errors add up.** Let parts 1..n follow each other along the ray, and R_j be what is seen
when parts 1..j are as the rule has them and all behind is exact. Then what is seen by the rule less
what is there is the sum of R_j - R_(j-1). Both have the same parts before j, the rule's, which let
T through, and the same exact light B (for what reaches it) behind j. With the part's optical depth
tau and opacity O = 1 - exp(-tau), its colour c, and the rule's tau', c', the difference is

    T ( integral of (c' - c) dO  +  (exp(-tau') - exp(-tau)) (B - c') ).

B - c' is the difference of two radiances that the scene can show: at most ``contrast`` times the
brightest. c' is off by at most r, half of its range. tau' is off by at most d, the fit's r times
scale and length; where that would have tau below 0, tau' is half of the most that it can be, and d
as much. So d <= tau', exp(-tau) is off by at most D = exp(-(tau' - d)) (1 - exp(-d)), the part adds
no more than

    T ( r (1 - exp(-tau' - d)) + contrast * brightest * D ),

and the transmittance of the whole ray is off by T D more, what is behind letting at most all
through. Emission e per length adds the integral of e exp(-tau(t)); the rule has its middle e', and
a depth that grows evenly, which that of a linear density is no farther from than b = scale * slope
* length^2 / 8. So exp(-tau(t)) is off by at most q = 1 - exp(-d - b), and the part by T length
( r_e (mean of exp(-tau'(t)) + q) + |e'| q ). In a cell optical depth is exact, and `bounded_light`
bounds what the rule is off by. No bound is multiplied with another: certificates are sums.

**Who may spend what.** A part is taken as a whole if the errors up to its end, its own included,
are at most ``max_error`` times the share of the ray's path that ends there; so they never are more,
and what one part leaves is there for those behind. Once all that is still to come reaches the eye
weaker than what is left to spend, it is spent on that: light is no longer added up, and optical
depth, of which nothing is certified, goes on by the fits of bricks.

Under a tint each channel has its own depth and its own bound; the largest counts.
"""

from __future__ import annotations

import math

from volcli.kernels.bounded_light import share
from volcli.kernels.bounded_source import octant_after, region_colour, source_region
from volcli.kernels.bounds import region_of
from volcli.kernels.cell import absorbed
from volcli.kernels.compiler import jit
from volcli.kernels.rules import (
    constant_density,
    exact_segment,
    hits,
    mean_transmittance,
    own_cell,
    reaches,
)
from volcli.kernels.state import State, refresh, weakest

DARK = ((0.0, 0.0, 0.0), 0.0)
"""As `bounded_source.region_colour`, where there is no such source."""


@jit
def spend_rest(state, faded, tint, bounds):
    """(state, faded): whether all that is still to come is left out, and the state with the error
    of that, once."""
    if faded:
        return state, True
    tau, T, r, g, b, moment, t_far, error = state
    error += math.exp(-weakest(tint) * tau)
    if error > bounds.max_error:
        return state, False
    return State(tau, T, r, g, b, moment, t_far, error), True


@jit
def bounded_segment(
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
):
    """Add a segment: (state, evaluated). If ``faded``, only its optical depth counts."""
    own = own_cell(colour, entry, corner[0], corner[1], corner[2])[0]
    emission_own = own_cell(emission, entry, corner[0], corner[1], corner[2])[0]
    lit, glow = DARK, DARK
    evaluated = 0
    t = refused = t0  # up to there bricks are refused
    while t < t1:
        width, t_exit, number = 8, t1, 0
        if t < refused:
            width, t_exit = 4, refused
            if entry >= 0:
                t_exit, number = octant_after(ray, corner, t, t_exit)
        cells_to = t_exit
        if not faded:
            if colour is not None:
                t_exit, at, of = source_region(colour, own, number, path, t, t_exit, width)
                lit = region_colour(colour, bounds.colour, nearest, at, of)
            if emission is not None:
                t_exit, at, of = source_region(
                    emission, emission_own, number, emission_path, t, t_exit, width
                )
                glow = region_colour(emission, bounds.emission, nearest, at, of)
        fit = fit_along(density, bounds, entry, number, corner, ray, transfer, t, t_exit)
        error = state.error
        if not faded:
            error += part_error(state, fit, t_exit - t, lit, glow, tint, bounds)
        if error <= bounds.max_error * t_exit / state.t_far or faded:
            state = add_part(state, error, fit[0], t, t_exit, lit, glow, tint)
            evaluated += 1
        elif width == 8:
            refused = t_exit
            continue
        else:
            if entry >= 0:  # no cell is cut in two by a plane of a source, or it would count twice
                t_exit = cells_to
            state, cells = exact_segment(
                state,
                density.grid,
                density.scale,
                entry,
                corner,
                ray,
                t,
                t_exit,
                transfer,
                colour,
                emission,
                tint,
                nearest,
                bounds,
                None,
                depth,
                path,
                emission_path,
            )
            state = refresh(state)
            evaluated += cells
        t = t_exit
    return state, evaluated


@jit
def fit_along(density, bounds, entry, number, corner, ray, transfer, t, t_exit):
    """(tau, slack, bend) of a part of a ray by the fit of its region: optical depth; how far off
    that is at most, no more than itself; how much farther on the way, if it is to grow evenly."""
    length = t_exit - t
    if entry < 0:
        value = constant_density(density.grid, entry, transfer)
        return density.scale * value * length, 0.0, 0.0
    fit = bounds.density[entry, number]
    x, y, z, width = region_of(number)
    middle, tm = 0.5 * width, 0.5 * (t + t_exit)
    o, d = ray.o, ray.d
    value = (
        fit[0]
        + fit[1] * (o[0] + tm * d[0] - corner[0] - x - middle)
        + fit[2] * (o[1] + tm * d[1] - corner[1] - y - middle)
        + fit[3] * (o[2] + tm * d[2] - corner[2] - z - middle)
    )
    depth = density.scale * length
    if value < fit[4]:  # from nothing to as much as there may be
        half = 0.5 * depth * max(0.0, value + fit[4])
        return half, half, half
    slope = fit[1] * d[0] + fit[2] * d[1] + fit[3] * d[2]
    tau = depth * value
    return tau, depth * fit[4], min(depth * abs(slope) * length * 0.125, tau)


@jit
def part_error(state, fit, length, lit, glow, tint, bounds):
    """What taking a part as a whole is off by at most, in any channel: transmittance, and radiance
    as a share of the brightest."""
    if tint is None:
        return state.T * channel_error(fit, length, lit, glow, 1.0, bounds)
    r = math.exp(-tint[0] * state.tau) * channel_error(fit, length, lit, glow, tint[0], bounds)
    g = math.exp(-tint[1] * state.tau) * channel_error(fit, length, lit, glow, tint[1], bounds)
    b = math.exp(-tint[2] * state.tau) * channel_error(fit, length, lit, glow, tint[2], bounds)
    return max(r, max(g, b))


@jit
def channel_error(fit, length, lit, glow, factor, bounds):
    """`part_error` of a channel whose extinction has a factor, if all light reaches the part."""
    tau, slack, bend = factor * fit[0], factor * fit[1], factor * fit[2]
    less = (1.0 - absorbed(tau - slack)) * absorbed(slack)
    light = lit[1] * absorbed(tau + slack)
    if glow[1] > 0.0 or slack + bend > 0.0:
        r, g, b = glow[0]
        drift = absorbed(slack + bend)
        through = min(1.0, mean_transmittance(tau) + drift)
        light += length * (glow[1] * through + max(abs(r), max(abs(g), abs(b))) * drift)
    return max(less, bounds.contrast * less + share(light, bounds))


@jit
def add_part(state, error, tau, t, t_exit, lit, glow, tint):
    """The state after a part that is taken as a whole: of colour ``lit`` and of emission ``glow``,
    evenly."""
    _, T, r, g, b, moment, t_far, _ = state
    hit = T * absorbed(tau)
    hr, hg, hb = hits(state, tau, hit, tint)
    lr, lg, lb = reaches(state, tau, tint)
    length = t_exit - t
    r += hr * lit[0][0] + length * lr * glow[0][0]
    g += hg * lit[0][1] + length * lg * glow[0][1]
    b += hb * lit[0][2] + length * lb * glow[0][2]
    moment += hit * 0.5 * (t + t_exit)
    return State(state.tau + tau, T - hit, r, g, b, moment, t_far, error)
