"""Density by the value of a grid: a piecewise linear function of the cubic along a ray.

Where the cubic stays between two knots the transfer function of it is a cubic again, and all that
holds of density does. So a span is cut where its cubic crosses a knot; the place is found to
rounding, and with it the optical depth.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from volcli.kernels.compiler import jit
from volcli.kernels.crossing import first_crossing
from volcli.kernels.traversal import last_below


class Transfer(NamedTuple):
    """A piecewise linear function, constant beyond its ends.

    Attributes
    ----------
    knots
        (k,) float64, ascending.
    values
        (k,) float64.
    """

    knots: NDArray[np.float64]
    values: NDArray[np.float64]


@jit
def transfer_line(transfer, piece):
    """(slope, offset) of the function between knots ``piece`` and ``piece + 1``; before the first
    knot (-1) and after the last it is constant."""
    knots, values = transfer.knots, transfer.values
    if piece < 0:
        return 0.0, values[0]
    if piece >= len(knots) - 1:
        return 0.0, values[-1]
    slope = (values[piece + 1] - values[piece]) / (knots[piece + 1] - knots[piece])
    return slope, values[piece] - slope * knots[piece]


@jit
def transferred(transfer, x):
    """The density where the grid has the value x."""
    if transfer is None:
        return x
    slope, offset = transfer_line(transfer, last_below(transfer.knots, x))
    return slope * x + offset


@jit
def linear_piece(p, u, end, transfer):
    """Where in (u, end] the transfer function of the cubic ceases to be one cubic, and that cubic.

    Returns (to, q): q holds over [u, to].
    """
    to, piece = first_crossing(p, u, end, transfer.knots)
    slope, offset = transfer_line(transfer, piece)
    return to, (slope * p[0] + offset, slope * p[1], slope * p[2], slope * p[3])
