"""Colour maps by matplotlib's names, and values to where they lie in one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from volcli.srgb import srgb_from_linear
from volcli.tables import map_colors

DECADES = 6
"""A logarithmic scale goes down to this many powers of ten below its largest value."""


def shades(name: str) -> NDArray[np.uint8]:
    """(256, 3): a colour map as it is shown (sRGB), from its first colour to its last.

    Raises
    ------
    UsageError
        matplotlib has no such map; suggests one.
    """
    linear = map_colors(name, "--colormap")
    return np.rint(255 * srgb_from_linear(linear)).astype(np.uint8)


def limits(name: str, values: NDArray[np.float32], logarithmic: bool) -> tuple[float, float]:
    """What the ends of the colour map stand for: 0 and 1 where a map fills much of that range,
    else the smallest and the largest finite value.

    With ``logarithmic`` the lower end is the smallest value above 0, or `DECADES` below the upper.
    """
    finite = values[np.isfinite(values)]
    if logarithmic:
        positive = finite[finite > 0]
        if not positive.size:
            return 1e-6, 1.0
        high = float(positive.max())
        return max(float(positive.min()), high * 10.0**-DECADES), high
    if not finite.size:
        return 0.0, 1.0
    low, high = float(finite.min()), float(finite.max())
    if name in ("opacity", "transmittance") and high - low > 0.5:
        return 0.0, 1.0
    if name in ("opacity", "optical_depth"):
        low = 0.0
    return (low, high) if high > low else (low, low + 1.0)
