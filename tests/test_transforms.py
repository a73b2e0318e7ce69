"""Cameras of a NeRF transforms.json: their rays, their pictures, and what is refused of them."""

import json
import math
import re
import tomllib

import numpy as np
import pytest
from commandline import volcli, write_ball
from hypothesis import given
from hypothesis import strategies as st
from scenes import rotation

from volcli.camera import make_camera
from volcli.config import load_job, make_job
from volcli.errors import UsageError
from volcli.images import read_exr
from volcli.run import prepare
from volcli.transforms import each_camera

BOX = np.array([[-1.0] * 3, [1.0] * 3])
ALL = slice(None)

TURN = rotation((1, 2, 3), 40)
EYE = np.array([2.0, -1.0, 5.0])


def matrix(turn=TURN, eye=EYE):
    """Camera to world."""
    m = np.eye(4)
    m[:3, :3], m[:3, 3] = turn, eye
    return m.tolist()


def write(path, *frames, **shared):
    """A transforms.json; a frame without a matrix gets one."""
    frames = [{"transform_matrix": matrix(), **frame} for frame in frames or [{}]]
    path.write_text(json.dumps({**shared, "frames": frames}))
    return path


def cameras(path, **fields):
    job = make_job({"camera": {"transforms": str(path), **fields}})
    return [make_camera(one.camera, BOX) for one in each_camera(job)]


def directions(turn, focal, principal, size):
    """(h, w, 3) unit directions of a pinhole, from the definition: R (x, -y, -1)."""
    (fx, fy), (cx, cy), (width, height) = focal, principal, size
    x = (np.arange(width) + 0.5 - cx) / fx
    y = (np.arange(height) + 0.5 - cy) / fy
    through = np.stack(
        [
            np.broadcast_to(x, (height, width)),
            np.broadcast_to(-y[:, None], (height, width)),
            np.full((height, width), -1.0),
        ],
        axis=-1,
    )
    through = through @ np.asarray(turn).T
    return through / np.linalg.norm(through, axis=-1, keepdims=True)


def assert_rays(camera, turn, eye, focal, principal, size):
    assert camera.resolution == size
    origins, found = camera.rays(ALL, ALL)
    np.testing.assert_array_equal(origins, np.broadcast_to(eye, origins.shape))
    expected = directions(turn, focal, principal, size).reshape(-1, 3)
    np.testing.assert_allclose(found, expected, atol=4e-15)


# -- rays -----------------------------------------------------------------------------------------


def test_camera_angle_x_is_horizontal_and_pixels_are_square(tmp_path):
    path = write(tmp_path / "t.json", camera_angle_x=0.7)
    (camera,) = cameras(path, resolution=(8, 6))
    focal = 4 / math.tan(0.35)
    assert_rays(camera, TURN, EYE, (focal, focal), (4, 3), (8, 6))


def test_a_synthetic_scene_without_a_size_has_the_size_of_nerfs_own(tmp_path):
    (camera,) = cameras(write(tmp_path / "t.json", camera_angle_x=0.7))
    assert camera.resolution == (800, 800)


def test_intrinsics_in_pixels_are_those_of_the_file(tmp_path):
    path = write(tmp_path / "t.json", fl_x=9.5, fl_y=7.25, cx=3.0, cy=4.5, w=8, h=6.0)
    (camera,) = cameras(path)
    assert_rays(camera, TURN, EYE, (9.5, 7.25), (3.0, 4.5), (8, 6))


def test_without_fl_y_and_principal_point_pixels_are_square_and_the_axis_in_the_middle(tmp_path):
    (camera,) = cameras(write(tmp_path / "t.json", fl_x=9.5, w=8, h=6))
    assert_rays(camera, TURN, EYE, (9.5, 9.5), (4, 3), (8, 6))


def test_a_frame_has_intrinsics_of_its_own(tmp_path):
    other = rotation((0, 1, 1), 100)
    path = write(
        tmp_path / "t.json",
        {},
        {"fl_x": 20, "w": 4, "h": 4, "cx": 1, "transform_matrix": matrix(other, EYE * 2)},
        fl_x=9.5,
        w=8,
        h=6,
        cy=2,
    )
    first, second = cameras(path, frame="all")
    assert_rays(first, TURN, EYE, (9.5, 9.5), (4, 2), (8, 6))
    assert_rays(second, other, EYE * 2, (20, 20), (1, 2), (4, 4))


def test_fl_x_wins_over_camera_angle_x(tmp_path):
    (camera,) = cameras(write(tmp_path / "t.json", fl_x=9.5, w=8, h=6, camera_angle_x=0.1))
    assert_rays(camera, TURN, EYE, (9.5, 9.5), (4, 3), (8, 6))


@pytest.mark.parametrize("size", [(16, 12), (4, 3), (16, 4), (4, 16)])
def test_another_size_shows_the_same_width_and_keeps_the_shape_of_pixels(tmp_path, size):
    """In units of the picture's width: the same focal lengths, and the axis as far from the
    middle."""
    path = write(tmp_path / "t.json", fl_x=9.5, fl_y=7.25, cx=3.0, cy=4.5, w=8, h=6)
    (camera,) = cameras(path, resolution=size)
    k = size[0] / 8
    principal = (3.0 * k, size[1] / 2 + 1.5 * k)
    assert_rays(camera, TURN, EYE, (9.5 * k, 7.25 * k), principal, size)


def test_focal_lengths_in_pixels_of_no_known_picture_are_of_the_size_asked_for(tmp_path):
    path = write(tmp_path / "t.json", fl_x=9.5)
    (camera,) = cameras(path, resolution=(8, 6))
    assert_rays(camera, TURN, EYE, (9.5, 9.5), (4, 3), (8, 6))
    with pytest.raises(UsageError, match="picture of unknown size; give camera"):
        cameras(path)


def test_rows_of_the_matrix_may_be_three(tmp_path):
    path = write(tmp_path / "t.json", {"transform_matrix": matrix()[:3]}, fl_x=9.5, w=8, h=6)
    (camera,) = cameras(path)
    assert_rays(camera, TURN, EYE, (9.5, 9.5), (4, 3), (8, 6))


@pytest.mark.parametrize("far", [0.0, 1e-6, 1e6, 1e12])
def test_a_camera_keeps_its_directions_wherever_it_is(tmp_path, far):
    eye = far * np.array([1.0, -0.3, 0.7])
    path = write(tmp_path / "t.json", {"transform_matrix": matrix(TURN, eye)}, fl_x=9.5, w=8, h=6)
    (camera,) = cameras(path)
    assert_rays(camera, TURN, eye, (9.5, 9.5), (4, 3), (8, 6))


@given(st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda a: np.linalg.norm(a) > 0.1),
       st.floats(-360, 360))  # fmt: skip
def test_any_rotation_is_taken_as_it_is(tmp_path_factory, axis, degrees):
    turn = rotation(axis, degrees)
    path = tmp_path_factory.mktemp("t") / "t.json"
    (camera,) = cameras(write(path, {"transform_matrix": matrix(turn)}, fl_x=3, w=4, h=4))
    assert_rays(camera, turn, EYE, (3, 3), (2, 2), (4, 4))


def test_a_matrix_of_few_digits_is_a_camera(tmp_path):
    rounded = np.round(matrix(), 4).tolist()
    (camera,) = cameras(write(tmp_path / "t.json", {"transform_matrix": rounded}, fl_x=3, w=4, h=4))
    expected = directions(TURN, (3, 3), (2, 2), (4, 4)).reshape(-1, 3)
    np.testing.assert_allclose(camera.rays(ALL, ALL)[1], expected, atol=2e-4)


def test_the_number_of_samples_is_that_of_the_job(tmp_path):
    (camera,) = cameras(write(tmp_path / "t.json", fl_x=3, w=4, h=4), samples=5)
    assert len(camera.samples) == 5


def test_a_job_without_transforms_is_its_own_picture():
    job = make_job({"camera": {"eye": [1, 2, 3]}})
    assert each_camera(job) == (job,)


# -- which frames ---------------------------------------------------------------------------------


def three(path):
    return write(path, *({"cx": float(n)} for n in range(3)), fl_x=9, w=8, h=6)


def test_a_frame_is_chosen_by_its_number_and_the_first_is_the_default(tmp_path):
    path = three(tmp_path / "t.json")
    assert [c.principal[0] for c in cameras(path)] == [0]
    assert [c.principal[0] for c in cameras(path, frame=2)] == [2]
    assert [c.principal[0] for c in cameras(path, frame="all")] == [0, 1, 2]


def test_a_frame_that_there_is_not_is_refused_with_the_number_that_there_are(tmp_path):
    path = three(tmp_path / "t.json")
    with pytest.raises(UsageError, match=r"t\.json: .* no frame 3 .*; it has 3, the first is 0"):
        cameras(path, frame=3)


def test_outputs_of_all_frames_are_numbered(tmp_path):
    path = three(tmp_path / "t.json")
    tables = {"camera": {"transforms": str(path), "frame": "all"}, "output": {"image": "a/b.exr"}}
    named = [str(job.output.image) for job in each_camera(make_job(tables))]
    assert named == ["a/b.0000.exr", "a/b.0001.exr", "a/b.0002.exr"]


# -- what is refused ------------------------------------------------------------------------------

LENS = {"fl_x": 9, "w": 8, "h": 6}


def changed(row, column, value):
    m = matrix()
    m[row][column] = value
    return m


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"transform_matrix": (2 * np.array(matrix())).tolist()}, "scales the camera.* 2, 2, 2"),
        ({"transform_matrix": matrix(TURN * 0.01)}, "scales the camera.* 0.01, 0.01, 0.01"),
        ({"transform_matrix": matrix(TURN * 0)}, "scales the camera.* 0, 0, 0"),
        ({"transform_matrix": matrix(TURN @ [[1, 0.6, 0], [0, 0.8, 0], [0, 0, 1]])},
         "shears the camera.*cosine 0.6"),
        ({"transform_matrix": matrix(TURN @ np.diag([1, 1, -1]))}, "mirrors the camera"),
        ({"transform_matrix": changed(1, 2, math.nan)}, "4 rows of 4 finite numbers"),
        ({"transform_matrix": changed(0, 3, math.inf)}, "4 rows of 4 finite numbers"),
        ({"transform_matrix": changed(0, 3, 10**400)}, "4 rows of 4 finite numbers"),
        ({"transform_matrix": changed(0, 3, "1")}, "4 rows of 4 finite numbers"),
        ({"transform_matrix": changed(0, 3, True)}, "4 rows of 4 finite numbers"),
        ({"transform_matrix": matrix()[:2]}, "4 rows of 4 finite numbers"),
        ({"transform_matrix": 5}, "4 rows of 4 finite numbers"),
        ({"transform_matrix": changed(3, 3, 2.0)}, "must end in the row 0, 0, 0, 1"),
        ({"transform_matrix": changed(2, 3, -1.7e308)}, "its target is out of range"),
        ({"fl_x": 1e-320}, "its focal is out of range"),
        ({"k1": 0.03}, "k1 = 0.03: lenses that distort"),
        ({"p2": -1e-5}, "p2 = -1e-05: lenses that distort"),
        ({"k4": "much"}, "k4 must be a finite number"),
        ({"is_fisheye": True}, "is_fisheye = True: lenses that distort"),
        ({"camera_model": "OPENCV_FISHEYE"}, "camera_model 'OPENCV_FISHEYE' is not a pinhole"),
        ({"camera_model": "EQUIRECTANGULAR"}, "camera_model 'EQUIRECTANGULAR' is not a pinhole"),
        ({"camera_model": [1]}, r"camera_model \[1\] is not a pinhole"),
        ({"fl_x": 0}, "fl_x = 0: must be above 0"),
        ({"fl_y": -3}, "fl_y = -3: must be above 0"),
        ({"fl_x": "9"}, "fl_x must be a finite number"),
        ({"cx": None}, "cx must be a finite number"),
        ({"w": 7.5}, "w = 7.5: must be a whole number of pixels"),
        ({"h": 0}, "h = 0: must be a whole number of pixels"),
        ({"h": 1e9}, "h = 1e[+]09: must be a whole number of pixels"),
    ],
)  # fmt: skip
def test_a_camera_that_is_not_a_pinhole_is_refused_with_its_frame_and_the_reason(
    tmp_path, entries, message
):
    path = write(tmp_path / "t.json", {}, entries, **LENS)
    with pytest.raises(UsageError, match=rf"t\.json: frame 1: .*{message}"):
        cameras(path, frame="all")
    assert len(cameras(path, frame=0)) == 1, "the other frame is sound"


@pytest.mark.parametrize(
    ("shared", "message"),
    [
        ({}, "has no focal length; give camera_angle_x, or fl_x"),
        ({"camera_angle_x": 40}, "camera_angle_x = 40: must be between 0 and pi, in radians"),
        ({"camera_angle_x": 0}, "camera_angle_x = 0: must be between 0 and pi, in radians"),
        ({"fl_x": 9, "w": 8}, "has no h"),
    ],
)
def test_intrinsics_that_do_not_make_a_camera_are_refused(tmp_path, shared, message):
    with pytest.raises(UsageError, match=re.escape(f"frame 0: {message}")):
        cameras(write(tmp_path / "t.json", **shared))


def test_distortion_of_zero_is_none(tmp_path):
    zeros = dict.fromkeys(("k1", "k2", "k3", "k4", "p1", "p2"), 0.0)
    path = write(tmp_path / "t.json", camera_model="OPENCV", is_fisheye=False, **LENS, **zeros)
    assert len(cameras(path)) == 1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"", "is not JSON"),
        (b"\xff\xfe\x00", "is not JSON"),
        (b"{", "is not JSON"),
        (b"[" * 100_000, "is not JSON"),
        (b"[]", "has no list of 'frames'"),
        (b"3", "has no list of 'frames'"),
        (b'{"frames": {}}', "has no list of 'frames'"),
        (b'{"frames": [1]}', "has no list of 'frames'"),
        (b'{"frames": []}', "its list of 'frames' is empty"),
        (b'{"fl_x": 9, "w": 8, "h": 6, "frames": [{}]}', "frame 0: transform_matrix must be"),
    ],
)
def test_a_file_that_holds_no_cameras_is_refused(tmp_path, text, message):
    path = tmp_path / "t.json"
    path.write_bytes(text)
    with pytest.raises(UsageError, match=re.escape(message)) as error:
        cameras(path)
    assert "\n" not in str(error.value)


def test_a_file_that_there_is_not_is_named(tmp_path):
    with pytest.raises(UsageError, match=r"gone\.json: no such file \(camera\.transforms\)"):
        cameras(tmp_path / "gone.json")
    with pytest.raises(UsageError, match="cannot be read: "):
        cameras(tmp_path)


# -- pictures -------------------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A ball at (4, 4, 4), and a job with three cameras around it in a folder of its own."""
    monkeypatch.chdir(tmp_path)
    write_ball(tmp_path / "ball.npz")
    (tmp_path / "jobs").mkdir()
    frames = []
    for angle in (0, 120, 240):
        turn = rotation((0, 1, 0), angle)
        pose = matrix(turn, turn @ (0, 0, 12.0) + 4)
        frames.append({"file_path": f"./r_{angle}", "transform_matrix": pose})
    write(tmp_path / "jobs" / "cameras.json", *frames, fl_x=14, cx=6.5, cy=4, w=12, h=9)
    (tmp_path / "jobs" / "job.toml").write_text(
        "[density]\nfile = '../ball.npz'\n[camera]\ntransforms = 'cameras.json'\n"
    )
    return tmp_path


def test_one_frame_is_a_picture_and_all_are_a_picture_each(folder):
    ran = volcli("render", "jobs/job.toml", "-o", "one.exr", "--set", "camera.frame=1")
    assert ran.code == 0, ran.err
    assert "camera chosen" not in ran.err
    ran = volcli("render", "jobs/job.toml", "-o", "out.png", "--set", "camera.frame=all",
                 "--maps", "opacity", "--json")  # fmt: skip
    assert ran.code == 0, ran.err
    printed = [json.loads(line) for line in ran.out.splitlines()]
    assert [p["image"] for p in printed] == ["out.0000.png", "out.0001.png", "out.0002.png"]
    assert [p["maps"]["opacity"]["file"] for p in printed] == [
        f"out.000{n}.opacity.png" for n in range(3)
    ]
    assert [p["seconds"]["load"] > 0 for p in printed] == [True, False, False], "read once"
    assert {p.name for p in folder.glob("*.*") if p.suffix != ".npz"} == {
        "one.exr",
        *(f"out.000{n}.png" for n in range(3)),
        *(f"out.000{n}.opacity.png" for n in range(3)),
    }


def test_all_frames_read_the_volume_once(folder, monkeypatch):
    from volcli.grids import dense

    read = []
    load = dense._load
    monkeypatch.setattr(dense, "_load", lambda path, name: read.append(name) or load(path, name))
    assert volcli("render", "jobs/job.toml", "-o", "a.exr", "--set", "camera.frame=all").code == 0
    assert read == ["density"]


def test_a_frame_is_the_picture_of_the_camera_that_its_matrix_is(folder):
    """The second camera, by eye, target and field of view; its axis half a pixel off the middle."""
    assert volcli("render", "jobs/job.toml", "-o", "a.exr", "--set", "camera.frame=1").code == 0
    eye = rotation((0, 1, 0), 120) @ (0, 0, 12.0) + 4
    (folder / "same.toml").write_text(
        "[density]\nfile = 'ball.npz'\n[camera]\nresolution = [12, 9]\nfocal = [14, 14]\n"
        f"principal = [6.5, 4]\neye = {eye.tolist()}\ntarget = [4, 4, 4]\n"
    )
    assert volcli("render", "same.toml", "-o", "b.exr").code == 0
    one, other = read_exr("a.exr")[0], read_exr("b.exr")[0]
    assert one["A"].max() > 0.5
    for name in one:
        np.testing.assert_allclose(one[name], other[name], rtol=1e-6, atol=1e-6)


def test_the_header_makes_the_identical_picture_without_the_file(folder):
    settings = ("--set", "camera.frame=2", "--set", "camera.samples=3")
    assert volcli("render", "jobs/job.toml", "-o", "a.exr", *settings).code == 0
    channels, attributes = read_exr("a.exr")
    (folder / "again.toml").write_text(str(attributes["volcli:job"]))
    (folder / "jobs" / "cameras.json").unlink()
    assert "transforms" not in tomllib.loads(str(attributes["volcli:job"]))["camera"]
    assert volcli("render", "again.toml", "-o", "b.exr").code == 0
    again, _ = read_exr("b.exr")
    assert {n: c.tobytes() for n, c in channels.items()} == {
        n: c.tobytes() for n, c in again.items()
    }


def test_an_output_that_cannot_be_written_fails_before_any_frame_is_rendered(folder):
    (folder / "a.0002.exr").mkdir()
    ran = volcli("render", "jobs/job.toml", "-o", "a.exr", "--set", "camera.frame=all")
    assert ran.code == 4
    assert "a.0002.exr" in ran.err
    assert not (folder / "a.0000.exr").exists()


def test_an_eye_of_the_command_line_replaces_the_cameras_of_a_job(folder):
    job = load_job(folder / "jobs" / "job.toml", [("camera.eye", (1.0, 2.0, 3.0))])
    assert job.camera.transforms is None
    again = load_job(folder / "jobs" / "job.toml", [], ["camera.frame=1"])
    assert again.camera.transforms == folder / "jobs" / "cameras.json"


def test_several_pictures_are_not_one(folder):
    job = load_job(folder / "jobs" / "job.toml", [], ["camera.frame=all"])
    with pytest.raises(UsageError, match="3 pictures where one is wanted"):
        prepare(job, writes=False)
