"""Optical depth along lattice lines, without a ray: what the reference finds along them."""

import numpy as np
import pytest
import reference
from commandline import volcli, write_grid
from scenes import TRANSFORMS, Medium, affine, joined, random_values, tree_of

from volcli.columns import column_depths


@pytest.mark.parametrize("name", TRANSFORMS)
def test_depths_are_those_of_rays_along_the_lattice(name):
    values = random_values(3, (6, 5, 7))
    of = Medium(tree_of(values, origin=(-3, 2, 11)), TRANSFORMS[name])
    linear = of.world_from_index[:3, :3]
    steps = np.linalg.norm(linear, axis=0)
    along = int(np.argmax(np.abs(linear[2]) / steps))
    found = sorted(column_depths(of.tree, of.world_from_index))
    wanted = []
    across = [axis for axis in range(3) if axis != along]
    for place in np.ndindex(*(values.shape[axis] for axis in across)):
        start = np.zeros(3)
        start[across] = np.array(place) + np.array([-3, 2, 11])[across]
        start[along] = -40
        tau = reference.trace(of.world(start), linear[:, along] / steps[along], of.lattice()).tau
        wanted += [tau] if tau > 0 else []
    np.testing.assert_allclose(found, sorted(wanted), rtol=1e-9)


def test_tiles_count_for_all_that_they_cover_and_large_volumes_are_sampled():
    tiles = [((0, 0, 0), 128, 0.5, True), ((0, 0, 128), 8, 2.0, True)]
    tree = joined(tree_of(np.ones((8, 8, 8)), origin=(512, 0, 0)),
                  tree_of(np.empty((0, 0, 0)), tiles=tiles))  # fmt: skip
    found = column_depths(tree, np.eye(4))
    assert set(found.tolist()) == {64.0, 64.0 + 16.0, 8.0}
    assert len(found) <= 64 * 64


def test_what_is_no_density_counts_for_nothing():
    values = np.ones((8, 8, 8), np.float32)
    values[0, 0, :4] = np.nan, np.inf, -np.inf, -3
    found = column_depths(tree_of(values), affine(0.5 * np.eye(3)))
    assert sorted(set(found.tolist())) == [2.0, 4.0]
    assert len(column_depths(tree_of(np.empty((0, 0, 0))), np.eye(4))) == 0


@pytest.mark.parametrize(
    ("value", "says"),
    [(2e-4, "looks empty: try --density-scale 1000"), (50.0, "looks solid"), (0.2, "")],
)
def test_info_says_what_a_default_render_would_look_like(tmp_path, value, says):
    full = np.full((8, 8, 8), value, np.float32)
    path = write_grid(tmp_path / "a.vdb", leaves={(0, 0, 0): (full, np.ones((8, 8, 8), bool))})
    ran = volcli("info", path, "--stats")
    assert f"median optical depth through the box {4 * np.float32(value):.3g}" in ran.out
    assert says in ran.out
    assert ("looks" in ran.out) == bool(says)
    assert "optical depth" not in volcli("info", path).out
