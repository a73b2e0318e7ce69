"""Packets of rays: the same numbers as ray by ray, whatever a packet holds.

Ray by ray is held to the reference where kernels do not compile; and packets, which are what
compiles elsewhere, by the same tests. Here the two meet, to rounding.
"""

import math
import os
import subprocess
import sys
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import scenes
from scenes import TRANSFORMS, joined, medium, tree_of

from volcli.kernels import integrator
from volcli.kernels.lanes import LANES
from volcli.kernels.rays import Density

pytestmark = [
    pytest.mark.needs_jit,
    pytest.mark.skipif(LANES == 1, reason="no registers of four numbers here: no packets"),
]

ROUNDING = 1e-13
RULES = list(product([None, 1.0, 0.3], [False, True], [False, True]))


def integrators(grid, step, nearest, depth, scale=1.0):
    """(packets, ray by ray) for one grid."""
    support = grid.support("nearest" if nearest else "linear")
    empty = grid.arrays.constants[0] == 0
    density = Density(grid.arrays, grid.local_from_world, support, scale, bool(empty))
    options = {"step_voxels": step, "nearest": nearest, "depth": depth}
    return [
        integrator.make_integrator(density, packets=packets, **options) for packets in (True, False)
    ]


def random_rays(grid, count, seed=1):
    """Rays through and past a grid from all sides, some along axes and diagonals."""
    rng = np.random.default_rng(seed)
    low, high = grid.world_box()
    reach = np.linalg.norm(high - low)
    points = rng.uniform(low - 0.1 * reach, high + 0.1 * reach, (count, 3))
    directions = rng.normal(size=(count, 3))
    steep = rng.integers(0, 2, (count // 4, 3)) * rng.choice([-1.0, 1.0], (count // 4, 3))
    steep[~steep.any(axis=1)] = (1.0, 0.0, 0.0)
    directions[: len(steep)] = steep
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    back = rng.uniform(0, 2, count)[:, None] * reach * (rng.random(count) < 0.7)[:, None]
    return points - back * directions, directions


def assert_same(grid, rule, scale=1.0, rays=None, count=301):
    step, nearest, depth = rule
    packets, single = integrators(grid, step, nearest, depth, scale)
    origins, directions = random_rays(grid, count) if rays is None else rays
    ours, theirs = packets(origins, directions), single(origins, directions)
    assert theirs[0].max() > 0, "no ray meets anything"
    np.testing.assert_allclose(ours[0], theirs[0], rtol=ROUNDING, atol=ROUNDING * theirs[0].max())
    if depth:
        np.testing.assert_array_equal(np.isinf(ours[2]), np.isinf(theirs[2]))
        np.testing.assert_allclose(ours[2], theirs[2], rtol=1e-7)
    assert ours.evaluated == theirs.evaluated


FIELDS = {
    "noise": lambda m: medium(scenes.random_values(3, (19, 30, 25)), (-7, 3, -12), m),
    "smooth": lambda m: medium(scenes.smooth_values((40, 20, 33)), (100, -60, 5), m),
}


@pytest.mark.parametrize("rule", RULES, ids=str)
@pytest.mark.parametrize("field", FIELDS)
def test_packets_are_rays_one_by_one(field, rule):
    for name in ("uniform", "all at once"):
        assert_same(FIELDS[field](TRANSFORMS[name]).grid, rule)


@pytest.mark.parametrize("rule", RULES, ids=str)
def test_packets_cross_tiles_backgrounds_and_many_root_cells(rule):
    parts = joined(
        tree_of(scenes.random_values(5, (16, 9, 8)), (-8, 0, 4090)),
        tree_of(scenes.random_values(6, (10, 10, 10)), (5000, -4100, 8)),
        tree_of(np.ones((1, 1, 1)), (0, 0, 0), tiles=[((128, 0, 0), 128, 0.5, True)]),
        tree_of(np.ones((1, 1, 1)), (16, 0, 0), tiles=[((4096, 4096, 0), 4096, 0.25, True)]),
    )
    grid = scenes.Medium(parts).grid
    step = None if rule[0] is None else rule[0] * 8
    assert_same(grid, (step, *rule[1:]), scale=1e-2)


@pytest.mark.parametrize("scale", [1e-30, 1e-6, 1.0, 1e3, 1e8, 1e30])
@pytest.mark.parametrize("step", [None, 0.5])
def test_packets_hold_for_any_extinction(scale, step):
    grid = medium(scenes.random_values(3, (12, 12, 12))).grid
    assert_same(grid, (step, False, True), scale)


@pytest.mark.parametrize("count", [1, 2, LANES - 1, LANES, LANES + 1, 5 * LANES + 3])
def test_a_packet_need_not_be_full(count):
    grid = medium(scenes.random_values(3, (12, 12, 12))).grid
    origins, directions = random_rays(grid, 64)
    assert_same(grid, (None, False, True), rays=(origins[40:][:count], directions[40:][:count]))


def test_a_ray_does_not_depend_on_its_packet():
    grid = FIELDS["noise"](TRANSFORMS["rotated"]).grid
    origins, directions = random_rays(grid, 200)
    for step in (None, 0.4):
        packets, _ = integrators(grid, step, False, True)
        tau, _, distance, _, _ = packets(origins, directions)
        order = np.random.default_rng(0).permutation(len(origins))
        for some in (order, order[:77], order[100:101]):
            again = packets(origins[some], directions[some])
            np.testing.assert_array_equal(again[0], tau[some])
            np.testing.assert_array_equal(again[2], distance[some])


def test_no_rays_are_no_work():
    grid = medium(np.ones((3, 3, 3))).grid
    packets, _ = integrators(grid, None, False, True)
    tau, _, distance, _, cells = packets(np.empty((0, 3)), np.empty((0, 3)))
    assert (len(tau), len(distance), cells) == (0, 0, 0)


NARROWER = """
import numpy as np, sys
sys.path[:0] = [{tests!r}]
import scenes
from test_packets import integrators, random_rays
from volcli.kernels.lanes import LANES
grid = scenes.medium(scenes.random_values(3, (19, 30, 25)), (-7, 3, -12)).grid
packets, single = integrators(grid, None, False, True)
rays = random_rays(grid, 101)
one, other = (packets if LANES > 1 else single)(*rays), single(*rays)
np.testing.assert_allclose(one[0], other[0], rtol=1e-13, atol=1e-13)
np.testing.assert_allclose(one[2], other[2], rtol=1e-7)
print(LANES, *(v.hex() for v in one[0][:40]))
"""


@pytest.mark.parametrize(
    "features, lanes", [("+avx,+avx2,+fma,+f16c,+bmi,+bmi2,+popcnt,+sse4.2", 4), ("+sse2", 1)]
)
def test_narrower_machines_have_narrower_packets_and_the_same_numbers(features, lanes, tmp_path):
    program = NARROWER.format(tests=str(Path(__file__).parent))
    changed = {"NUMBA_CPU_NAME": "x86-64", "NUMBA_CPU_FEATURES": features}
    ran = subprocess.run(
        [sys.executable, "-c", program],
        env={**os.environ, **changed, "XDG_CACHE_HOME": str(tmp_path), "NUMBA_CACHE_DIR": ""},
        capture_output=True,
        text=True,
    )
    assert ran.returncode == 0, ran.stderr
    width, *taus = ran.stdout.split()
    assert int(width) == lanes
    grid = medium(scenes.random_values(3, (19, 30, 25)), (-7, 3, -12)).grid
    here = integrators(grid, None, False, True)[0](*random_rays(grid, 101))[0]
    np.testing.assert_allclose([float.fromhex(t) for t in taus], here[:40], rtol=1e-13, atol=1e-13)


def test_exp_of_lanes_is_right_to_two_units_of_the_last_place():
    import numba

    from volcli.kernels.compiler import _OPTIONS
    from volcli.kernels.lane_memory import load, store

    @numba.njit(**_OPTIONS)
    def exp(x, out):
        for first in range(0, len(x), LANES):
            store(out, first, math.exp(load(x, first)))

    points = [np.linspace(-1, 0, 400), np.linspace(-707.9, -1, 400), np.geomspace(1e-300, 1, 400)]
    x = np.concatenate([points[0], points[1], -points[2]])
    out = np.empty_like(x)
    exp(x, out)
    exact = np.exp(x.astype(np.longdouble))
    assert (np.abs(out - exact) / np.spacing(exact.astype(np.float64))).max() <= 2.0
    far = -np.geomspace(709, 1e300, 8 * LANES)
    far[-1] = -np.inf
    exp(far, out)
    assert (out[: len(far)] == 0.0).all()
