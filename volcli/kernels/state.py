"""What is known of a ray up to some distance, and how extinction alone changes it."""

from __future__ import annotations

import math
from typing import NamedTuple

from volcli.kernels.compiler import jit


class State(NamedTuple):
    """What is known of a ray up to some distance.

    Attributes
    ----------
    tau
        Optical depth.
    T
        Transmittance, exp(-tau): kept up within a brick, taken afresh from tau at the next.
    r, g, b
        Radiance.
    moment
        The integral of t T sigma dt, for the expected hit distance.
    t_far
        Where the ray leaves the volume: no hit is farther.
    error
        What transmittance, and radiance as a share of the brightest, is off by at most; 0 by a rule
        that certifies nothing.
    """

    tau: float
    T: float
    r: float
    g: float
    b: float
    moment: float
    t_far: float
    error: float


@jit
def darken(state, tau):
    """The state after an optical depth of tau whose light is not asked for, or too weak to count.

    T is left behind: it is taken afresh from tau before it is used again.
    """
    total, T, r, g, b, moment, t_far, error = state
    return State(total + tau, T, r, g, b, moment, t_far, error)


@jit
def refresh(state):
    """The state with T taken from tau, so that no product of many factors builds up."""
    tau, _, r, g, b, moment, t_far, error = state
    return State(tau, math.exp(-tau), r, g, b, moment, t_far, error)


@jit
def strongest(tint):
    """The largest factor of the extinction that any sum of the ray's uses."""
    return 1.0 if tint is None else max(1.0, max(tint[0], max(tint[1], tint[2])))


@jit
def weakest(tint):
    """The smallest factor of the extinction that any sum of the ray's uses."""
    return 1.0 if tint is None else min(1.0, min(tint[0], min(tint[1], tint[2])))
