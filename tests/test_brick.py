"""`BrickGrid` against the tree that it is built from, by lookups that know neither's inside."""

from dataclasses import replace

import numpy as np
import pytest
import reference
import scenes
from scenes import Medium, affine, joined, medium, tree_of

from volcli.grids.build import build

CORNERS = reference.CORNERS


def entry_at(grid, cell):
    """(entry, lowest voxel): what the tables say of the brick around a cell of index space."""
    arrays = grid.arrays
    local = np.asarray(cell, np.int64) - grid.origin
    planes = (arrays.planes_x, arrays.planes_y, arrays.planes_z)
    at = [int(np.searchsorted(p, x, side="right")) - 1 for p, x in zip(planes, local, strict=True)]
    if any(not 0 <= a < len(p) - 1 for a, p in zip(at, planes, strict=True)):
        return -1, None
    key = (at[0] * (len(planes[1]) - 1) + at[1]) * (len(planes[2]) - 1) + at[2]
    known = dict(zip(arrays.root_keys.tolist(), arrays.root_entries.tolist(), strict=True))
    entry = known.get(key, -1)
    if entry < 0:
        return entry, None
    entry = int(arrays.upper[entry].reshape(32, 32, 32)[tuple(local // 128 % 32)])
    if entry < 0:
        return entry, None
    entry = int(arrays.lower[entry].reshape(16, 16, 16)[tuple(local // 8 % 16)])
    return entry, local // 8 * 8


def corners_of(grid, cell):
    """The eight values around a cell, as the kernels find them."""
    entry, low = entry_at(grid, cell)
    if entry < 0:
        return np.broadcast_to(
            grid.arrays.constants[-1 - entry], (8, *grid.arrays.constants.shape[1:])
        )
    brick = grid.arrays.atlas[entry].reshape(9, 9, 9, *grid.arrays.atlas.shape[2:])
    i, j, k = np.asarray(cell) - grid.origin - low
    return np.array([brick[i + x, j + y, k + z] for x, y, z in CORNERS])


def assert_same_field(tree, cells):
    grid = Medium(tree).grid
    at = reference.of_tree(tree)
    for cell in np.asarray(cells):
        expected = at(cell + CORNERS).astype(np.float32)
        np.testing.assert_array_equal(corners_of(grid, cell), expected, err_msg=str(cell))


def cells_around(boxes, count, seed=0):
    """Random cells in and around boxes, and the cells at their corners."""
    rng = np.random.default_rng(seed)
    found = []
    for low, high in boxes:
        low, high = np.array(low), np.array(high)
        found.append(rng.integers(low - 3, high + 3, (count, 3)))
        found.append(np.where(CORNERS, high, low))
        found.append(np.where(CORNERS, high, low) - 1)
    return np.concatenate(found)


PLACES = [(0, 0, 0), (-3, 5, 121), (4090, -4100, 125), (-(2**30), 2**30, -7)]


@pytest.mark.parametrize("origin", PLACES, ids=str)
@pytest.mark.parametrize("background", [0.0, 0.25])
def test_every_cell_finds_the_eight_values_of_the_tree(origin, background):
    values = scenes.random_values(1, (17, 9, 12))
    tree = tree_of(values, origin, background)
    low = np.array(origin)
    assert_same_field(tree, cells_around([(low, low + values.shape)], 300))


def test_colour_bricks_hold_three_channels():
    values = scenes.random_colours(2, (10, 11, 9))
    tree = tree_of(values, (-5, 3, 122), (1.0, 0.5, 0.0))
    assert_same_field(tree, cells_around([((-5, 3, 122), (5, 14, 131))], 200))


TILED = tree_of(
    scenes.random_values(3, (16, 16, 16)),
    (128, 40, 40),
    0.125,
    tiles=[
        ((0, 0, 0), 128, 0.7, True),
        ((128, 56, 40), 8, 0.4, True),
        ((128, 64, 40), 8, 0.7, False),
        ((-4096, 0, 0), 4096, 0.3, True),
        ((-4096, 4096, 0), 4096, 0.3, True),
        ((-4096, -4096, 0), 4096, 0.125, True),
    ],
)


def test_tiles_and_leaves_and_the_surfaces_between_them_are_one_field():
    boxes = [
        ((0, 0, 0), (128, 128, 128)),
        ((128, 40, 40), (144, 56, 56)),
        ((128, 56, 40), (136, 72, 48)),
        ((-4096, 0, 0), (0, 4096, 4096)),
        ((-4096, 4096, 0), (0, 8192, 4096)),
    ]
    assert_same_field(TILED, cells_around(boxes, 250))


def test_the_apron_of_every_brick_is_its_neighbours_first_layer():
    values = scenes.random_values(4, (30, 30, 30), zeros=0.0)
    m = medium(values, (100, -20, 4080))
    at = reference.of_tree(m.tree)
    grid = m.grid
    seen = set()
    for low in np.ndindex(6, 6, 6):
        cell = np.array([88, -32, 4064]) + 8 * np.array(low)
        entry, local = entry_at(grid, cell)
        if entry < 0:
            continue
        seen.add(entry)
        points = np.array(list(np.ndindex(9, 9, 9))) + local + grid.origin
        np.testing.assert_array_equal(grid.arrays.atlas[entry], at(points).astype(np.float32))
    assert seen == set(range(len(grid.arrays.atlas))), "every brick is somewhere"


def test_one_voxel_at_a_leafs_lowest_corner_has_its_skirt_in_eight_bricks():
    assert len(medium(np.ones((1, 1, 1)), (8, 8, 8)).grid.arrays.atlas) == 8
    assert len(medium(np.ones((1, 1, 1)), (0, 0, 0)).grid.arrays.atlas) == 8
    assert len(medium(np.ones((1, 1, 1)), (12, 12, 12)).grid.arrays.atlas) == 1


def test_bricks_of_background_alone_are_not_kept():
    values = np.zeros((64, 64, 64), np.float32)
    values[3, 3, 3] = values[60, 60, 60] = 1
    assert len(medium(values).grid.arrays.atlas) == 2


def test_surfaces_of_tiles_are_shared():
    """A brick between constants is known by them. Around one value there are 26 kinds (faces, edges
    and corners, each side), whether it fills 100 tiles of 8 or one of 4096."""
    tiles = [((8 * i, 8 * j, 0), 8, 0.5, True) for i in range(10) for j in range(10)]
    grid = Medium(tree_of(np.empty((0, 0, 0)), tiles=tiles)).grid
    assert len(grid.arrays.atlas) <= 27
    solid = Medium(tree_of(np.empty((0, 0, 0)), tiles=[((0, 0, 0), 4096, 0.5, True)])).grid
    assert len(solid.arrays.atlas) <= 26
    assert solid.nbytes < 4e6


def test_memory_does_not_depend_on_the_bounding_box():
    values = scenes.random_values(5, (8, 8, 8), zeros=0.0)
    near = Medium(joined(tree_of(values, (0, 0, 0)), tree_of(values, (9000, 9000, 9000)))).grid
    far = Medium(joined(tree_of(values, (0, 0, 0)), tree_of(values, (2**30,) * 3))).grid
    assert far.nbytes < 1.5 * near.nbytes
    assert far.nbytes < 4e6


def test_local_voxels_count_from_the_origin():
    m = medium(np.ones((3, 3, 3)), (-100, 7, 5000), affine(np.diag([0.5, -2.0, 3.0]), (1, 2, 3)))
    local = m.grid.local_from_world @ np.append(m.world((-99, 8, 5001)), 1.0)
    np.testing.assert_allclose(local, np.array([-99, 8, 5001]) - m.grid.origin, atol=1e-9)


def test_the_active_box_holds_what_is_active_or_differs_from_the_background():
    values = np.zeros((20, 20, 20), np.float32)
    active = np.zeros(values.shape, bool)
    values[4, 9, 2] = 1  # differs, not active
    active[17, 3, 11] = True  # active, is the background
    grid = Medium(tree_of(values, (-6, 100, 0), active=active)).grid
    np.testing.assert_array_equal(grid.active_box, [[-2, 103, 2], [11, 109, 11]])
    assert not grid.is_empty


def test_the_active_box_holds_tiles():
    tree = tree_of(np.ones((1, 1, 1)), (500, 0, 0), tiles=[((0, -128, 8), 8, 1.0, True)])
    np.testing.assert_array_equal(Medium(tree).grid.active_box, [[0, -128, 0], [500, 0, 15]])


def test_a_grid_of_nothing_is_empty():
    nothing = tree_of(np.zeros((8, 8, 8)), active=np.zeros((8, 8, 8), bool))
    for tree in (nothing, tree_of(np.empty((0, 0, 0)))):
        grid = Medium(tree).grid
        assert grid.is_empty
        assert len(grid.arrays.atlas) == 0


def test_support_reaches_one_voxel_or_half_a_voxel_beyond_the_active_box():
    grid = medium(np.ones((2, 3, 4)), (10, 20, -30)).grid
    box = np.array([[10, 20, -30], [11, 22, -27]]) - grid.origin
    np.testing.assert_array_equal(grid.support("linear") - box, [[-1.0] * 3, [1.0] * 3])
    np.testing.assert_array_equal(grid.support("nearest") - box, [[-0.5] * 3, [0.5] * 3])


def test_the_world_box_is_around_the_lattice_points_under_any_transform():
    m = medium(np.ones((2, 3, 4)), (1, 1, 1), affine(np.array([[0, -1, 0], [2, 0, 0], [0, 0, 1]])))
    np.testing.assert_array_equal(m.grid.world_box(), [[-3, 2, 1], [-1, 4, 4]])


def test_values_of_every_type_become_float32():
    base = tree_of(np.arange(27, dtype=np.float32).reshape(3, 3, 3))
    wanted = Medium(base).grid.arrays.atlas
    for dtype in (np.float16, np.float64, np.int32, np.int64, np.uint8):
        tree = replace(
            base,
            background=base.background.astype(dtype),
            leaf_values=base.leaf_values.astype(dtype),
            tile_values=base.tile_values.astype(dtype),
        )
        atlas = build(tree, scenes.header(np.eye(4))).arrays.atlas
        assert atlas.dtype == np.float32
        np.testing.assert_array_equal(atlas, wanted)


def test_the_order_of_leaves_and_tiles_does_not_matter():
    shuffled = {}
    for kind in ("leaf", "tile"):
        names = [n for n in type(TILED).__dataclass_fields__ if n.startswith(kind)]
        order = np.random.default_rng(0).permutation(len(getattr(TILED, names[0])))
        shuffled |= {n: getattr(TILED, n)[order] for n in names}
    cells = cells_around([((120, 30, 30), (150, 80, 60))], 150)
    assert_same_field(replace(TILED, **shuffled), cells)
