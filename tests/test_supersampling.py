"""Pictures of several rays a pixel, and of the panorama, against the reference and closed forms."""

import numpy as np
import pytest
import reference
import scenes
from scenes import EVERYTHING, Medium, View, affine, medium, plan_for, shoot, tree_of

import volcli.render
from volcli.camera import make_camera
from volcli.render import Scene, make_integrator
from volcli.schema import Camera

BOX = np.array([[-1.0] * 3, [1.0] * 3])

ROWS = {2: [0, 1], 3: [0, 2, 1], 4: [0, 2, 1, 3], 5: [0, 3, 2, 4, 1]}
"""Of the pixel's equal columns, from left to right, the row that holds the sample."""


def camera_of(view, **fields):
    """volcli's camera of a view, with more fields of a job."""
    kind = {"fov": view.fov}
    if view.width is not None:
        kind = {"type": "orthographic", "width": view.width}
    asked = {n: tuple(map(float, getattr(view, n))) for n in ("eye", "target", "up")}
    return make_camera(Camera(resolution=view.resolution, **kind, **asked, **fields), BOX)


def noise(transform="rotated"):
    shape, origin = (9, 8, 10), (-3, 2, -5)
    m = medium(scenes.random_values(0, shape, zeros=0.6), origin, scenes.TRANSFORMS[transform])
    return m, medium(scenes.random_colours(1, shape), origin, m.world_from_index)


def view_of(m, resolution=(7, 5), **kwargs):
    middle = m.box.mean(axis=0)
    eye, target = m.world(middle + np.array([11, 7, 15])), m.world(middle)
    return View(tuple(eye), tuple(target), (0.1, 1, 0.2), resolution=resolution, **kwargs)


def samples_of(view, count):
    """Rays of the reference, (count, h, w, 3): centres of the pixels of a picture count times as
    large in both directions, of which one in each row and column of a pixel is a sample.
    """
    width, height = view.resolution
    fine = View(
        view.eye, view.target, view.up, view.fov, view.width, (count * width, count * height)
    )
    return tuple(
        np.stack([rays[row::count, column::count] for column, row in enumerate(ROWS[count])])
        for rays in fine.rays
    )


@pytest.mark.parametrize("count", ROWS)
@pytest.mark.parametrize("width", [None, 9.0])
def test_a_picture_of_several_samples_is_the_mean_of_its_rays(count, width):
    """Depth is the mean of the samples' depths, weighted with their opacity."""
    m, source = noise()
    view = view_of(m, fov=32, width=width)
    scale = 0.6
    origins, directions = samples_of(view, count)
    tau, radiance, distance = reference.trace_all(
        origins, directions, m.lattice(), scale, source.lattice()
    )
    opacity = -np.expm1(-tau)
    result = shoot(m, camera_of(view, samples=count), scale, source)

    np.testing.assert_allclose(result.optical_depth, tau.mean(axis=0), rtol=1e-6, atol=1e-12)
    assert np.abs(result.transmittance - np.exp(-tau).mean(axis=0)).max() < 1e-7
    assert np.abs(result.opacity - opacity.mean(axis=0)).max() < 1e-7
    assert np.abs(result.radiance - radiance.mean(axis=0)).max() < 1e-4 * radiance.max()

    forward = np.subtract(view.target, view.eye) / np.linalg.norm(
        np.subtract(view.target, view.eye)
    )
    depth = np.where(tau > 0, distance * (directions @ forward), 0.0)
    hit = opacity.sum(axis=0) > 0
    assert hit.any()
    assert not (tau > 0).all(axis=0)[hit].all(), "some pixels are hit by a part of their rays"
    np.testing.assert_array_equal(np.isposinf(result.depth), ~hit)
    expected = (opacity * depth).sum(axis=0)[hit] / opacity.sum(axis=0)[hit]
    np.testing.assert_allclose(result.depth[hit], expected, rtol=1e-4)


def test_one_sample_is_the_picture_of_before_bit_by_bit():
    m, _ = noise()
    view = view_of(m, (13, 9))
    colour = (0.3, 1.0, 7.0)
    plain, asked = shoot(m, view, 1.0, colour), shoot(m, camera_of(view, samples=1), 1.0, colour)
    integrate = make_integrator(Scene(m.grid, 1.0, colour), plan_for())
    origins, directions = view.camera.rays(slice(None), slice(None))
    tau, _, distance, _, _ = integrate(origins, directions)
    light = -np.expm1(-tau)[:, None] * colour
    depth = distance * (directions @ view.camera.forward)
    for result in (plain, asked):
        assert result.optical_depth.tobytes() == np.float32(tau).tobytes()
        assert result.transmittance.tobytes() == np.float32(np.exp(-tau)).tobytes()
        assert result.opacity.tobytes() == np.float32(-np.expm1(-tau)).tobytes()
        assert result.radiance.tobytes() == np.float32(light).tobytes()
        assert result.depth.tobytes() == np.float32(depth).tobytes()


@pytest.mark.needs_jit
@pytest.mark.parametrize("count", [2, 5, 64])
def test_a_picture_of_several_samples_does_not_depend_on_tiles_and_threads(count, monkeypatch):
    m, source = noise()
    camera = camera_of(view_of(m, (23, 17)), samples=count)
    pictures = []
    for tile, threads in ((64, 1), (64, 3), (7, 2), (1, 1)):
        monkeypatch.setattr(volcli.render, "TILE", tile)
        pictures.append(shoot(m, camera, 1.0, source, threads))
    for name in ("radiance", "optical_depth", "transmittance", "opacity", "depth"):
        first, *others = [getattr(picture, name).tobytes() for picture in pictures]
        assert all(other == first for other in others), name


def test_the_mean_of_a_pixel_is_added_up_alike_in_a_tile_of_one_pixel_and_of_many():
    """NumPy's own sum is not: along one axis of one column it adds by pairs."""
    values = np.random.default_rng(0).random((300, 5, 7))
    whole = volcli.render._mean(values)
    for y, x in np.ndindex(5, 7):
        assert volcli.render._mean(values[:, y : y + 1, x : x + 1]) == whole[y, x]


def test_depth_of_several_samples_is_that_of_a_hit_however_thin_the_medium():
    """Opacities near the smallest number there is still weigh the distances: all are 10."""
    m = medium(np.ones((8, 8, 8)), world_from_index=affine(np.diag([1.0, 1.0, 1e-9])))
    view = View((3.5, 3.5, 10.0), (3.5, 3.5, 0.0), width=16.0, resolution=(6, 6))
    for scale in (1e-300, 1e-20, 1.0, 1e20):
        result = shoot(m, camera_of(view, samples=4), scale, nearest=True)
        hit = np.isfinite(result.depth)
        assert 4 <= hit.sum() < 36
        np.testing.assert_allclose(result.depth[hit], 10.0, rtol=1e-6)


def clipped_area(polygon, low, high):
    """The area of a convex polygon (n, 2) inside a rectangle (Sutherland and Hodgman)."""
    for axis in (0, 1):
        for sign, bound in ((1, low[axis]), (-1, -high[axis])):
            inside = [sign * p[axis] - bound for p in polygon]
            kept = []
            for i, point in enumerate(polygon):
                before = i - 1
                if (inside[before] < 0) != (inside[i] < 0):
                    t = inside[before] / (inside[before] - inside[i])
                    kept.append(polygon[before] + t * (point - polygon[before]))
                if inside[i] >= 0:
                    kept.append(point)
            polygon = kept
    if not polygon:
        return 0.0
    x, y = np.transpose(polygon)
    return abs(x @ np.roll(y, 1) - y @ np.roll(x, 1)) / 2


@pytest.mark.needs_jit
def test_samples_converge_to_the_part_of_a_pixel_that_a_box_covers():
    """A homogeneous cube seen along its axis, turned in the picture: opacity is the part of the
    pixel that it covers times 1 - exp(-8 sigma)."""
    m = medium(np.ones((8, 8, 8)))
    angle = np.radians(27)
    view = View(
        (3.5, 3.5, 50.0), (3.5, 3.5, 0.0), (np.sin(angle), np.cos(angle), 0.0), 40, 15.0, (15, 13)
    )
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    square = list(np.array([[-4, -4], [4, -4], [4, 4], [-4, 4]]) @ turn.T)
    covered = np.array(
        [
            [clipped_area(square, (x - 7.5, 5.5 - y), (x - 6.5, 6.5 - y)) for x in range(15)]
            for y in range(13)
        ]
    )
    assert covered.sum() == pytest.approx(64)
    truth = covered * -np.expm1(-8 * 0.25)
    errors = {}
    for count in (1, 4, 16, 64, 256):
        picture = shoot(m, camera_of(view, samples=count), 0.25, nearest=True)
        errors[count] = np.abs(picture.opacity - truth).max()
    assert errors[1] > 0.25, "the edges cross pixels"
    assert errors[4] < 0.2
    assert errors[16] < 0.1
    assert errors[64] < 0.04
    assert errors[256] < 0.015


def test_evaluations_count_every_sample():
    m, _ = noise()
    view = view_of(m)
    one, four = (shoot(m, camera_of(view, samples=n)).evaluations for n in (1, 4))
    assert 3 < four / one < 5


# -- the panorama ---------------------------------------------------------------------------------


def panorama(eye, resolution=(16, 8), **fields):
    return make_camera(Camera(type="panorama", eye=eye, resolution=resolution, **fields), BOX)


def test_a_panorama_from_the_middle_of_a_homogeneous_cube_is_its_closed_form():
    """Along a direction the half cube of edge 8 is 4 / its largest component long; a hit in a
    homogeneous medium of length L is at 1 / sigma - L exp(-sigma L) / (1 - exp(-sigma L))."""
    m = medium(np.ones((8, 8, 8)), (-4, -4, -4), affine(np.eye(3), (0.5, 0.5, 0.5)))
    camera = panorama((0.0, 0.0, 0.0), target=(0.3, 0.2, 1.0), up=(0.1, 1, 0.2))
    sigma = 0.3
    result = shoot(m, camera, sigma, nearest=True)
    _, directions = camera.rays(slice(None), slice(None))
    length = (4 / np.abs(directions).max(axis=1)).reshape(8, 16)
    tau = sigma * length
    np.testing.assert_allclose(result.optical_depth, tau, rtol=1e-6)
    depth = 1 / sigma - length * np.exp(-tau) / -np.expm1(-tau)
    np.testing.assert_allclose(result.depth, depth, rtol=1e-6)


def test_a_panorama_from_the_middle_of_a_ball_is_constant():
    """Density falls from 1 to 0 over the ball's last voxel, so that its lattice is seen less."""
    radius = 20
    axes = np.indices((2 * radius + 5,) * 3) - (radius + 2.0)
    ball = np.clip(radius + 0.5 - np.sqrt((axes**2).sum(axis=0)), 0, 1)
    m = medium(ball, (-radius - 2,) * 3)
    result = shoot(m, panorama((0.0, 0.0, 0.0), (32, 16), target=(0.0, 0.0, -1.0)), 0.05)
    np.testing.assert_allclose(result.optical_depth, 0.05 * radius, rtol=5e-3)
    assert np.ptp(result.depth) < 0.01 * result.depth.mean()


def test_a_voxel_is_where_the_panorama_says_that_it_is():
    """One dense voxel to the right of the target and above the horizon, seen from inside."""
    m = Medium(tree_of(np.ones((1, 1, 1)), (10, 10, -10)), box=np.array([[10, 10, -10]] * 2))
    camera = panorama((0.0, 0.0, 0.0), (36, 18), target=(0.0, 0.0, -1.0))
    result = shoot(m, camera, 100.0)
    y, x = np.unravel_index(np.argmax(result.opacity), result.opacity.shape)
    # 45 degrees to the right; up by arctan(1 / sqrt 2), 35.26 degrees; a pixel is 10 degrees.
    assert (x, y) == (18 + 4, 5)


@pytest.mark.parametrize("layers", [{"opacity"}, EVERYTHING])
def test_an_absent_depth_stays_absent_with_several_samples(layers):
    m, _ = noise()
    result = shoot(m, camera_of(view_of(m), samples=3), layers=layers)
    assert (result.depth is None) == ("depth" not in layers)
