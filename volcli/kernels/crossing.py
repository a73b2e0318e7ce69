"""Where a cubic along a ray crosses one of several levels: to rounding, whatever the cubic."""

from __future__ import annotations

import math

from volcli.kernels.cell import value
from volcli.kernels.compiler import jit
from volcli.kernels.traversal import last_below

HALVINGS = 60
"""Bisections that find a place in an interval to the last bit, and a few."""


@jit
def turning_point(p, u, end):
    """The first place in (u, end) where the cubic's slope is 0, else ``end``."""
    a, b, c = 3.0 * p[3], p[2], p[1]  # slope: a u^2 + 2 b u + c
    inside = b * b - a * c
    if inside < 0.0:
        return end
    q = -(b + math.copysign(math.sqrt(inside), b))
    first = end
    if a != 0.0 and u < q / a < first:
        first = q / a
    if q != 0.0 and u < c / q < first:
        first = c / q
    return first


@jit
def first_crossing(p, u, end, levels):
    """How far from u on, up to ``end``, the cubic stays between two levels.

    Returns (to, piece): between ``levels[piece]`` and the next; -1 below all.
    """
    low, here = u, value(p, u)
    while True:
        high = turning_point(p, low, end)  # monotone up to there: what is crossed is crossed once
        there = value(p, high)
        rises = there >= here
        piece = last_below(levels, here)
        if rises:
            crossed = piece + 1 < len(levels) and levels[piece + 1] < there
            level = levels[min(piece + 1, len(levels) - 1)]
        else:
            if piece >= 0 and levels[piece] == here:  # on its way down it is below it
                piece -= 1
            crossed = piece >= 0 and levels[piece] > there
            level = levels[max(piece, 0)]
        if crossed or high >= end:
            break
        low, here = high, there
    if crossed:
        for _ in range(HALVINGS):
            middle = 0.5 * (low + high)
            if (value(p, middle) < level) == rises:
                low = middle
            else:
                high = middle
    return high, piece
