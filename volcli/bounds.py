"""What a scene's grids are at most and at least, brick by brick: what a certified error rests on.

Made once a scene, of what is in memory, and only where an error is allowed. What the numbers mean
is said in `kernels.bounds`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from volcli.grids import BrickGrid
from volcli.grids.brick import to_world
from volcli.grids.threads import in_threads, threads_limited_to

if TYPE_CHECKING:
    from volcli.render import Scene, Source

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class SceneBounds:
    """The bounds of a scene's grids.

    Attributes
    ----------
    density
        (n, 9, 5) float32; see `kernels.bounds.Bounds`.
    least, finest, boxes
        (n,) float32, (n,) float32 and (n,) int32; None under a transfer function.
    colour, emission
        (m, 9, 2, 3) float32, or None where there is no such source.
    brightest
        The light that errors of radiance are shares of: the largest that the scene can show. That
        is the largest magnitude of a colour, and, where there is emission, the largest magnitude of
        that along the diagonal of the box that it fills, in world units.
    contrast
        The difference between any two radiances that the scene can show, as a share of that at
        most: 1, or up to 2 where some are negative.
    """

    density: NDArray[np.float32]
    least: NDArray[np.float32] | None
    finest: NDArray[np.float32] | None
    boxes: NDArray[np.int32] | None
    colour: NDArray[np.float32] | None
    emission: NDArray[np.float32] | None
    brightest: float
    contrast: float


BYTES_A_BRICK = 9 * 5 * 4 + 3 * 4
"""What the bounds of a brick of density take."""

BYTES_A_BRICK_OF_SOURCE = 9 * 2 * 3 * 4
"""What the bounds of a brick of colour or emission take."""

_BRICKS = 4096
"""Bricks that a thread works on at a time."""


def scene_bounds(scene: Scene, nearest: bool, threads: int | None = None) -> SceneBounds:
    """The bounds of all grids of a scene.

    Parameters
    ----------
    nearest
        Whether values are those of the nearest voxel.
    threads
        Default: the processors that this process may use.
    """
    colour = emission = least = finest = boxes = None
    with threads_limited_to(threads):
        if scene.transfer is None:
            density, least, finest, boxes = density_bounds(scene.density, nearest)
        else:
            density = _transferred_bounds(scene, nearest)
        colour, emission, (low, high) = _lights(scene, nearest)
    brightest = max(-low, high)
    contrast = (high - low) / brightest if brightest > 0 else 1.0
    return SceneBounds(density, least, finest, boxes, colour, emission, brightest, contrast)


def brightest_light(scene: Scene, nearest: bool, threads: int | None = None) -> float:
    """`SceneBounds.brightest` of a scene whose bounds may not have been made."""
    if scene.bounds is not None:
        return scene.bounds.brightest
    with threads_limited_to(threads):
        low, high = _lights(scene, nearest)[2]
    return max(-low, high)


def _lights(
    scene: Scene, nearest: bool
) -> tuple[NDArray[np.float32] | None, NDArray[np.float32] | None, tuple[float, float]]:
    """`SceneBounds.colour` and ``emission``; the least and the largest light, 0 among it, that the
    scene can show in any channel."""
    colour = emission = None
    if isinstance(scene.color, tuple):
        low, high = min(0.0, *scene.color), max(0.0, *scene.color)
    else:
        colour = source_bounds(scene.color, nearest)
        low, high = _field(scene.color, colour)
    if scene.emission is not None:
        emission = source_bounds(scene.emission, nearest)
        dark, light = _field(scene.emission, emission)
        longest = _diagonal(scene.emission.grid)
        low, high = low + dark * longest, high + light * longest
    return colour, emission, (low, high)


def density_bounds(grid: BrickGrid, nearest: bool) -> tuple[Any, Any, Any, Any]:
    """(n, 9, 5): the linear fits of each brick of a density and of its octants; (n,): the bricks'
    least values; (n,): the smallest r of their octants; (n,): their boxes."""
    from volcli.kernels.bounds import FIT, REGIONS, fit_bricks

    atlas = grid.arrays.atlas
    fits = np.empty((len(atlas), REGIONS, FIT), np.float32)
    least, finest = np.empty((2, len(atlas)), np.float32)
    boxes = np.empty(len(atlas), np.int32)
    _by_parts(
        lambda part: fit_bricks(
            atlas[part], nearest, fits[part], least[part], finest[part], boxes[part]
        ),
        len(atlas),
    )
    return fits, least, finest, boxes


def source_bounds(source: Source, nearest: bool) -> NDArray[np.float32]:
    """(m, 9, 2, 3): the least and the largest of the colours in each brick and octant."""
    table = source.table
    ranges = _value_ranges(source.grid, nearest)
    if table is None:
        return _outwards(ranges.astype(np.float64) * source.scale)
    of_values = ranges[..., 0].astype(np.float64)
    return _outwards(
        range_between(table.knots, table.colors, of_values[:, :, 0], of_values[:, :, 1])
    )


def range_between(knots: Floats, values: Floats, low: Floats, high: Floats) -> Floats:
    """The range of a piecewise linear function, constant beyond its ends, between two arguments.

    Parameters
    ----------
    knots, values
        (k,) ascending, and (k, c).
    low, high
        (n, 9), from and to where.

    Returns
    -------
    (n, 9, 2, c): the least, then the largest. They are at an end, or at a knot between.
    """
    first = np.searchsorted(knots, low, side="right")
    count = np.searchsorted(knots, high, side="left") - first
    ends = np.array(
        [[np.interp(x, knots, of_one) for of_one in values.T] for x in (low, high)]
    )  # (2, c, n, 9)
    ends = np.moveaxis(ends, 1, -1)
    least, largest = ends.min(axis=0), ends.max(axis=0)
    between = count > 0
    first, count = first[between], count[between]
    least[between] = np.minimum(least[between], _over_runs(np.minimum, values, first, count))
    largest[between] = np.maximum(largest[between], _over_runs(np.maximum, values, first, count))
    return np.stack([least, largest], axis=2)


def _over_runs(best: Any, values: Floats, first: NDArray[Any], count: NDArray[Any]) -> Floats:
    """(n, c): the least (np.minimum) or largest (np.maximum) of ``count`` values from ``first`` on.

    Two runs of a power of two cover any; those are made once.
    """
    found = np.empty((len(first), values.shape[1]))
    power = np.frexp(count)[1] - 1  # count is 2**power to 2**(power + 1) - 1
    runs, width = values, 1
    for level in range(int(power.max(initial=-1)) + 1):
        now = power == level
        found[now] = best(runs[first[now]], runs[(first + count)[now] - width])
        runs, width = best(runs[:-width], runs[width:]), 2 * width
    return found


def _transferred_bounds(scene: Scene, nearest: bool) -> NDArray[np.float32]:
    """As `density_bounds`, under a transfer function: the middle of its range, without a slope."""
    from volcli.kernels.bounds import FIT, REGIONS, SMALLEST, UPWARDS

    assert scene.transfer is not None
    values = _value_ranges(scene.density, nearest)[..., 0].astype(np.float64)
    knots, densities = scene.transfer.knots, scene.transfer.values[:, None]
    ranges = range_between(knots, densities, values[:, :, 0], values[:, :, 1])[..., 0]
    fits = np.zeros((len(ranges), REGIONS, FIT), np.float32)
    fits[..., 0] = ranges.mean(axis=2)
    off = np.abs(ranges - fits[..., :1]).max(axis=2)
    fits[..., 4] = np.where(off > 0, np.maximum(off * UPWARDS, SMALLEST), 0.0)
    return fits


def _value_ranges(grid: BrickGrid, nearest: bool) -> NDArray[np.float32]:
    """(n, 9, 2, c): the least and the largest value of each channel in each brick and octant."""
    from volcli.kernels.bounds import REGIONS
    from volcli.kernels.ranges import brick_ranges

    atlas = grid.arrays.atlas
    atlas = atlas if atlas.ndim == 3 else atlas[..., None]
    ranges = np.empty((len(atlas), REGIONS, 2, atlas.shape[2]), np.float32)
    _by_parts(lambda part: brick_ranges(atlas[part], nearest, ranges[part]), len(atlas))
    return ranges


def _field(source: Source, ranges: NDArray[np.float32]) -> tuple[float, float]:
    """The least and the largest that a source gives, 0 among it: in bricks and in constants."""
    constants = source.grid.arrays.constants.astype(np.float64)
    colours = constants * source.scale if source.table is None else source.table.at(constants)
    parts = (colours, ranges)
    low = min(float(part.min(initial=0.0)) for part in parts)
    return low, max(float(part.max(initial=0.0)) for part in parts)


def _diagonal(grid: BrickGrid) -> float:
    """That of the box beyond which the field is its background, in world units."""
    if grid.is_empty:
        return 0.0
    box = grid.active_box + np.array([[-1], [1]])
    return float(np.linalg.norm(np.ptp(to_world(box, grid.world_from_index), axis=0)))


def _by_parts(work: Callable[[slice], None], bricks: int) -> None:
    work(slice(0, 0))  # compiles
    for _ in in_threads(work, [slice(n, n + _BRICKS) for n in range(0, bricks, _BRICKS)]):
        pass


def _outwards(ranges: Floats) -> NDArray[np.float32]:
    """(n, 9, 2, c) to float32: what was least no larger, what was largest no smaller."""
    with np.errstate(over="ignore"):  # beyond float32 it is Inf, which bounds as well
        rounded = ranges.astype(np.float32)
    low, high = rounded[:, :, 0], rounded[:, :, 1]
    down = np.nextafter(low, np.float32(-np.inf), where=low > ranges[:, :, 0], out=low.copy())
    up = np.nextafter(high, np.float32(np.inf), where=high < ranges[:, :, 1], out=high.copy())
    return np.stack([down, up], axis=2)
