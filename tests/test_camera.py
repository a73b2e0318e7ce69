"""Cameras against rays worked out another way, and the frame chosen when none is asked for."""

import numpy as np
import pytest
import reference
from hypothesis import given
from hypothesis import strategies as st
from scenes import View

from volcli.camera import make_camera
from volcli.errors import UsageError
from volcli.schema import Camera

BOX = np.array([[-1.0, -2.0, -3.0], [4.0, 1.0, 2.0]])
ALL = slice(None)

near = st.floats(-10, 10).map(lambda x: round(x, 3))
point = st.tuples(near, near, near)


def corners(box):
    return np.array([[box[i, 0], box[j, 1], box[k, 2]] for i, j, k in np.ndindex(2, 2, 2)])


def pixels_of(camera, points):
    """Where points are in the picture, from -1 to 1 across each of its sides, and how far off."""
    away = np.asarray(points) - camera.eye
    along = away @ camera.forward
    scale = along if camera.type == "perspective" else 1.0
    half_width, half_height = np.multiply(camera.resolution, camera.pixel) / 2
    y = away @ camera.upward / scale / half_height
    x = away @ camera.right / scale / half_width
    return x, y, along


@pytest.mark.parametrize("width", [None, 7.5])
@pytest.mark.parametrize("resolution", [(8, 6), (5, 9), (1, 1)])
def test_rays_are_those_of_an_independent_camera(width, resolution):
    view = View((3.0, -4.0, 9.0), (1.0, 0.5, -2.0), (0.3, 1.0, 0.1), 57.0, width, resolution)
    origins, directions = view.camera.rays(ALL, ALL)
    expected_origins, expected_directions = view.rays
    np.testing.assert_allclose(origins, expected_origins.reshape(-1, 3), atol=1e-13)
    np.testing.assert_allclose(directions, expected_directions.reshape(-1, 3), atol=1e-14)


def test_the_first_row_is_the_top_and_the_first_column_is_left():
    """Looking along -Z with Y up, X is to the right."""
    view = View((0.0, 0.0, 5.0), (0.0, 0.0, 0.0), fov=90.0, resolution=(4, 2))
    _, directions = view.camera.rays(ALL, ALL)
    grid = (directions / -directions[:, 2:]).reshape(2, 4, 3)
    np.testing.assert_allclose(grid[0, :, 0], [-1.5, -0.5, 0.5, 1.5])
    np.testing.assert_allclose(grid[:, 0, 1], [0.5, -0.5])


@pytest.mark.parametrize("width", [None, 4.0])
def test_a_part_of_the_picture_has_the_rays_of_the_whole_bit_by_bit(width):
    camera = View((3.0, -4.0, 9.0), (1.0, 0.5, -2.0), width=width, resolution=(13, 11)).camera
    whole = [a.reshape(11, 13, 3) for a in camera.rays(ALL, ALL)]
    part = camera.rays(slice(2, 7), slice(5, 13))
    for a, b in zip(whole, part, strict=True):
        assert a[2:7, 5:13].tobytes() == b.tobytes()


@given(point, point, point, st.floats(1.0, 170.0), st.booleans())
def test_directions_have_length_1_and_the_frame_is_right_handed(eye, target, up, fov, parallel):
    forward = np.subtract(target, eye)
    if np.linalg.norm(np.cross(forward, up)) < 1e-3:
        return
    view = View(eye, target, up, fov, 3.0 if parallel else None, (3, 3))
    camera = view.camera
    _, directions = camera.rays(ALL, ALL)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0, atol=1e-14)
    frame = np.array([camera.right, camera.upward, -camera.forward])
    np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(frame) == pytest.approx(1.0)
    assert camera.upward @ np.array(up) > 0
    # The middle of the picture looks at the target.
    np.testing.assert_allclose(directions[4], forward / np.linalg.norm(forward), atol=1e-12)


def test_depth_is_distance_times_the_cosine_to_the_cameras_axis():
    camera = View((0.0, 0.0, 5.0), (0.0, 0.0, 0.0), fov=90.0, resolution=(1, 3)).camera
    _, directions = camera.rays(ALL, ALL)
    edge = 1 / np.sqrt(1 + (2 / 3) ** 2)
    np.testing.assert_allclose(camera.depth_per_distance(directions), [edge, 1.0, edge], rtol=1e-14)


def test_the_length_of_up_does_not_matter():
    pictures = [
        View((3.0, 4.0, 5.0), (0.0, 0.0, 0.0), tuple(k * np.array([0.1, 1.0, 0.3]))).camera
        for k in (1e-150, 1.0, 1e150)
    ]
    for camera in pictures[1:]:
        np.testing.assert_allclose(camera.right, pictures[0].right, atol=1e-14)


@pytest.mark.parametrize("kind", ["perspective", "orthographic"])
@pytest.mark.parametrize("resolution", [(80, 60), (30, 90), (200, 10)])
@pytest.mark.parametrize("up", [(0, 1, 0), (0, 0, 1), (1, 0, 0), (1, 1, 1)])
def test_the_chosen_frame_holds_the_whole_box_and_is_not_far_too_large(kind, resolution, up):
    camera = make_camera(Camera(type=kind, resolution=resolution, up=up), BOX)
    x, y, along = pixels_of(camera, corners(BOX))
    assert (along > 0).all(), "all of it is before the camera"
    largest = max(np.abs(x).max(), np.abs(y).max())
    assert 0.8 < largest <= 1 / 1.05 + 1e-9
    np.testing.assert_allclose(camera.target, BOX.mean(axis=0))


def test_the_chosen_eye_is_on_plus_z_or_where_z_is_up_on_plus_x():
    y_up = make_camera(Camera(), BOX)
    assert y_up.eye[2] > BOX[1, 2]
    np.testing.assert_allclose(y_up.eye[:2], y_up.target[:2])
    z_up = make_camera(Camera(up=(0, 0, 1)), BOX)
    assert z_up.eye[0] > BOX[1, 0]
    np.testing.assert_allclose(z_up.eye[1:], z_up.target[1:])


def test_an_eye_alone_looks_at_the_middle_of_the_box():
    camera = make_camera(Camera(eye=(9, 9, 9)), BOX)
    np.testing.assert_array_equal(camera.eye, [9, 9, 9])
    np.testing.assert_allclose(camera.target, BOX.mean(axis=0))


def test_a_target_alone_is_looked_at_from_where_all_of_the_box_is_seen():
    camera = make_camera(Camera(target=(3, 0, 1)), BOX)
    np.testing.assert_array_equal(camera.target, [3, 0, 1])
    x, y, along = pixels_of(camera, corners(BOX))
    assert (along > 0).all()
    assert max(np.abs(x).max(), np.abs(y).max()) <= 1.0


def test_the_width_of_an_orthographic_picture_is_kept():
    camera = make_camera(Camera(type="orthographic", width=12.0, resolution=(60, 20)), BOX)
    assert camera.pixel == pytest.approx((0.2, 0.2))


@pytest.mark.parametrize("kind", ["perspective", "orthographic"])
def test_a_box_of_one_point_has_a_frame(kind):
    camera = make_camera(Camera(type=kind), np.full((2, 3), 5.0))
    origins, directions = camera.rays(ALL, slice(0, 2))
    assert np.isfinite(origins).all()
    assert np.isfinite(directions).all()
    assert (camera.eye != camera.target).any()


def test_a_camera_at_its_own_target_is_refused():
    with pytest.raises(UsageError, match="same point as the target"):
        make_camera(Camera(eye=(1, 2, 3), target=(1, 2, 3)), BOX)


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 0, -5), (1e-12, 0, 1)])
def test_an_up_along_the_view_is_refused(up):
    with pytest.raises(UsageError, match=r"up .* lies along the view direction"):
        make_camera(Camera(eye=(0, 0, 9), target=(0, 0, 0), up=up), BOX)


def test_the_references_camera_knows_its_closed_form():
    """45 degrees up and down at the middles of the edges of a picture of 90 degrees."""
    origins, directions = reference.pinhole((0, 0, 0), (0, 0, -1), (0, 1, 0), 90, (1001, 1001))
    assert (origins == 0).all()
    np.testing.assert_allclose(directions[0, 500] * np.sqrt(2), [0, 1, -1], atol=2e-3)
    origins, directions = reference.orthographic((0, 0, 0), (0, 0, -1), (0, 1, 0), 4, (4, 2))
    np.testing.assert_allclose(origins[0, :, 0], [-1.5, -0.5, 0.5, 1.5])
    np.testing.assert_allclose(origins[:, 0, 1], [0.5, -0.5])
