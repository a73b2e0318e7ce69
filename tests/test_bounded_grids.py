"""What is said of a grid as a whole, brick by brick, holds at every point of it."""

import numpy as np
import pytest
import scenes

from volcli.bounds import density_bounds, range_between, scene_bounds, source_bounds
from volcli.render import Scene, Source
from volcli.tables import ColorTable, TransferTable

REGIONS = [(0, 0, 0, 8)] + [(x, y, z, 4) for x in (0, 4) for y in (0, 4) for z in (0, 4)]
RAMP = ColorTable(np.array([0.1, 0.3, 0.31, 0.8]), np.random.default_rng(1).random((4, 3)))


def points_of(region, n=200):
    """Points of a region in local voxels of its brick, its corners (all but) among them."""
    rng = np.random.default_rng(5)
    share = np.vstack([scenes.reference.CORNERS * (1 - 2**-40), rng.random((n, 3))])
    return np.array(region[:3]) + share * region[3]


def field(brick, points, nearest):
    """A brick (9, 9, 9[, 3]) at points (n, 3), in float64."""
    brick = brick.astype(np.float64)
    cell = np.floor(points).astype(int)
    if nearest:
        return brick[tuple(cell.T)]
    total = 0.0
    for corner in scenes.reference.CORNERS:
        weight = np.where(corner, points - cell, 1 - points + cell).prod(axis=1)
        values = brick[tuple((cell + corner).T)]
        total = total + weight.reshape(-1, *[1] * (values.ndim - 1)) * values
    return total


def bricks_of(grid):
    return grid.arrays.atlas.reshape(-1, 9, 9, 9, *grid.arrays.atlas.shape[2:])


@pytest.mark.parametrize("nearest", [False, True])
@pytest.mark.parametrize("smooth", [False, True])
def test_no_density_is_farther_from_its_fit_than_said(smooth, nearest):
    values = scenes.smooth_values((11, 9, 14)) if smooth else scenes.random_values(3, (11, 9, 14))
    grid = scenes.medium(values).grid
    fits = density_bounds(grid, nearest)[0].astype(np.float64)
    closest = np.inf
    for brick, of_brick in zip(bricks_of(grid), fits, strict=True):
        for region, (a, *g, r) in zip(REGIONS, of_brick, strict=True):
            points = points_of(region)
            middle = np.array(region[:3]) + 0.5 * region[3]
            off = np.abs(field(brick, points, nearest) - a - (points - middle) @ g)
            assert off.max() <= r
            closest = min(closest, r - off.max())
    assert closest < 1e-6  # it is no more than it has to be


@pytest.mark.parametrize("nearest", [False, True])
@pytest.mark.parametrize("kind", ["three channels", "table"])
def test_no_colour_is_outside_the_range_that_is_said(kind, nearest):
    shape = (11, 9, 14)
    if kind == "table":
        source = Source(scenes.medium(scenes.random_values(3, shape)).grid, RAMP)
    else:
        source = Source(scenes.medium(scenes.random_colours(3, shape)).grid, scale=0.3)
    ranges = source_bounds(source, nearest)
    for brick, of_brick in zip(bricks_of(source.grid), ranges, strict=True):
        for region, (least, largest) in zip(REGIONS, of_brick.astype(np.float64), strict=True):
            seen = field(brick, points_of(region), nearest)
            seen = source.table.at(seen) if source.table else seen * source.scale
            assert (seen >= least - 1e-15).all() and (seen <= largest + 1e-15).all()


@pytest.mark.parametrize("nearest", [False, True])
def test_no_density_by_value_is_farther_from_its_middle_than_said(nearest):
    grid = scenes.medium(scenes.random_values(3, (11, 9, 14))).grid
    transfer = TransferTable(RAMP.knots, RAMP.colors[:, 0])
    made = scene_bounds(Scene(grid, 1.0, (1, 1, 1), transfer=transfer), nearest, threads=1)
    for brick, of_brick in zip(bricks_of(grid), made.density.astype(np.float64), strict=True):
        for region, (a, *g, r) in zip(REGIONS, of_brick, strict=True):
            assert g == [0, 0, 0]
            density = transfer.at(field(brick, points_of(region), nearest))
            assert np.abs(density - a).max() <= r + 1e-15


def test_the_range_of_a_table_is_that_of_its_ends_and_of_the_knots_between():
    rng = np.random.default_rng(0)
    knots, values = np.sort(rng.random(50)), rng.random((50, 3))
    low = rng.random((20, 9)) * 1.4 - 0.2
    high = low + rng.random((20, 9)) * rng.choice([0, 0.01, 1], (20, 9))
    found = range_between(knots, values, low, high)
    for at in np.ndindex(20, 9):
        inside = (knots >= low[at]) & (knots <= high[at])
        x = np.concatenate([[low[at], high[at]], knots[inside]])
        y = np.stack([np.interp(x, knots, channel) for channel in values.T], axis=-1)
        np.testing.assert_allclose(found[at], [y.min(axis=0), y.max(axis=0)], rtol=1e-12)


def test_the_brightest_is_what_the_scene_can_show_at_most():
    density = scenes.medium(scenes.smooth_values((8, 8, 8))).grid
    emission = Source(scenes.medium(scenes.random_colours(1, (4, 4, 4))).grid, scale=2.0)
    made = scene_bounds(Scene(density, 1.0, (0.5, 3.0, 1.0)), False)
    assert made.brightest == 3.0
    glowing = scene_bounds(Scene(density, 1.0, (0.5, 3.0, 1.0), emission), False)
    diagonal = np.linalg.norm([5, 5, 5])
    expected = 3.0 + 2 * emission.grid.arrays.atlas.max() * diagonal
    assert glowing.brightest == pytest.approx(expected, rel=1e-6)


def test_threads_do_not_change_bounds():
    grid = scenes.medium(scenes.random_values(3, (24, 24, 24))).grid
    scene = Scene(grid, 1.0, Source(grid, RAMP))
    one, two = (scene_bounds(scene, False, threads=n) for n in (1, 2))
    assert np.array_equal(one.density, two.density) and np.array_equal(one.colour, two.colour)
