"""What a scene's grids are at most and at least, brick by brick: what a certified error rests on.

Made once a scene, of what is in memory, and only where an error is allowed. What the numbers mean
is said in `kernels.bounds`.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from volcli.grids import BrickGrid


@dataclass(frozen=True)
class SceneBounds:
    """The bounds of a scene's grids.

    Attributes
    ----------
    density
        (n, 9, 5) float32; see `kernels.bounds.Bounds`.
    colour, emission
        (m, 9, 2, 3) float32, or None where there is no such source.
    brightest
        The light that errors of radiance are shares of: the largest that the scene can show.
    """

    density: NDArray[np.float32]
    colour: NDArray[np.float32] | None
    emission: NDArray[np.float32] | None
    brightest: float


BYTES_A_BRICK = 9 * 5 * 4
"""What the bounds of a brick of density take."""

_BRICKS = 4096
"""Bricks that a thread works on at a time."""


def density_bounds(grid: BrickGrid, nearest: bool, threads: int) -> NDArray[np.float32]:
    """(n, 9, 5): the linear fits of each brick of a density and of its octants."""
    from volcli.kernels.bounds import FIT, REGIONS, fit_bricks

    atlas = grid.arrays.atlas
    fits = np.empty((len(atlas), REGIONS, FIT), np.float32)
    fit_bricks(atlas[:0], nearest, fits[:0])  # compiles
    with ThreadPoolExecutor(threads) as pool:
        parts = [slice(n, n + _BRICKS) for n in range(0, len(atlas), _BRICKS)]
        for _ in pool.map(lambda part: fit_bricks(atlas[part], nearest, fits[part]), parts):
            pass
    return fits
