"""Images against truth that shares no code with them: `reference`, closed forms and symmetries.

Tolerances: a transmittance is at most 1, so rounding it to float32 costs 3e-8; `EXACT` leaves as
much again for sums in float64, and is twenty times inside what volcli promises (2e-6).
"""

from dataclasses import replace
from functools import cache
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import reference
import scenes
from scenes import TRANSFORMS, Medium, View, affine, medium, rotation, shoot, tree_of, truth

from volcli import quadrature
from volcli.grids import load_density, open_volume
from volcli.render import over

EXACT = 1e-7
SAME_IMAGE = 5e-6
PROMISED_COLOUR = 1e-4  # of the brightest
PROMISED_DEPTH = 1e-6  # of the distance
DEPTH = 1e-4  # of the distance, where cells are thick or noise; see the tests of depth

REAL = Path(__file__).parents[2] / "shared" / "volumes" / "real"


def transmittance(tau):
    return np.exp(-tau)


def off(values, expected):
    """The largest difference."""
    return float(np.abs(np.asarray(values, np.float64) - expected).max())


def assert_depth(result, view, distance, tolerance=DEPTH):
    """Expected hit distances, taken along the camera's axis; +inf where nothing is hit."""
    _, directions = view.rays
    forward = np.subtract(view.target, view.eye) / np.linalg.norm(
        np.subtract(view.target, view.eye)
    )
    hit = np.isfinite(distance)
    assert hit.any(), "the view shows nothing"
    np.testing.assert_array_equal(np.isposinf(result.depth), ~hit)
    expected = distance[hit] * (directions @ forward)[hit]
    assert off(result.depth[hit] / expected, 1.0) < tolerance


# --- the exact rule against the reference ---------------------------------------------------------

SHAPE, ORIGIN = (12, 9, 14), (-3, 2, -5)  # crosses leaves, and 0 along two axes
MIDDLE = np.array([2.5, 6.0, 1.5])


@cache
def cloud(transform):
    return medium(scenes.random_values(0, SHAPE), ORIGIN, TRANSFORMS[transform])


def look(m, eye, target, up=(0.1, 1.0, 0.2), **kwargs):
    """A view between two points of index space; ``up`` is a world direction."""
    return View(tuple(m.world(eye)), tuple(m.world(target)), up, **kwargs)


def size(m):
    """The largest distance in the medium, world units."""
    corners = np.array([m.world(c) for c in product(*m.box.T.tolist())])
    return float(np.linalg.norm(np.ptp(corners, axis=0)))


VIEWS = {
    "from outside": lambda m: look(m, MIDDLE + np.array([25, 14, 33]), MIDDLE, fov=25),
    "from inside": lambda m: look(
        m, MIDDLE + np.array([1.3, 0.2, -2.1]), MIDDLE + np.array([9, 3, 1]), fov=100
    ),
    "parallel": lambda m: look(m, MIDDLE - (9, 30, 7), MIDDLE, width=1.2 * size(m)),
    "along x": lambda m: look(m, MIDDLE - (40, 0, 0), MIDDLE, width=size(m)),
    "along -z": lambda m: look(m, MIDDLE + np.array([0, 0, 40]), MIDDLE, width=size(m)),
    "along a diagonal": lambda m: look(m, MIDDLE + np.array([20, 20, 20]), MIDDLE, width=size(m)),
}


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("transform", TRANSFORMS)
def test_transmittance_and_depth_are_exact_under_every_transform_and_camera(transform, view):
    m = cloud(transform)
    camera = VIEWS[view](m)
    scale = 12.0 / size(m)
    tau, _, distance = truth(m, camera, scale)
    result = shoot(m, camera, scale)
    assert 1e-3 < transmittance(tau).min() < 0.9, "the scene is neither clear nor opaque"
    assert off(result.transmittance, transmittance(tau)) < EXACT
    assert off(result.opacity, -np.expm1(-tau)) < EXACT
    np.testing.assert_allclose(result.optical_depth, tau, rtol=2e-7, atol=1e-14)
    assert_depth(result, camera, distance)


PLANES = [(0.0, 0.0), (0.25, 0.0), (0.5, 0.5)]


@pytest.mark.parametrize("axis", "xyz")
@pytest.mark.parametrize("offset", PLANES, ids=str)
@pytest.mark.parametrize("sign", [1, -1])
def test_rays_in_lattice_planes_and_on_lattice_lines_are_exact(axis, offset, sign):
    """With a lattice of size 1 and pixels of size 1 the rays lie in planes and along edges, and
    the outermost graze the box: on its faces the field is 0, one voxel inside it is not."""
    m = medium(scenes.random_values(1, (7, 7, 7), zeros=0.0))
    a = "xyz".index(axis)
    aside = np.roll([0.0, *offset], a)
    middle = np.array([3.0, 3.0, 3.0]) + aside
    toward = np.roll([float(sign), 0.0, 0.0], a)
    up = tuple(np.roll([0.0, 1.0, 0.0], a))
    view = View(tuple(middle - 20 * toward), tuple(middle), up, width=11.0, resolution=(11, 11))
    tau, _, distance = truth(m, view, 0.2)
    result = shoot(m, view, 0.2)
    assert off(result.transmittance, transmittance(tau)) < EXACT
    assert_depth(result, view, distance)


def test_random_rays_through_every_part_of_a_volume_of_many_blocks_are_exact():
    """A cube of noise across the boundary of four 128-blocks and of a root cell."""
    m = medium(scenes.random_values(2, (20, 20, 20)), (4086, 118, -10), TRANSFORMS["rotated"])
    middle = m.box.mean(axis=0)
    for seed in range(4):
        away = np.random.default_rng(seed).normal(size=3) * 30
        view = look(m, middle + away, middle, fov=35, resolution=(8, 8))
        tau, _, _ = truth(m, view, 0.3)
        assert off(shoot(m, view, 0.3).transmittance, transmittance(tau)) < EXACT


@cache
def real(name):
    file = REAL / name
    if not file.is_file():
        pytest.skip("no real volumes beside the checkout")
    volume = open_volume(file)
    header = next(h for h in volume.headers if h.label == "density")
    grid, _ = load_density(volume, header, "error")
    m = Medium(volume.read_tree(header), header.world_from_index)
    assert m.tree.background == 0
    assert (m.tree.leaf_values >= 0).all()
    m.grid = grid
    return m


@pytest.mark.needs_jit
@pytest.mark.parametrize(
    "name", ["smoke.vdb", "wdas_cloud_sixteenth.vdb", "density_and_heat.vdb", "dragon.vdb"]
)
def test_scattered_rays_through_real_files_are_exact(name):
    m = real(name)
    low, high = m.grid.world_box()
    middle, extent = (low + high) / 2, np.linalg.norm(high - low)
    checked = 0
    for seed, distance in ((0, 1.4), (1, 0.1), (2, 1000.0)):  # outside, inside, far away
        toward = np.random.default_rng(seed).normal(size=3)
        eye = middle + toward / np.linalg.norm(toward) * distance * extent
        fov = 2 * np.degrees(np.arctan(0.35 / max(distance, 0.35)))
        view = View(tuple(eye), tuple(middle), fov=fov, resolution=(12, 10))
        tau, _, hit = truth(m, view, 1.0)
        scale = 1.0 / np.median(tau[tau > 0])
        result = shoot(m, view, scale)
        seen = transmittance(scale * tau)
        checked += int((seen < 0.999).sum())
        assert off(result.transmittance, seen) < EXACT
        np.testing.assert_allclose(result.optical_depth, scale * tau, rtol=1e-6, atol=1e-9)
        np.testing.assert_array_equal(np.isinf(result.depth), np.isinf(hit))
    assert checked > 100, "most rays went past the volume"


# --- colour ---------------------------------------------------------------------------------------

COLOURS = {
    "the same lattice": None,
    "finer": affine(0.37 * np.eye(3), (-2.0, 1.0, -3.0)),
    "coarser": affine(2.3 * np.eye(3), (-4.0, 0.7, -6.0)),
    "shifted by half a voxel": affine(np.eye(3), (0.5, 0.5, 0.5)),
    "rotated": affine(rotation((1, 1, 0.3), 28.0) * 0.8, (-3.0, 1.0, -4.0)),
    "mirrored": affine(np.diag([-0.7, 0.9, 1.1]), (9.0, 1.0, -6.0)),
}


def colours(which, transform):
    """A colour grid on a lattice that is placed relative to the density's lattice."""
    placed = COLOURS[which]
    if placed is None:
        return medium(scenes.random_colours(5, SHAPE), ORIGIN, TRANSFORMS[transform])
    return medium(
        scenes.random_colours(5, (34, 28, 40)), (-2, -3, -4), TRANSFORMS[transform] @ placed
    )


def pair(field, which, transform):
    """A density, a colour grid and a view: of white noise, or of what volumes are like."""
    source = colours(which, transform)
    m = cloud(transform)
    if field == "smooth":
        m = medium(scenes.smooth_values(SHAPE), ORIGIN, TRANSFORMS[transform])
    return m, source, replace(VIEWS["from outside"](m), resolution=(12, 9))


@pytest.mark.parametrize("which", COLOURS)
@pytest.mark.parametrize("transform", ["uniform", "all at once"])
def test_radiance_of_a_smooth_volume_and_a_colour_grid_on_any_lattice_is_within_1e_5(
    which, transform
):
    """Cells of optical depth up to 0.3; the colours are white noise all the same."""
    m, source, view = pair("smooth", which, transform)
    scale = 3.0 / size(m)
    tau, radiance, distance = truth(m, view, scale, source)
    result = shoot(m, view, scale, source)
    assert off(result.radiance, radiance) < 1e-5 * radiance.max()
    assert off(result.transmittance, transmittance(tau)) < EXACT
    assert_depth(result, view, distance)


THICK = [
    (field, which, thickness)
    for field in ("smooth", "noise")
    for which in ("the same lattice", "rotated")
    for thickness in (1.0, 12.0, 100.0, 3000.0)
]


@pytest.mark.parametrize("field, which, thickness", THICK)
def test_radiance_is_within_1e_4_of_its_maximum_however_dense_the_medium(field, which, thickness):
    """Optical depths of a cell up to some 0.1, 1, 10 and 300."""
    m, source, view = pair(field, which, "uniform")
    scale = thickness / size(m)
    _, radiance, _ = truth(m, view, scale, source)
    result = shoot(m, view, scale, source)
    assert off(result.radiance, radiance) < PROMISED_COLOUR * radiance.max()


def test_colour_beyond_its_own_grid_is_its_background():
    m = cloud("uniform")
    source = Medium(
        tree_of(np.zeros((2, 2, 2, 3)), background=(0.25, 0.5, 1.0)),
        m.world_from_index @ affine(0.9 * np.eye(3), (400.0, 0.0, 0.0)),
    )
    result = shoot(m, VIEWS["from outside"](m), 3.0, source)
    expected = result.opacity[..., None] * np.float32([0.25, 0.5, 1.0])
    np.testing.assert_allclose(result.radiance, expected, rtol=3e-7)


def test_negative_colours_are_kept():
    """Files have them (wide gamuts, baked data); the model is linear in the colour."""
    m = cloud("uniform")
    plus = medium(scenes.random_colours(5, SHAPE), ORIGIN, m.world_from_index)
    minus = medium(-scenes.random_colours(5, SHAPE), ORIGIN, m.world_from_index)
    view = VIEWS["from outside"](m)
    a, b = shoot(m, view, 3.0, plus), shoot(m, view, 3.0, minus)
    assert a.radiance.max() > 0.1
    np.testing.assert_array_equal(a.radiance, -b.radiance)


def test_a_constant_colour_is_c_times_opacity():
    m = cloud("all at once")
    view = VIEWS["from outside"](m)
    colour = (0.2, 1.0, 7.5)
    result = shoot(m, view, 2.0, colour)
    exact = -np.expm1(-truth(m, view, 2.0)[0])
    # float32 rounds once: half an ulp is 6e-8 of the value.
    np.testing.assert_allclose(result.radiance, exact[..., None] * colour, rtol=7e-8, atol=1e-14)
    # The same colour as a grid comes back as exactly, for weights that sum to 1.
    source = medium(np.broadcast_to(np.float32(colour), (*SHAPE, 3)), ORIGIN, m.world_from_index)
    whole = Medium(tree_of(np.zeros((1, 1, 1, 3)), background=colour), source.world_from_index)
    whole.tree.leaf_values[...] = colour
    grid = shoot(m, view, 2.0, whole)
    np.testing.assert_allclose(grid.radiance, exact[..., None] * np.float32(colour), rtol=2e-7)


# --- compositing ----------------------------------------------------------------------------------


def test_over_is_premultiplied_compositing_with_the_volumes_transmittance():
    m = cloud("uniform")
    result = shoot(m, VIEWS["from outside"](m), 3.0, (0.9, 0.5, 0.1))
    alone = over(result, None)
    np.testing.assert_array_equal(alone[..., :3], result.radiance)
    np.testing.assert_array_equal(alone[..., 3], result.opacity)
    behind = np.float32([0.3, 0.6, 0.2, 1.0])
    picture = over(result, behind)
    expected = result.radiance + result.transmittance[..., None] * behind[:3]
    np.testing.assert_allclose(picture[..., :3], expected, rtol=2e-7)
    np.testing.assert_allclose(picture[..., 3], 1.0, rtol=2e-7)


def test_over_takes_an_image_and_keeps_its_alpha():
    m = cloud("uniform")
    result = shoot(m, VIEWS["from outside"](m), 3.0)
    image = np.random.default_rng(0).random((*result.opacity.shape, 4)).astype(np.float32)
    picture = over(result, image)
    expected = result.opacity + result.transmittance * image[..., 3]
    np.testing.assert_allclose(picture[..., 3], expected, rtol=2e-7)
    nothing = over(result, np.zeros(4, np.float32))
    np.testing.assert_array_equal(nothing, over(result, None))


# --- the midpoint rule ----------------------------------------------------------------------------


def blob(transform="rotated"):
    m = medium(scenes.smooth_values((24, 24, 24)), (-7, 3, -12), TRANSFORMS[transform])
    source = medium(scenes.random_colours(3, (24, 24, 24)), (-7, 3, -12), m.world_from_index)
    middle = m.box.mean(axis=0)
    return m, source, look(m, middle + np.array([20, 13, 37]), middle, fov=22, resolution=(10, 10))


@pytest.mark.needs_jit
def test_midpoint_converges_to_exact_with_order_2():
    m, source, view = blob()
    exact = shoot(m, view, 0.3, source)
    steps = np.array([1.0, 0.5, 0.25, 0.125])
    of_t, of_c = [], []
    for step in steps:
        result = shoot(m, view, 0.3, source, step=step)
        of_t.append(np.sqrt(np.mean((result.transmittance - exact.transmittance) ** 2.0)))
        of_c.append(np.sqrt(np.mean((result.radiance - exact.radiance) ** 2.0)))
    for errors in (of_t, of_c):
        order = np.polyfit(np.log(steps), np.log(errors), 1)[0]
        assert 1.7 < order < 2.4, (order, errors)
    assert of_t[-1] < 1e-5


@pytest.mark.parametrize("step", [1.0, 0.37])
def test_midpoint_is_the_digests_rule_on_samples_in_the_middle_of_each_step(step):
    """Steps count from where a ray enters the box; the last is cut where it leaves."""
    m, source, view = blob("all at once")
    scale = 0.4
    result = shoot(m, view, scale, source, step=step)
    density, light = m.lattice(), source.lattice()
    for pixel in np.ndindex(10, 10):
        origin, direction = (a[pixel] for a in view.rays)
        near, far = reference.span(origin, direction, density)
        if not near < far:
            assert result.optical_depth[pixel] == 0
            continue
        linear = np.linalg.inv(m.world_from_index)[:3, :3]
        length = step / np.linalg.norm(linear @ direction)
        edges = np.append(np.arange(near, far, length), far)
        t, delta = (edges[1:] + edges[:-1]) / 2, np.diff(edges)
        points = origin + t[:, None] * direction
        sigma = scale * reference.sample(points, density)
        colour = quadrature.composite(reference.sample(points, light), sigma, delta)
        depth = quadrature.optical_depth(sigma, delta)
        # float32 rounds the result once; positions agree to some 1e-13 voxels.
        np.testing.assert_allclose(result.optical_depth[pixel], depth, rtol=2e-7, atol=1e-12)
        np.testing.assert_allclose(result.radiance[pixel], colour, rtol=3e-7, atol=1e-12)


# --- symmetries -----------------------------------------------------------------------------------


def same_image(a, b, tolerance=SAME_IMAGE):
    assert a.opacity.max() > 0.3, "there is something to see"
    assert off(a.transmittance, b.transmittance) < tolerance
    assert off(a.radiance, b.radiance) < tolerance


def moved(view, world_from_world):
    """The view carried along by an affine map of the world."""
    turn, offset = world_from_world[:3, :3], world_from_world[:3, 3]
    return replace(
        view,
        eye=tuple(turn @ np.array(view.eye) + offset),
        target=tuple(turn @ np.array(view.target) + offset),
        up=tuple(turn @ np.array(view.up)),
    )


def baseline():
    m = cloud("rotated")
    source = medium(scenes.random_colours(5, SHAPE), ORIGIN, m.world_from_index)
    view = VIEWS["from outside"](m)
    return m, source, view


def carried(m, world_from_world):
    return Medium(m.tree, world_from_world @ m.world_from_index, m.box)


@pytest.mark.parametrize("k", [1e-3, 0.1, 7.0, 1000.0])
def test_k_times_larger_voxels_and_sigma_over_k_are_the_same_image(k):
    m, source, view = baseline()
    whole = shoot(m, view, 2.0, source)
    by = affine(k * np.eye(3))
    other = shoot(carried(m, by), moved(view, by), 2.0 / k, carried(source, by))
    same_image(whole, other, EXACT)
    hit = np.isfinite(whole.depth)
    np.testing.assert_allclose(other.depth[hit], k * whole.depth[hit], rtol=2e-7)


def test_a_scene_turned_along_with_its_camera_is_the_same_image():
    m, source, view = baseline()
    by = affine(rotation((3, 1, -2), 143.0))
    same_image(
        shoot(m, view, 2.0, source),
        shoot(carried(m, by), moved(view, by), 2.0, carried(source, by)),
    )


def test_a_scene_a_million_units_away_is_the_same_image():
    m, source, view = baseline()
    by = affine(np.eye(3), (1e6, -1e6, 1e6 + 1 / 3))
    same_image(
        shoot(m, view, 2.0, source),
        shoot(carried(m, by), moved(view, by), 2.0, carried(source, by)),
    )


@pytest.mark.parametrize("far", [(10**6, -(10**6), 10**6 + 3), (2**30 - 40, -(2**30), 2**29 + 5)])
def test_index_coordinates_far_from_the_origin_are_the_same_image(far):
    """The same points of the world, numbered otherwise."""
    m, source, view = baseline()
    far = np.array(far, np.int64)
    back = affine(np.eye(3), -far.astype(float))

    def renumbered(what):
        values = dense_of(what.tree)
        return medium(values, np.array(ORIGIN) + far, what.world_from_index @ back)

    def dense_of(tree):
        lookup = reference.of_tree(tree)
        points = np.array(list(np.ndindex(*SHAPE))) + ORIGIN
        found = lookup(points)
        return found.reshape(*SHAPE, *found.shape[1:])

    same_image(shoot(m, view, 2.0, source), shoot(renumbered(m), view, 2.0, renumbered(source)))


def test_a_camera_a_million_voxels_away_with_a_narrow_view_sees_the_same_as_the_reference():
    m = cloud("rotated")
    toward = np.array([0.48, -0.6, 0.64])
    target = m.world(MIDDLE)
    eye = target + toward * 0.5e6
    fov = np.degrees(1.2 * size(m) / 0.5e6)
    view = View(tuple(eye), tuple(target), fov=fov, resolution=(9, 9))
    tau, _, _ = truth(m, view, 2.0)
    result = shoot(m, view, 2.0)
    assert result.opacity.max() > 0.3
    assert off(result.transmittance, transmittance(tau)) < SAME_IMAGE


def test_a_ray_and_its_reverse_cross_the_same_optical_depth():
    m = cloud("all at once")
    there = look(m, MIDDLE - (40, 11, 7), MIDDLE, width=size(m), resolution=(8, 8))
    back = replace(there, eye=tuple(2 * np.array(there.target) - there.eye))
    a, b = shoot(m, there, 1.0), shoot(m, back, 1.0)
    assert a.optical_depth.max() > 0.3
    np.testing.assert_allclose(a.optical_depth, b.optical_depth[:, ::-1], rtol=1e-6, atol=1e-9)


# --- single voxels --------------------------------------------------------------------------------

PLACES = [
    (0, 0, 0),
    (7, 7, 7),
    (8, 8, 8),
    (3, 0, 7),
    (0, 7, 8),
    (127, 128, 127),
    (128, 128, 128),
    (4095, 4096, 4095),
    (4096, 4096, 4096),
    (-1, -1, -1),
    (-8, -9, 0),
    (-128, -129, 5),
    (-4096, -4097, 4095),
    (-4096, -4096, -4096),
]


def voxel(at, value=1.0):
    return medium(np.full((1, 1, 1), value, np.float32), at)


@pytest.mark.parametrize("at", PLACES, ids=str)
@pytest.mark.parametrize("axis", "xyz")
def test_one_active_voxel_is_a_tent_two_voxels_wide(at, axis):
    """A ray along an axis, (a, b) beside the lattice point, crosses (1 - |a|) (1 - |b|) of it: the
    integral of 1 - |x| over [-1, 1] is 1. Half of it lies in bricks below: the skirt."""
    m = voxel(at)
    a = "xyz".index(axis)
    toward = np.roll([1.0, 0.0, 0.0], a)
    up = np.roll([0.0, 0.0, 1.0], a)
    middle = np.array(at, float)
    view = View(
        tuple(middle - 10 * toward), tuple(middle), tuple(up), width=2.75, resolution=(11, 11)
    )
    result = shoot(m, view)
    aside = (np.arange(11) - 5) / 4
    tent = np.clip(1 - np.abs(aside), 0, None)
    np.testing.assert_allclose(result.optical_depth, np.outer(tent, tent), rtol=2e-7, atol=1e-12)
    assert result.optical_depth[5, 5] == pytest.approx(1.0, rel=1e-7)
    assert np.isposinf(result.depth[0]).all()
    assert result.depth[5, 5] < 10.0, "absorption ahead brings the expected hit forward"


@pytest.mark.parametrize("at", PLACES, ids=str)
def test_the_tent_of_one_voxel_along_diagonals_is_its_closed_form(at):
    """(1 - s)^2 and (1 - s)^3 over both halves of a face's and a space's diagonal: 2/3 of sqrt 2,
    and half of sqrt 3."""
    m = voxel(at, 0.5)
    middle = np.array(at, float)
    for toward, expected in (
        ((1, 1, 0), 0.5 * np.sqrt(2) * 2 / 3),
        ((0, -1, 1), 0.5 * np.sqrt(2) * 2 / 3),
        ((1, 1, 1), 0.5 * np.sqrt(3) / 2),
        ((-1, 1, -1), 0.5 * np.sqrt(3) / 2),
    ):
        view = View(
            tuple(middle - 7 * np.array(toward)),
            tuple(middle),
            (0.3, 0.9, 0.1),
            width=0.1,
            resolution=(1, 1),
        )
        assert shoot(m, view).optical_depth[0, 0] == pytest.approx(expected, rel=2e-7)


# --- tiles, far parts, backgrounds ----------------------------------------------------------------


def tile(origin, width, value=1.0):
    return Medium(tree_of(np.empty((0, 0, 0)), tiles=[(origin, width, value, True)]))


TILES = [((8, -16, 24), 8), ((-128, 128, 0), 128), ((0, 0, 0), 4096), ((-4096, 4096, 8192), 4096)]


@pytest.mark.parametrize("origin, width", TILES, ids=str)
def test_a_tile_is_the_same_field_as_its_voxels(origin, width):
    m = tile(origin, width, 0.5)
    middle = np.array(origin) + (width - 1) / 2
    straight = View(
        tuple(middle - (0, 0, 2 * width)), tuple(middle), width=1.3 * width, resolution=(5, 5)
    )
    result = shoot(m, straight, 2.0 / width)
    tau, _, distance = truth(m, straight, 2.0 / width)
    # w lattice points a voxel apart, and half a voxel of ramp at each end: w voxels.
    assert result.optical_depth[2, 2] == pytest.approx(1.0, rel=1e-7)
    assert off(result.transmittance, transmittance(tau)) < EXACT
    assert_depth(result, straight, distance)
    askew = replace(straight, eye=tuple(middle - np.array([0.7, 1.3, 2.1]) * width), width=None)
    askew = replace(askew, fov=45.0, resolution=(3, 3))
    result = shoot(m, askew, 2.0 / width)
    tau, _, distance = truth(m, askew, 2.0 / width)
    assert off(result.transmittance, transmittance(tau)) < EXACT
    assert_depth(result, askew, distance)


@pytest.mark.parametrize("origin, width", TILES, ids=str)
def test_a_tile_costs_its_surface_tables_and_not_its_volume(origin, width):
    grid = tile(origin, width).grid
    assert len(grid.arrays.atlas) <= 27, "bricks of one signature are one brick"
    assert grid.nbytes < 16e6  # tables of at most 27 nodes a level; voxelised: 275 GB


def test_tiles_beside_leaves_are_one_field():
    """A tile of 128, leaves on its surface, an inactive tile of 8 with a value of its own."""
    values = scenes.random_values(4, (16, 16, 16))
    tree = tree_of(
        values,
        (128, 40, 40),
        tiles=[
            ((0, 0, 0), 128, 0.7, True),
            ((128, 56, 40), 8, 0.4, True),
            ((128, 64, 40), 8, 0.9, False),
        ],
    )
    m = Medium(tree, TRANSFORMS["rotated"])
    middle = np.array([128, 50, 48])
    for away in ((25, 17, 30), (-2, 40, 6), (150, 10, -20)):
        view = look(m, middle + away, middle, fov=50, resolution=(8, 8))
        tau, _, distance = truth(m, view, 0.1)
        result = shoot(m, view, 0.1)
        assert off(result.transmittance, transmittance(tau)) < EXACT
        assert_depth(result, view, distance)


def far_blobs():
    values = scenes.random_values(6, (6, 6, 6), zeros=0.0)
    places = [(0, 0, 0), (10**6, 5, -3), (2, 10**6, 10**6)]
    trees = [tree_of(values, p) for p in places]
    return [Medium(t) for t in trees], Medium(scenes.joined(*trees))


def test_parts_a_million_voxels_apart_render_and_cost_little_memory():
    parts, whole = far_blobs()
    assert whole.grid.nbytes < 8e6
    view = View((-30.0, 2.4, 2.7), (10.0**6, 7.4, -0.3), fov=0.8, resolution=(6, 6))
    tau = sum(truth(p, view, 0.2)[0] for p in parts)
    result = shoot(whole, view, 0.2)
    assert result.opacity.max() > 0.3
    assert off(result.transmittance, transmittance(tau)) < EXACT
    through_both = View((-30.0, 2.4, 2.7), (10.0**6 + 2.5, 7.5, -0.5), fov=1e-4, resolution=(4, 4))
    taus = [truth(p, through_both, 0.2)[0] for p in parts[:2]]
    assert min(t.min() for t in taus) > 0.1, "every ray goes through both"
    result = shoot(whole, through_both, 0.2)
    assert off(result.transmittance, transmittance(sum(taus))) < EXACT
    diagonal = View((1.0, -30.0, -30.0), (4.5, 10.0**6 + 2.5, 10.0**6 + 2.5), fov=5e-4)
    tau = sum(truth(p, diagonal, 0.2)[0] for p in parts)
    assert tau.max() > 0.1
    result = shoot(whole, diagonal, 0.2)
    assert off(result.transmittance, transmittance(tau)) < EXACT


@pytest.mark.parametrize("transform", ["uniform", "sheared"])
def test_a_background_other_than_0_fills_the_active_box_and_one_voxel_around_it(transform):
    values = scenes.random_values(7, (10, 9, 11))
    m = medium(values, (-4, 5, 120), TRANSFORMS[transform], background=0.25)
    middle = m.box.mean(axis=0)
    for away in ((22, 13, 30), (0.3, 0.4, 1.0)):
        view = look(m, middle + away, middle, fov=45, resolution=(8, 8))
        tau, _, distance = truth(m, view, 0.4)
        result = shoot(m, view, 0.4)
        assert off(result.transmittance, transmittance(tau)) < EXACT
        assert_depth(result, view, distance)


def test_a_background_between_parts_of_a_volume_is_seen():
    values = scenes.random_values(8, (5, 5, 5))
    trees = [tree_of(values, o, background=0.01) for o in ((0, 0, 0), (300, 40, 20))]
    box = np.array([[0, 0, 0], [304, 44, 24]])
    m = Medium(scenes.joined(*trees), scenes.IDENTITY, box)
    view = View((-20.0, 1.0, 1.5), (302.0, 42.0, 22.0), fov=3.0, resolution=(5, 5))
    tau, _, _ = truth(m, view)
    result = shoot(m, view)
    assert np.median(result.optical_depth) > 2.5
    assert off(result.transmittance, transmittance(tau)) < EXACT


def test_inactive_voxels_with_a_value_are_part_of_the_field():
    values = scenes.random_values(9, (11, 10, 9))
    nothing_active = tree_of(values, (2, 3, 4), active=np.zeros(values.shape, bool))
    m, active = Medium(nothing_active), medium(values, (2, 3, 4))
    view = look(active, (30, 20, 25), (7, 8, 8), fov=30)
    a, b = shoot(m, view, 0.5), shoot(active, view, 0.5)
    assert a.opacity.max() > 0.3
    np.testing.assert_array_equal(a.transmittance, b.transmittance)


# --- nearest --------------------------------------------------------------------------------------


@pytest.mark.parametrize("transform", ["uniform", "all at once"])
def test_nearest_is_the_digests_formula_voxel_by_voxel(transform):
    """A voxel is the unit cube around its lattice point: one density and one colour, so the
    piecewise-constant rule is exact with a sample for each voxel crossed."""
    m = cloud(transform)
    source = medium(scenes.random_colours(5, SHAPE), ORIGIN, m.world_from_index)
    view = VIEWS["from outside"](m)
    scale = 12.0 / size(m)
    tau, radiance, distance = truth(m, view, scale, source, nearest=True)
    result = shoot(m, view, scale, source, nearest=True)
    assert off(result.transmittance, transmittance(tau)) < EXACT
    assert off(result.radiance, radiance) < 2 * EXACT
    assert_depth(result, view, distance)
    linear = shoot(m, view, scale, source)
    assert np.abs(result.transmittance - linear.transmittance).max() > 0.01


def test_one_voxel_is_a_cube_when_values_are_not_blended():
    m = voxel((8, -1, 128), 0.5)
    view = View((8.0, -1.0, 100.0), (8.0, -1.0, 128.0), width=2.8, resolution=(7, 7))
    result = shoot(m, view, nearest=True)
    inside = np.abs((np.arange(7) - 3) * 0.4) < 0.5
    np.testing.assert_allclose(result.optical_depth, 0.5 * np.outer(inside, inside), rtol=1e-7)


def test_nearest_tiles_end_half_a_voxel_beyond_their_outermost_points():
    m = tile((-128, 0, 0), 128, 0.5)
    view = View((-60.3, 59.7, -50.0), (-60.3, 59.7, 0.0), width=150.0, resolution=(15, 15))
    tau, _, _ = truth(m, view, 0.01, nearest=True)
    result = shoot(m, view, 0.01, nearest=True)
    assert result.optical_depth[7, 7] == pytest.approx(0.64, rel=1e-7)
    assert off(result.transmittance, transmittance(tau)) < EXACT


# --- depth, early end, threads --------------------------------------------------------------------


def test_depth_is_along_the_cameras_axis_and_not_along_the_ray():
    """A thin dense slab at z = 0 seen at a wide angle: one depth in the whole picture."""
    m = medium(np.ones((60, 60, 1), np.float32), (-30, -30, 0))
    view = View((0.0, 0.0, 20.0), (0.0, 0.0, 0.0), fov=80.0, resolution=(9, 9))
    result = shoot(m, view, 1e-6)
    np.testing.assert_allclose(result.depth, 20.0, rtol=1e-6)


def test_depth_of_a_homogeneous_slab_is_its_closed_form():
    """E[t] over [a, b] with extinction s: a + 1/s - (b - a) T / (1 - T)."""
    m = tile((0, 0, 0), 128, 1.0)
    view = View((63.5, 63.5, -100.0), (63.5, 63.5, 0.0), width=1.0, resolution=(1, 1))
    for s in (1e-9, 1e-3, 0.1, 20.0):
        inside = 128.0  # from -0.5 to 127.5, if it had no ramps
        got = float(shoot(m, view, s, nearest=True).depth[0, 0])
        t = np.exp(-s * inside)
        expected = 99.5 + (1 / s - inside * t / (1 - t) if s > 1e-6 else inside / 2)
        assert got == pytest.approx(expected, rel=PROMISED_DEPTH)


@pytest.mark.parametrize(
    "field, thickness",
    [
        ("smooth", 1.0),
        ("smooth", 3.0),
        ("noise", 1.0),
        ("noise", 30.0),
        ("smooth", 1000.0),
    ],
)
def test_depth_is_within_1e_6_of_the_distance(field, thickness):
    m, _, view = pair(field, "the same lattice", "uniform")
    _, _, distance = truth(m, view, thickness / size(m))
    assert_depth(shoot(m, view, thickness / size(m)), view, distance, PROMISED_DEPTH)


def test_optical_depth_goes_on_where_light_has_faded():
    m, source, view = baseline()
    tau, _, _ = truth(m, view, 3000.0)
    assert tau.max() > 1000
    for layers in (scenes.EVERYTHING, {"picture"}):
        result = shoot(m, view, 3000.0, source, layers=layers)
        np.testing.assert_allclose(result.optical_depth, tau, rtol=2e-7, atol=1e-12)


@pytest.mark.needs_jit
def test_an_image_is_the_same_bit_by_bit_for_any_number_of_threads():
    m, source, view = baseline()
    view = replace(view, resolution=(101, 67))
    one = shoot(m, view, 2.0, source, threads=1)
    for threads in (2, 3):
        other = shoot(m, view, 2.0, source, threads=threads)
        for name in ("radiance", "optical_depth", "transmittance", "opacity", "depth"):
            a, b = getattr(one, name), getattr(other, name)
            assert a.tobytes() == b.tobytes(), name
        assert one.evaluations == other.evaluations


def test_terms_that_are_left_out_change_nothing_else():
    m, source, view = baseline()
    whole = shoot(m, view, 2.0, source)
    bare = shoot(m, view, 2.0, layers={"picture"})
    assert bare.depth is None
    np.testing.assert_allclose(bare.transmittance, whole.transmittance, rtol=2e-7)
