"""Cameras against rays worked out another way, and the frame chosen when none is asked for."""

import re

import numpy as np
import pytest
import reference
from hypothesis import given
from hypothesis import strategies as st
from scenes import View

from volcli.camera import make_camera, sample_positions
from volcli.config import make_job
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


# -- the samples of a pixel -----------------------------------------------------------------------

SEQUENCE = {  # the row of each column's point, from the definition by hand
    1: [0],
    2: [0, 1],
    3: [0, 2, 1],
    4: [0, 2, 1, 3],
    5: [0, 3, 2, 4, 1],
    8: [0, 4, 2, 6, 1, 5, 3, 7],
}


@pytest.mark.parametrize("count", SEQUENCE)
def test_the_samples_of_a_pixel_are_the_documented_sequence(count):
    expected = (np.column_stack([range(count), SEQUENCE[count]]) + 0.5) / count
    assert sample_positions(count).tobytes() == expected.tobytes()


def test_one_sample_is_the_centre_of_its_pixel():
    assert sample_positions(1).tolist() == [[0.5, 0.5]]


@given(st.integers(1, 500))
def test_each_row_and_each_column_of_a_pixel_holds_one_sample_and_their_mean_is_its_centre(count):
    positions = sample_positions(count)
    for axis in (0, 1):
        assert sorted(np.floor(positions[:, axis] * count).astype(int)) == list(range(count))
    np.testing.assert_allclose(positions.mean(axis=0), 0.5, atol=1e-15)


@pytest.mark.parametrize("power", range(13))
def test_a_power_of_2_fills_every_partition_into_equal_rectangles(power):
    positions = sample_positions(2**power)
    for across in range(power + 1):
        cell = np.floor(positions * (2**across, 2 ** (power - across))).astype(int)
        assert len(np.unique(cell, axis=0)) == 2**power


@pytest.mark.parametrize("kind", ["perspective", "orthographic", "panorama"])
def test_samples_are_rays_through_their_places_in_the_pixel(kind):
    """A picture of 4 times the size has pixels whose centres lie there."""
    job = Camera(type=kind, eye=(3, -4, 9), target=(1, 0.5, -2), resolution=(5, 4))
    camera = make_camera(job, BOX)
    fine = make_camera(job.model_copy(update={"resolution": (20, 16)}), BOX)
    centres = [rays.reshape(16, 20, 3) for rays in fine.rays(ALL, ALL)]
    samples = np.array([[0.125, 0.875], [0.625, 0.375]])
    found = [rays.reshape(2, 4, 5, 3) for rays in camera.rays(ALL, ALL, samples)]
    for of_found, of_fine in zip(found, centres, strict=True):
        np.testing.assert_allclose(of_found[0], of_fine[3::4, 0::4], atol=1e-14)
        np.testing.assert_allclose(of_found[1], of_fine[1::4, 2::4], atol=1e-14)


# -- the panorama ---------------------------------------------------------------------------------


def panorama(resolution=(8, 4), eye=(0.0, 0.0, 0.0), target=(0.0, 0.0, -1.0), up=(0.0, 1.0, 0.0)):
    return make_camera(
        Camera(type="panorama", eye=eye, target=target, up=up, resolution=resolution), BOX
    )


def test_a_panorama_has_the_target_in_its_middle_and_what_is_right_of_it_to_the_right():
    """Three columns: left, ahead, right; seen from inside, so +X is right of -Z."""
    origins, directions = panorama((3, 1), eye=(1, 2, 3), target=(1, 2, -5)).rays(ALL, ALL)
    assert (origins == (1, 2, 3)).all()
    third = np.sqrt(3) / 2
    expected = [(-third, 0, 0.5), (0, 0, -1), (third, 0, 0.5)]
    np.testing.assert_allclose(directions, expected, atol=1e-15)


def test_the_top_of_a_panorama_is_up_and_its_side_edges_meet_behind():
    directions = panorama((3600, 1800)).rays(ALL, ALL)[1].reshape(1800, 3600, 3)
    half_a_pixel = np.pi / 3600
    assert (directions[0, :, 1] > np.cos(1.01 * half_a_pixel)).all()
    assert (directions[-1, :, 1] < -np.cos(1.01 * half_a_pixel)).all()
    for edge in (0, -1):
        assert directions[900, edge] @ (0, 0, 1) > np.cos(1.5 * half_a_pixel)
    assert directions[900, 0, 0] < 0 < directions[900, -1, 0]
    quarter = directions[900, 2700]
    np.testing.assert_allclose(quarter, (1, 0, 0), atol=1.01 * np.sqrt(2) * half_a_pixel)


@given(point, point, st.integers(0, 5), st.integers(0, 8))
def test_a_panorama_is_longitude_and_latitude_about_its_frame(target, up, row, column):
    if np.linalg.norm(np.cross(target, up)) < 1e-3:
        return
    camera = panorama((9, 6), target=target, up=up)
    _, (direction,) = camera.rays(slice(row, row + 1), slice(column, column + 1))
    assert np.linalg.norm(direction) == pytest.approx(1, abs=1e-14)
    local = [direction @ v for v in (camera.right, camera.upward, camera.forward)]
    assert np.arcsin(local[1]) == pytest.approx(np.pi * (0.5 - (row + 0.5) / 6), abs=1e-9)
    turn = np.arctan2(local[0], local[2]) - 2 * np.pi * ((column + 0.5) / 9 - 0.5)
    assert np.cos(turn) == pytest.approx(1, abs=1e-12)


def test_a_part_of_a_panorama_has_the_rays_of_the_whole_bit_by_bit():
    camera = panorama((131, 67), target=(1, 2, 3), up=(0.1, 1, 0.3))
    whole = camera.rays(ALL, ALL)[1].reshape(67, 131, 3)
    for rows, columns in ((slice(3, 4), slice(1, 2)), (slice(5, 66), slice(13, 120))):
        part = camera.rays(rows, columns)[1]
        assert part.tobytes() == whole[rows, columns].tobytes()


def test_depth_of_a_panorama_is_distance():
    camera = panorama()
    assert (camera.depth_per_distance(camera.rays(ALL, ALL)[1]) == 1).all()


@pytest.mark.parametrize(("up", "ahead"), [((0, 1, 0), (0, 0, -1)), ((0, 0, 1), (-1, 0, 0))])
def test_a_panorama_is_taken_from_the_middle_of_the_box_straight_ahead(up, ahead):
    camera = make_camera(Camera(type="panorama", up=up), BOX)
    np.testing.assert_array_equal(camera.eye, BOX.mean(axis=0))
    np.testing.assert_allclose(camera.forward, ahead, atol=1e-15)
    assert camera.resolution == (1024, 512)
    far = make_camera(Camera(type="panorama", up=up), BOX + 1e9)
    np.testing.assert_allclose(far.forward, ahead, atol=1e-6)


def test_a_panorama_from_outside_looks_at_the_middle_of_the_box():
    camera = make_camera(Camera(type="panorama", eye=(9, 9, 9)), BOX)
    np.testing.assert_array_equal(camera.target, BOX.mean(axis=0))


# -- focal lengths in pixels ----------------------------------------------------------------------


def test_focal_lengths_and_a_principal_point_are_those_of_a_pinhole():
    """At distance 1: x = (column + 1/2 - cx) / f_x, y = (cy - row - 1/2) / f_y."""
    lens = {"focal": (10, 20), "principal": (1.5, 7), "resolution": (4, 3)}
    camera = make_camera(Camera(eye=(0, 0, 0), target=(0, 0, -1), **lens), BOX)
    _, directions = camera.rays(ALL, ALL)
    plane = (directions / -directions[:, 2:]).reshape(3, 4, 3)
    np.testing.assert_allclose(plane[0, :, 0], [-0.1, 0.0, 0.1, 0.2], atol=1e-16)
    np.testing.assert_allclose(plane[:, 0, 1], [0.325, 0.275, 0.225])


def test_focal_of_a_field_of_view_is_the_same_camera():
    pose = {"eye": (3, -4, 9), "target": (1, 0.5, -2), "resolution": (7, 5)}
    one = make_camera(Camera(fov=50, **pose), BOX)
    focal = 2.5 / np.tan(np.radians(25))
    two = make_camera(Camera(focal=(focal, focal), **pose), BOX)
    np.testing.assert_allclose(one.rays(ALL, ALL)[1], two.rays(ALL, ALL)[1], atol=1e-15)


# -- what does not go together --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"type": "panorama", "fov": 40.0}, 'camera.fov is for camera.type = "perspective"'),
        ({"type": "panorama", "width": 4.0}, 'camera.width is for camera.type = "orthographic"'),
        ({"type": "orthographic", "fov": 40.0}, 'camera.fov is for camera.type = "perspective"'),
        ({"type": "panorama", "focal": (1, 1)}, 'camera.focal is for camera.type = "perspective"'),
        ({"fov": 40.0, "focal": (1.0, 1.0)}, "camera.focal and camera.fov exclude each other"),
        ({"focal": (1.0, 1.0), "eye": (0, 0, 1)}, "camera.focal is for a camera with camera.eye"),
        ({"principal": (1.0, 1.0)}, "camera.principal is for a camera with camera.focal"),
        ({"frame": 0}, "camera.frame is for camera.transforms"),
        ({"transforms": "t.json", "eye": (0, 0, 1)}, "camera.eye is for a camera without"),
        ({"transforms": "t.json", "up": (0, 0, 1)}, "camera.up is for a camera without"),
        ({"transforms": "t.json", "type": "panorama"}, "camera.type is for a camera without"),
        ({"frame": -1, "transforms": "t.json"}, "camera.frame: must be a whole number from 0"),
        ({"frame": True, "transforms": "t.json"}, "camera.frame: must be a whole number from 0"),
        ({"frame": "some", "transforms": "t.json"}, "camera.frame: must be a whole number from 0"),
        ({"samples": 0}, "camera.samples: must be at least 1"),
        ({"samples": 2.5}, "camera.samples: must be a whole number"),
        ({"samples": 5000}, "camera.samples: must be at most 4096"),
    ],
    ids=lambda value: value if isinstance(value, str) else None,
)
def test_fields_of_a_camera_that_do_not_apply_are_refused_by_name(fields, message):
    with pytest.raises(UsageError, match=re.escape(message)):
        make_job({"camera": fields})
