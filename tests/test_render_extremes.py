"""Images of volumes at the ends of what numbers can hold: thin, dense, tiny, huge, far, empty."""

from dataclasses import replace

import numpy as np
import pytest
import reference
import scenes
from scenes import Medium, View, affine, medium, shoot, tree_of, truth

from volcli.errors import NonFiniteError, UsageError
from volcli.render import over

EXACT = 1e-7  # float32 rounds a transmittance by 3e-8
ROUNDED = 1.5e-7  # relative: float32 rounds by 6e-8, and positions cost some 1e-13

SHAPE = (6, 6, 6)
VALUES = scenes.random_values(20, SHAPE, zeros=0.0)
VIEW = View((14.0, 11.0, 21.0), (2.5, 2.5, 2.5), fov=16.0, resolution=(6, 6))
SKY = np.float32([0.25, 0.5, 1.0, 1.0])


def of(values=VALUES, origin=(0, 0, 0), voxel=1.0):
    return medium(values, origin, affine(voxel * np.eye(3)))


def assert_sound(result):
    """Finite where it must be, in range, and consistent with itself."""
    for layer in (result.transmittance, result.opacity):
        assert ((layer >= 0) & (layer <= 1)).all()
    assert np.isfinite(result.radiance).all()
    assert np.isfinite(result.optical_depth).all()
    assert (result.optical_depth >= 0).all()
    assert not np.isnan(result.depth).any()
    np.testing.assert_array_equal(np.isposinf(result.depth), result.optical_depth == 0)


# --- thin and dense -------------------------------------------------------------------------------


BIG = [pytest.param(e, marks=pytest.mark.needs_jit) for e in (4, 8, 16, 30, 37)]


@pytest.mark.parametrize("exponent", [-36, -30, -20, -12, -6, -3, 0, 2, *BIG])
def test_opacity_is_right_relatively_for_any_extinction(exponent):
    """Never 1 - exp(-tau), which is 0 below 6e-17, or 4.6 % off at 1e-6 in float32."""
    m = of()
    tau, _, distance = truth(m, VIEW, 10.0**exponent)
    assert (tau > 0).sum() > 20
    result = shoot(m, VIEW, 10.0**exponent, (0.5, 1.0, 2.0))
    assert_sound(result)
    np.testing.assert_allclose(result.optical_depth, tau, rtol=ROUNDED)
    np.testing.assert_allclose(result.opacity, -np.expm1(-tau), rtol=ROUNDED)
    np.testing.assert_allclose(result.transmittance, np.exp(-tau), rtol=2e-7, atol=1e-9)
    light = -np.expm1(-tau)[..., None] * [0.5, 1.0, 2.0]
    np.testing.assert_allclose(result.radiance, light, rtol=ROUNDED)
    hit = tau > 0
    along = VIEW.rays[1] @ VIEW.camera.forward
    np.testing.assert_allclose(result.depth[hit], (distance * along)[hit], rtol=2e-4)


@pytest.mark.needs_jit
@pytest.mark.parametrize(
    "value, scale", [(1e-30, 1e25), (1e30, 1e-30), (1e-38, 1e38), (3e38, 1e-8)]
)
def test_extinction_is_the_product_of_density_and_scale_whatever_each_is(value, scale):
    whole = np.full(SHAPE, value, np.float32)
    sigma = float(np.float32(value)) * scale
    tau, _, _ = truth(of(np.ones(SHAPE)), VIEW, sigma)
    result = shoot(of(whole), VIEW, scale)
    assert_sound(result)
    np.testing.assert_allclose(result.optical_depth, tau, rtol=3e-7)


def test_optical_depth_is_right_to_float64_before_it_is_rounded():
    """Seen where T is small: an error of tau is a relative error of T. Corner values that subtract
    in float32 cost 7e-9 of tau, 5e-7 of these."""
    tau, _, _ = truth(of(), VIEW, 80.0)
    seen = (tau > 50) & (tau < 80)  # T in the range of float32
    assert seen.any()
    result = shoot(of(), VIEW, 80.0)
    np.testing.assert_allclose(result.transmittance[seen], np.exp(-tau[seen]), rtol=7e-8)


def test_an_opacity_of_1e_20_keeps_all_its_digits():
    m = of(np.ones((1, 1, 1)))
    view = View((0.0, 0.0, 9.0), (0.0, 0.0, 0.0), width=0.1, resolution=(1, 1))
    result = shoot(m, view, 1e-20)
    assert result.opacity[0, 0] == np.float32(1e-20)
    assert result.radiance[0, 0, 0] == np.float32(1e-20)
    assert result.transmittance[0, 0] == 1


def test_an_optical_depth_beyond_float32_is_an_error_that_says_where():
    with pytest.raises(NonFiniteError, match=r"x=\d+, y=\d+.*density\.scale"):
        shoot(of(np.full(SHAPE, 1e30, np.float32)), VIEW, 1e30)


@pytest.mark.needs_jit
@pytest.mark.parametrize("per_cell", [10.0, 1e4, 1e8, 1e15])
def test_a_dense_medium_never_leaves_the_range_of_its_colours(per_cell):
    """Convex combinations only: plain quadrature of a source overshoots by 2 % and more here."""
    values = scenes.random_values(21, (8, 8, 8))
    m = of(values)
    light = scenes.random_colours(22, (8, 8, 8)) * 0.5 + 0.25
    source = Medium(tree_of(light, background=(0.5, 0.5, 0.5)), m.world_from_index)
    # Colours are 0.25 to 0.75 inside, and 0.5 outside.
    result = shoot(m, replace(VIEW, resolution=(12, 12)), per_cell, source)
    assert_sound(result)
    assert (result.opacity > 0.99).sum() > 50
    assert (result.radiance <= 0.75 * result.opacity[..., None] * (1 + 1e-6)).all()
    assert (result.radiance >= 0.25 * result.opacity[..., None] * (1 - 1e-6)).all()


@pytest.mark.needs_jit
@pytest.mark.parametrize("per_cell", [1e4, 1e8])
def test_the_colour_of_an_opaque_medium_is_that_of_its_skin(per_cell):
    """All of the light is from the first 1e-3 voxels, over which colour changes by a little: the
    error of the best rule is that change, 2e-3 of the range at 1e4 and less beyond."""
    m = of(np.ones(SHAPE))
    source = medium(scenes.random_colours(23, (9, 9, 9)), (-1, -1, -1))
    view = replace(VIEW, resolution=(4, 4))
    _, radiance, _ = truth(m, view, per_cell, source)
    result = shoot(m, view, per_cell, source)
    assert_sound(result)
    assert np.abs(result.radiance - radiance).max() < 2e-3


def test_colours_of_any_size_are_scaled_as_they_are():
    m = of()
    base = scenes.random_colours(24, SHAPE)
    one = shoot(m, VIEW, 0.5, medium(base))
    for factor in (2.0**-100, 2.0**100):
        other = shoot(m, VIEW, 0.5, medium(base * np.float32(factor)))
        assert_sound(other)
        np.testing.assert_allclose(other.radiance, one.radiance * factor, rtol=2e-7)


def test_a_bright_source_behind_a_dark_one_is_seen_where_it_is_what_is_seen():
    """A black cloud of optical depth 18 before a source of radiance 1e6: T is 1.5e-8, below 2^-24,
    and still all of the light there is comes from behind."""
    density = np.zeros((3, 3, 30), np.float32)
    density[:, :, 5:11] = 3.0
    density[:, :, 20:26] = 3.0
    light = np.zeros((*density.shape, 3), np.float32)
    light[:, :, :13] = 1e6
    m, source = of(density), medium(light)
    view = View((1.0, 1.0, 60.0), (1.0, 1.0, 0.0), width=0.5, resolution=(2, 2))
    _, radiance, _ = truth(m, view, 1.0, source)
    assert radiance.max() > 1e-3
    for layers in (scenes.EVERYTHING, scenes.EVERYTHING - {"optical_depth"}):
        result = shoot(m, view, 1.0, source, layers=layers)
        np.testing.assert_allclose(result.radiance, radiance, rtol=1e-4)


# --- many thin steps ------------------------------------------------------------------------------


@pytest.mark.needs_jit
def test_a_million_thin_steps_multiply_to_exp_of_minus_1():
    """A running product of (1 - alpha) in float32 gives .3856; an accumulated tau gives .36788."""
    m = Medium(tree_of(np.empty((0, 0, 0)), tiles=[((0, 0, 0), 128, 1.0, True)]))
    view = View((-50.0, 63.5, 63.5), (0.0, 63.5, 63.5), width=0.5, resolution=(1, 1))
    result = shoot(m, view, 1 / 128, step=129 / 1e6)
    assert result.evaluations == pytest.approx(1e6, abs=2)
    assert result.optical_depth[0, 0] == pytest.approx(1.0, rel=1e-7)
    assert result.transmittance[0, 0] == pytest.approx(np.exp(-1.0), rel=1e-7)


@pytest.mark.needs_jit
def test_a_million_thin_cells_multiply_to_exp_of_minus_1():
    m = Medium(
        tree_of(
            np.empty((0, 0, 0)), tiles=[((4096 * i, 0, 0), 4096, 1.0, True) for i in range(244)]
        )
    )
    view = View((-50.0, 2e3, 2e3), (0.0, 2e3, 2e3), width=0.5, resolution=(1, 1))
    result = shoot(m, view, 1 / (4096 * 244))
    assert result.transmittance[0, 0] == pytest.approx(np.exp(-1.0), rel=1e-7)
    assert m.grid.nbytes < 100e6


def test_a_step_longer_than_the_volume_is_one_sample_in_its_middle():
    m = of(np.ones((1, 1, 1)))
    view = View((0.0, 0.0, 9.0), (0.0, 0.0, 0.0), width=0.1, resolution=(1, 1))
    result = shoot(m, view, 0.25, step=1000.0)
    assert result.evaluations == 1
    assert result.optical_depth[0, 0] == pytest.approx(0.25 * 1.0 * 2.0, rel=1e-6)


def test_more_steps_than_can_ever_be_taken_are_refused():
    for step in (1e-8, 1e-20, 1e-300):
        with pytest.raises(UsageError, match=r"--step .* samples a ray.* at least"):
            shoot(of(), VIEW, 0.5, step=step)


# --- scales and places ----------------------------------------------------------------------------


@pytest.mark.needs_jit
@pytest.mark.parametrize("step", [None, 0.5])
@pytest.mark.parametrize("lattice", [1.0, 1.3], ids=["same lattice", "another lattice"])
@pytest.mark.parametrize("voxel", [1e-13, 1e-6, 1e6, 1e13])
def test_voxels_of_any_size_are_the_same_image(voxel, lattice, step):
    def shot(size):
        m = of(voxel=size)
        placed = m.world_from_index @ affine(lattice * np.eye(3))
        source = medium(scenes.random_colours(25, SHAPE), world_from_index=placed)
        eye, target = (tuple(size * np.array(place)) for place in (VIEW.eye, VIEW.target))
        return shoot(m, replace(VIEW, eye=eye, target=target), 0.5 / size, source, step=step)

    one, other = shot(1.0), shot(voxel)
    assert_sound(other)
    # A sample of midpoint may fall on another side of a plane by rounding; the field is continuous.
    assert np.abs(other.transmittance - one.transmittance).max() < EXACT
    assert np.abs(other.radiance - one.radiance).max() < EXACT
    np.testing.assert_allclose(other.depth, voxel * one.depth, rtol=2e-7)


def test_voxels_a_million_times_longer_along_one_axis_are_exact():
    m = medium(VALUES, world_from_index=affine(np.diag([1e-3, 1.0, 1e3])))
    middle = m.world((2.5, 2.5, 2.5))
    for away in ((1e-2, 30.0, 100.0), (1.0, 0.5, 2.0), (0.0, 0.0, 2e4)):
        view = View(tuple(middle + away), tuple(middle), width=0.006, resolution=(5, 5))
        tau, _, _ = truth(m, view, 1e-3)
        scale = 1.0 / tau.max()
        assert (
            np.abs(shoot(m, view, 1e-3 * scale).transmittance - np.exp(-scale * tau)).max() < EXACT
        )


@pytest.mark.parametrize(
    "corner",
    [(2**30 - 8, -(2**30), 0), (-(2**30), -(2**30), -(2**30)), (2**31 - 16, -(2**31) + 8, 8)],
    ids=str,
)
def test_index_coordinates_at_the_ends_of_an_int32_are_exact(corner):
    """The transform brings them back to the origin: float64 holds such places to 1e-7 voxels."""
    back = affine(np.eye(3), -np.array(corner, float))
    m = medium(VALUES, corner, back)
    near, far = shoot(of(), VIEW, 0.5), shoot(m, VIEW, 0.5)
    assert_sound(far)
    assert near.opacity.max() > 0.5
    assert np.abs(near.transmittance - far.transmittance).max() < 5e-6


def test_parts_at_both_ends_of_the_lattice_are_one_volume():
    low, high = (-(2**30),) * 3, (2**30 - 8,) * 3
    tree = scenes.joined(tree_of(VALUES, low), tree_of(VALUES, high))
    m = Medium(tree, affine(1e-3 * np.eye(3)))
    assert m.grid.nbytes < 8e6
    for corner in (low, high):
        middle = m.world(np.array(corner) + 2.5)
        away = 1e-3 * (np.array(VIEW.eye) - 2.5)
        view = replace(VIEW, eye=tuple(middle + away), target=tuple(middle))
        result = shoot(m, view, 500.0)
        assert_sound(result)
        one = shoot(of(), VIEW, 0.5)
        # Places of 1e6 world units are held to 1e-10: 1e-7 voxels, and the other part is not seen.
        assert np.abs(result.transmittance - one.transmittance).max() < 5e-6


def test_a_camera_in_the_volume_sees_only_what_is_before_it():
    """Split at the eye, the two views along a line hold all of its optical depth."""
    m = of(np.ones((9, 9, 9), np.float32))
    eye = (4.3, 4.1, 4.7)
    forward = View(eye, (20.0, 11.0, 7.0), width=1e-3, resolution=(1, 1))
    backward = replace(forward, target=tuple(2 * np.array(eye) - forward.target))
    behind = tuple(np.array(eye) - 3 * (np.array(forward.target) - eye))
    whole = View(behind, eye, width=1e-3, resolution=(1, 1))
    a, b, c = (float(shoot(m, v, 0.1).optical_depth[0, 0]) for v in (forward, backward, whole))
    assert 0.2 < a != pytest.approx(b)
    assert a + b == pytest.approx(c, rel=3e-7)


# --- little or nothing ----------------------------------------------------------------------------

EMPTY = {
    "no leaves": tree_of(np.empty((0, 0, 0))),
    "inactive zeros": tree_of(np.zeros((8, 8, 8)), active=np.zeros((8, 8, 8), bool)),
    "active zeros": tree_of(np.zeros((8, 8, 8))),
    "a tile of zeros": tree_of(np.empty((0, 0, 0)), tiles=[((0, 0, 0), 128, 0.0, True)]),
}


@pytest.mark.parametrize("which", EMPTY)
@pytest.mark.parametrize("step", [None, 0.5])
def test_a_volume_with_nothing_in_it_is_the_background(which, step):
    result = shoot(Medium(EMPTY[which]), VIEW, 10.0, step=step)
    assert_sound(result)
    assert (result.transmittance == 1).all()
    assert (result.opacity == 0).all()
    assert (result.radiance == 0).all()
    assert np.isposinf(result.depth).all()
    np.testing.assert_array_equal(over(result, SKY), np.broadcast_to(SKY, (6, 6, 4)))


@pytest.mark.parametrize("which", EMPTY)
def test_an_empty_colour_grid_is_black(which):
    tree = EMPTY[which]
    grey = replace(
        tree,
        background=np.zeros(3, np.float32),
        leaf_values=np.zeros((*tree.leaf_values.shape, 3), np.float32),
        tile_values=np.zeros((*tree.tile_values.shape, 3), np.float32),
    )
    for world in (scenes.IDENTITY, affine(0.7 * np.eye(3), (0.1, 0.2, 0.3))):
        result = shoot(of(), VIEW, 0.5, Medium(grey, world))
        assert result.opacity.max() > 0.5
        assert (result.radiance == 0).all()


def test_rays_that_miss_the_volume_see_nothing():
    m = of()
    for view in (
        View((14.0, 11.0, 21.0), (40.0, 40.0, 60.0)),  # looks away
        View((14.0, 11.0, 21.0), (14.0, 300.0, 21.0), up=(1.0, 0.0, 0.0)),
        View((100.0, 0.0, 9.0), (100.0, 0.0, 0.0), width=20.0),  # goes past, along an axis
        View((2.0, 2.0, 7.0), (2.0, 2.0, 9.0), width=4.0),  # starts beyond it
    ):
        result = shoot(m, view, 100.0)
        assert_sound(result)
        assert (result.transmittance == 1).all()
        assert result.evaluations == 0


def test_rays_on_the_faces_of_the_box_see_the_nothing_that_is_there():
    """One voxel outside the last lattice point the field has just come down to 0."""
    m = of(np.ones((2, 2, 2)))
    for sign in (-1.0, 1.0):
        at = 0.5 + sign * 1.5
        view = View((at, 0.5, 9.0), (at, 0.5, 0.0), width=1e-9, resolution=(1, 1))
        result = shoot(m, view, 1.0)
        assert_sound(result)
        assert result.optical_depth[0, 0] == pytest.approx(0.0, abs=1e-8)


@pytest.mark.parametrize("direction", [(1, 0, 0), (0, -1, 0), (0, 0, 1), (1, 1, 0), (0, -1, 1)])
@pytest.mark.parametrize("tilt", [0.0, 1e-310, 1e-300, 1e-17, 1e-9])
def test_directions_with_components_of_0_or_next_to_0_are_exact(direction, tilt):
    """1 / d is infinite or huge; 0 times it must not be NaN."""
    m = of(scenes.random_values(26, (12, 12, 12)))
    toward = np.where(np.array(direction) == 0, tilt, direction)
    middle = np.array([4.0, 4.0, 4.0])  # on a lattice plane; its pixels in and between them
    view = View(
        tuple(middle - 20 * toward), tuple(middle), (0.3, 0.5, 0.8), width=8.0, resolution=(9, 9)
    )
    tau, _, _ = truth(m, view, 0.3)
    assert tau.min() > 0.05
    result = shoot(m, view, 0.3)
    assert_sound(result)
    assert np.abs(result.transmittance - np.exp(-tau)).max() < EXACT


@pytest.mark.parametrize("tilt", [1e-310, -1e-310, -5e-324])
@pytest.mark.parametrize(
    "rule", [{}, {"step": 0.5}, {"nearest": True}, {"max_error": 0.01}], ids=str
)
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_directions_whose_inverse_is_infinite_are_those_along_an_axis(axis, rule, tilt):
    """In a lattice plane, where the distance to the next one is 0 times infinity. By packets, and
    ray by ray where colour varies."""
    eye, target = np.zeros(3), np.zeros(3)
    eye[axis], target[axis] = -9.0, 1.0
    target[(axis + 1) % 3] = 10 * tilt
    up = np.roll((0.0, 0.0, 1.0), axis)
    view = View(tuple(eye), tuple(target), tuple(up), width=1e-3, resolution=(1, 1))
    grey = medium(np.full((9, 9, 9, 3), 0.5), background=(0.5, 0.5, 0.5))
    for colour in ((0.5, 0.5, 0.5), grey):
        result = shoot(of(np.ones((8, 8, 8))), view, 0.1, colour, **rule)
        bound = 1e-6 if result.error_bound is None else float(result.error_bound[0, 0])
        assert result.transmittance[0, 0] == pytest.approx(np.exp(-0.8), abs=bound)
        assert result.radiance[0, 0, 0] == pytest.approx(-0.5 * np.expm1(-0.8), abs=bound)


def test_the_reference_knows_its_closed_forms():
    """The truth itself, on a slab of which everything is known."""
    slab = reference.Lattice(
        reference.of_array(np.ones((50, 50, 8))), np.eye(4), np.array([[0, 0, 0], [49, 49, 7]])
    )
    ray = reference.trace(
        np.array([20.2, 20.7, -5.0]), np.array([0.0, 0.0, 1.0]), slab, 2.0, slab3()
    )
    assert ray.tau == pytest.approx(2.0 * 8, rel=1e-14)
    np.testing.assert_allclose(ray.radiance, -np.expm1(-16.0) * np.ones(3) * 0.5, rtol=1e-14)
    nearest = replace(slab, nearest=True)
    ray = reference.trace(np.array([20.2, 20.7, -5.0]), np.array([0.0, 0.0, 1.0]), nearest, 0.5)
    assert ray.tau == pytest.approx(4.0, rel=1e-14)
    # E[t] over [a, b]: a + 1/s - (b - a) T / (1 - T).
    t = np.exp(-4.0)
    assert ray.distance == pytest.approx(4.5 + 2 - 8 * t / (1 - t), rel=1e-14)


def slab3():
    grey = np.full((2, 2, 2, 3), 0.5)
    return reference.Lattice(reference.of_array(grey, background=0.5), np.eye(4), np.zeros((2, 3)))
