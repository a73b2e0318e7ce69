"""No error above its own certificate, and no certificate above what was allowed: optical depth.

The truth is the exact rule, which other tests hold to a reference; a certificate is of float64.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scenes
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import TRANSFORMS, joined, medium, plan_for, tree_of
from test_packets import random_rays

from volcli.bounds import density_bounds, scene_bounds
from volcli.camera import make_camera
from volcli.grids import density_grid, load_density, open_volume
from volcli.render import Scene, make_integrator
from volcli.schema import Camera

ERRORS = (1e-1, 1e-2, 1 / 255, 1e-3, 1e-4, 1e-5)
ROUNDING = 1e-11
"""What float64 may add; a picture's certificate has 1e-7 for that and for float32."""

REAL = Path(__file__).parents[2] / "shared/volumes/real"
FILES = {
    "cloud": Path(__file__).parents[1] / "samples/cloud.vdb",
    "smoke": REAL / "smoke.vdb",
    "wdas cloud": REAL / "wdas_cloud_sixteenth.vdb",
}
PICTURES = frozenset({"transmittance"})


def certified(scene, error, rays, layers=PICTURES, nearest=False):
    """What the certified rule, or the exact one (None), makes of rays."""
    bounds = scene_bounds(scene, nearest, 1) if scene.bounds is None else scene.bounds
    plan = replace(plan_for(layers, nearest=nearest), max_error=error)
    return make_integrator(replace(scene, bounds=bounds), plan)(*rays)


def off(seen, exact, tint=(1.0,)):
    """The largest error of transmittance of each ray, over channels."""
    return np.max([np.abs(np.exp(-k * seen.tau) - np.exp(-k * exact.tau)) for k in tint], axis=0)


def assert_certified(scene, rays, errors=ERRORS, nearest=False, layers=PICTURES):
    tint = (1.0,) if scene.tint is None else scene.tint
    exact = certified(scene, None, rays, layers, nearest)
    assert exact.tau.max() > 0, "no ray meets anything"
    shares = []
    for error in errors:
        seen = certified(scene, error, rays, layers, nearest)
        assert seen.error.max() <= error
        worse = off(seen, exact, tint) - seen.error
        assert worse.max() <= ROUNDING, f"{worse.max():g} above its certificate at {error:g}"
        shares.append(seen.evaluated / exact.evaluated)
    return shares


def file_scene(name, extinction, resolution=(96, 72)):
    """(scene, rays) of a volume file; ``extinction`` is that of its largest density, per voxel."""
    path = FILES[name]
    if not path.exists():
        pytest.skip(f"{path} is not here")
    volume = open_volume(path)
    grid, _ = load_density(volume, density_grid(volume, None)[0], "error")
    voxel = abs(np.linalg.det(grid.world_from_index[:3, :3])) ** (1 / 3)
    scale = extinction / voxel / grid.field_range[1]
    scene = Scene(grid, scale, (1.0, 1.0, 1.0))
    camera = make_camera(Camera(resolution=resolution), grid.world_box())
    rays = camera.rays(slice(None), slice(None))
    return replace(scene, bounds=scene_bounds(scene, False, 1)), rays


@pytest.mark.needs_jit
@pytest.mark.parametrize("extinction", [0.005, 0.05, 0.5])
@pytest.mark.parametrize("name", FILES)
def test_real_volumes_keep_to_their_certificates_and_take_less_work_for_more_error(
    name, extinction
):
    scene, rays = file_scene(name, extinction)
    shares = assert_certified(scene, rays)
    assert shares == sorted(shares), "work falls as the error grows"
    assert shares[0] < 0.95 * shares[-1]


@pytest.mark.needs_jit
@pytest.mark.parametrize("name", FILES)
def test_an_error_of_a_hundredth_saves_three_tenths_of_the_work(name):
    scene, rays = file_scene(name, 0.05, (256, 192))
    exact = certified(scene, None, rays)
    assert certified(scene, 1e-2, rays).evaluated <= 0.7 * exact.evaluated


FIELDS = {
    "noise": medium(scenes.random_values(3, (19, 30, 25)), (-7, 3, -12)),
    "smooth": medium(scenes.smooth_values((40, 20, 33)), (100, -60, 5)),
    "tiles": scenes.Medium(
        joined(
            tree_of(scenes.random_values(5, (16, 9, 8)), (-8, 0, 4090)),
            tree_of(np.ones((1, 1, 1)), (0, 0, 0), tiles=[((128, 0, 0), 128, 0.5, True)]),
            tree_of(np.ones((1, 1, 1)), (16, 0, 0), tiles=[((4096, 4096, 0), 4096, 0.25, True)]),
        )
    ),
    "a plane": medium(np.tile(np.linspace(0, 1, 17, dtype=np.float32)[:, None, None], (1, 17, 17))),
    "background": medium(scenes.random_values(8, (9, 9, 9)), background=0.3),
}


@pytest.mark.parametrize("scale", [1e-30, 1e-3, 0.3, 30.0, 1e12])
@pytest.mark.parametrize("nearest", [False, True])
@pytest.mark.parametrize("field", FIELDS)
def test_fields_of_all_kinds_keep_to_their_certificates(field, nearest, scale):
    grid = FIELDS[field].grid
    rays = random_rays(grid, 61)
    assert_certified(Scene(grid, scale, (1.0, 1.0, 1.0)), rays, (0.3, 1e-2, 1e-5), nearest)


@pytest.mark.parametrize("transform", TRANSFORMS)
def test_any_transform_keeps_to_its_certificates(transform):
    grid = medium(FIELDS["noise"].tree.leaf_values[0], (5, 5, 5), TRANSFORMS[transform]).grid
    rays = random_rays(grid, 61)
    assert_certified(Scene(grid, 0.7, (1.0, 1.0, 1.0)), rays, (0.1, 1e-3))


@pytest.mark.parametrize("tint", [(0.1, 1.0, 7.0), (0.0, 0.0, 1e-3), (5.0, 5.0, 5.0)])
def test_each_channel_of_a_tint_keeps_to_the_certificate(tint):
    grid = FIELDS["smooth"].grid
    scene = Scene(grid, 0.2, (1.0, 1.0, 1.0), tint=tint)
    assert_certified(scene, random_rays(grid, 101), (0.1, 1e-2, 1e-4))


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    scale=st.floats(-6, 6).map(lambda x: 10.0**x),
    error=st.floats(-5, -0.05).map(lambda x: 10.0**x),
    rough=st.booleans(),
)
def test_whatever_the_field_the_extinction_and_the_error(seed, scale, error, rough):
    values = scenes.random_values(seed, (13, 10, 17))
    if not rough:
        values = np.maximum(values - 0.7, 0)  # mostly nothing
    grid = medium(values).grid
    assert_certified(Scene(grid, scale, (1.0, 1.0, 1.0)), random_rays(grid, 31, seed), (error,))


def test_a_linear_field_is_taken_by_the_brick_and_is_exact():
    grid = FIELDS["a plane"].grid
    rays = (np.array([[8.0, 8.0, -9.0]]), np.array([[0.0, 0.0, 1.0]]))
    scene = Scene(grid, 1.0, (1.0, 1.0, 1.0))
    inside = certified(scene, 1e-5, rays)
    exact = certified(scene, None, rays)
    assert inside.tau == pytest.approx(exact.tau, rel=1e-5)
    assert inside.evaluated < exact.evaluated


def test_depth_is_that_of_the_rule_that_is_certified():
    grid = FIELDS["smooth"].grid
    scene = Scene(grid, 0.2, (1.0, 1.0, 1.0))
    rays = random_rays(grid, 301)
    layers = frozenset({"transmittance", "depth"})
    exact = certified(scene, None, rays, layers)
    seen = certified(scene, 1e-4, rays, layers)
    hit = np.isfinite(exact.distance) & (exact.tau > 0.1)
    assert hit.sum() > 20
    np.testing.assert_allclose(seen.distance[hit], exact.distance[hit], atol=0.02)


def test_a_certified_ray_does_not_depend_on_its_packet():
    grid = FIELDS["noise"].grid
    scene = Scene(grid, 0.3, (1.0, 1.0, 1.0))
    origins, directions = random_rays(grid, 120)
    layers = frozenset({"transmittance", "depth"})
    whole = certified(scene, 0.05, (origins, directions), layers)
    order = np.random.default_rng(0).permutation(len(origins))
    for some in (order, order[:77], order[100:101]):
        again = certified(scene, 0.05, (origins[some], directions[some]), layers)
        np.testing.assert_array_equal(again.tau, whole.tau[some])
        np.testing.assert_array_equal(again.error, whole.error[some])
        np.testing.assert_array_equal(again.distance, whole.distance[some])


def test_nothing_of_a_brick_lies_outside_its_box():
    values = scenes.random_values(3, (24, 24, 24))
    values[np.random.default_rng(1).random(values.shape) < 0.995] = 0
    for nearest in (False, True):
        grid = medium(values).grid
        _, least, _, boxes = density_bounds(grid, nearest)
        points = 8 if nearest else 9
        atlas = grid.arrays.atlas.reshape(-1, 9, 9, 9)
        for brick, low, box in zip(atlas, least, boxes, strict=True):
            inside = brick[:points, :points, :points]
            assert low == inside.min()
            lo = [box >> 4 * axis & 15 for axis in range(3)]
            hi = [box >> 4 * axis + 12 & 15 for axis in range(3)]
            cells = np.zeros((8, 8, 8), bool)  # those that are not 0 at some corner
            for corner in np.ndindex(*(1 if nearest else 2,) * 3):
                cut = tuple(slice(c, c + 8) for c in corner)
                cells |= brick[cut] != 0
            used = np.argwhere(cells)
            if len(used):
                assert lo == used.min(axis=0).tolist() and hi == (used.max(axis=0) + 1).tolist()
            else:
                assert any(a >= b for a, b in zip(lo, hi, strict=True))
