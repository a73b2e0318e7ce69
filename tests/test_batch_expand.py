"""A batch file to its jobs: what a user may write, what it means, and what is refused."""

import numpy as np
import pytest
from batches import write_batch
from commandline import ROOT, SAMPLES, write_ball
from hypothesis import given
from hypothesis import strategies as st

from volcli.batch.expand import read_batch
from volcli.batch.frames import as_ranges, frames_on_disk, gaps, matches, parse_frames, with_frame
from volcli.camera import make_camera
from volcli.errors import UsageError
from volcli.scene import make_scene, open_volumes, read_grids, scene_box
from volcli.schema import Job


@pytest.fixture
def sims(tmp_path):
    """Two sequences with gaps, and a ball by itself."""
    write_ball(tmp_path / "ball.npz")
    for shot in ("a", "b"):
        (tmp_path / shot).mkdir()
        for frame in (1, 2, 3, 5, 10):
            write_ball(tmp_path / shot / f"smoke.{frame:04d}.npz")
    return tmp_path


def expand(folder, text, *settings):
    return read_batch(write_batch(folder, text), settings)


def outputs(folder, text, *settings):
    found = expand(folder, text, *settings)
    return [str(item.output.relative_to(folder)) for item in found.items]


# -- frames ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "frames"),
    [
        ("7", [7]),
        ("1-4", [1, 2, 3, 4]),
        ("1-10x4", [1, 5, 9]),
        ("1-3,10,2", [1, 2, 3, 10]),
        ("-2-1", [-2, -1, 0, 1]),
        ("-3--1", [-3, -2, -1]),
        (" 1 , 5-5 ", [1, 5]),
    ],
)
def test_ranges_of_frames_are_read_as_they_are_written(text, frames):
    assert parse_frames(text) == frames


@pytest.mark.parametrize("text", ["", "a", "1-", "1-x2", "1..5", "5-1", "1-5x0", "1-99999999"])
def test_what_is_no_range_is_refused_by_name(text):
    with pytest.raises(UsageError, match=r"--frames"):
        parse_frames(text, "--frames")


@given(st.sets(st.integers(0, 60)))
def test_frames_are_written_as_ranges_that_read_as_the_same_frames(frames):
    text = as_ranges(frames)
    assert not frames or parse_frames(text.replace(" ", "")) == sorted(frames)


@pytest.mark.parametrize("pattern", ["s.####.vdb", "s.%04d.vdb", "s.$F4.vdb"])
def test_all_ways_to_write_a_frames_place_mean_the_same(tmp_path, pattern):
    assert with_frame(tmp_path / pattern, 7) == tmp_path / "s.0007.vdb"
    assert with_frame(tmp_path / pattern, 12345) == tmp_path / "s.12345.vdb"
    for name in ("s.0007.vdb", "s.0012.vdb", "s.9.vdb", "s.x.vdb", "t.0003.vdb"):
        (tmp_path / name).touch()
    assert frames_on_disk(tmp_path / pattern) == [7, 12], "unpadded ones are another sequence"


def test_frames_seem_to_be_missing_by_the_usual_step():
    assert gaps([1, 2, 4, 5]) == [3]
    assert gaps([10, 20, 40]) == [30]
    assert gaps([1, 3, 5]) == gaps([4]) == gaps([]) == []


def test_files_come_in_natural_order_and_brackets_of_a_name_that_exists_are_its_own(tmp_path):
    for name in ("a10.vdb", "a2.vdb", "[x].vdb", "x.vdb"):
        (tmp_path / name).touch()
    assert [p.name for p in matches(tmp_path / "a*.vdb")] == ["a2.vdb", "a10.vdb"]
    found = expand(
        tmp_path, 'defaults.density.file = "[x].vdb"\ndefaults.output.image = "{stem}.png"'
    )
    assert [i.output.name for i in found.items] == ["[x].png"]


def test_a_sequence_without_a_range_is_what_is_there_and_its_gaps_are_told(sims):
    text = '[defaults]\ndensity.file = "a/smoke.####.npz"\noutput.image = "out/####.exr"'
    found = expand(sims, text)
    assert [i.output.name for i in found.items] == [f"{n:04d}.exr" for n in (1, 2, 3, 5, 10)]
    assert any("frames 4, 6-9 are missing" in note for note in found.notes)
    assert all(i.missing is None for i in found.items)


def test_a_range_asks_for_frames_that_are_missing_too(sims):
    text = (
        'frames = "2-6x2"\n[defaults]\ndensity.file = "a/smoke.$F4.npz"\n'
        'output.image = "out/x_{frame:03d}.exr"'
    )
    found = expand(sims, text)
    assert [i.output.name for i in found.items] == ["x_002.exr", "x_004.exr", "x_006.exr"]
    assert [i.missing and i.missing.name for i in found.items] == [
        None,
        "smoke.0004.npz",
        "smoke.0006.npz",
    ]


def test_a_pattern_of_folders_with_frames_is_a_sequence_each(sims):
    text = '[defaults]\ndensity.file = "*/smoke.####.npz"\noutput.image = "o/{folder}.####.png"'
    names = outputs(sims, text)
    assert len(names) == 10
    assert names[0] == "o/a.0001.png"
    assert names[-1] == "o/b.0010.png"


# -- jobs, sweeps, names --------------------------------------------------------------------------


def test_a_job_wins_over_the_defaults_a_sweep_over_both_and_a_setting_over_all(sims):
    text = """
    [defaults]
    density = { file = "ball.npz", scale = 1.0 }
    color.constant = [1, 0, 0]
    [[job]]
    density.scale = 2.0
    color.grid = "Cd"
    output.image = "one.png"
    [[job]]
    output.image = "two_{density.scale}.png"
    sweep = { "density.scale" = [3.0, 4.5] }
    """
    jobs = [item.job for item in expand(sims, text).items]
    assert [job.density.scale for job in jobs] == [2.0, 3.0, 4.5]
    assert [job.color.grid for job in jobs] == ["Cd", None, None], "what it excludes is dropped"
    assert [job.output.image.name for job in jobs] == ["one.png", "two_3.png", "two_4.5.png"]
    one = 'defaults.density.file = "ball.npz"\ndefaults.output.image = "x.png"'
    assert expand(sims, one, "density.scale=9").items[0].job.density.scale == 9


def test_a_sweep_is_every_combination_and_keys_need_no_quotes(sims):
    text = """
    [defaults]
    density.file = "ball.npz"
    output.image = "{density.scale}_{quadrature.step}_{density.file}.png"
    [sweep]
    density.scale = [1.0, 2.0]
    quadrature.step = [0.25, 1.0]
    """
    found = expand(sims, text)
    assert [i.output.name for i in found.items] == [
        "1_0.25_ball.png",
        "1_1_ball.png",
        "2_0.25_ball.png",
        "2_1_ball.png",
    ]
    assert {i.job.quadrature.rule for i in found.items} == {"midpoint"}, "the rule with steps"


def test_a_sweep_goes_over_files_relative_to_the_batch_file(sims, monkeypatch):
    monkeypatch.chdir("/")
    text = """
    defaults.output.image = "{stem}.png"
    [sweep]
    "density.file" = ["ball.npz", "a/smoke.0001.npz"]
    """
    found = expand(sims, text)
    assert [i.missing for i in found.items] == [None, None]
    assert [i.output for i in found.items] == [sims / "ball.png", sims / "smoke.0001.png"]


def test_values_in_names_have_no_slashes_and_may_be_formatted(sims):
    text = """
    defaults.density = { file = "ball.npz", grid = "a/b" }
    defaults.output.image = "{density.grid}_{density.scale:05.1f}_{camera.up}.png"
    """
    assert outputs(sims, text) == ["a-b_001.0_0_1_0.png"]


BASE = 'defaults.density.file = "ball.npz"\ndefaults.output.image = "{stem}.png"\n'

# what is wrong: (the batch file, parts of the message)
WRONG = {
    "not TOML": ("hello world", "b.toml: is not TOML"),
    "unknown key": ("frmes = '1'\n" + BASE, "unknown key 'frmes'; did you mean 'frames'"),
    "unknown key of a job": (BASE + "[[job]]\ncolr.grid = 'x'", "job 1: unknown key 'colr'"),
    "unknown field": (BASE + "[[job]]\ndensity.scle = 2", "job 1: .*'density.scle'; did you mean"),
    "wrong field": (BASE + "defaults.density.scale = -1", "density.scale: must be at least 0"),
    "no table": (BASE + "[[job]]\ndensity = 3", "job 1: density: must be a table"),
    "no volume": ("defaults.output.image = 'a.png'", "no density.file"),
    "no output": ("defaults.density.file = 'ball.npz'", "no output.image; name the pictures"),
    "no such files": (
        "defaults = {density.file='*.vdb', output.image='a.png'}",
        "no file is named",
    ),
    "no frames": ("defaults = {density.file='s.##.vdb', output.image='a.png'}", "are no frames"),
    "a bad range": ("frames = '1-'\n" + BASE, "frames: '1-' is no range"),
    "frames as numbers": ("frames = [1, 2]\n" + BASE, "frames: must be a valid string"),
    "sweep of one value": (BASE + "[sweep]\ndensity.scale = 2", "density.scale: write PART.FIELD"),
    "empty sweep": (BASE + "[sweep]\ndensity.scale = []", "density.scale: write PART.FIELD"),
    "sweep of a wrong value": (
        BASE + "[sweep]\ndensity.scale = [1, -2]",
        "sweep: density.scale = -2: must be at least 0",
    ),
    "equal outputs": (
        BASE + "[sweep]\ndensity.scale = [1, 2]",
        "two jobs write it .1, of ball.npz, and 2.*tell them apart",
    ),
    "equal maps": (
        BASE + "defaults.output.maps = ['depth']\n[[job]]\n[[job]]\noutput.image='ball.depth.png'",
        "ball.depth.png: two jobs write it",
    ),
    "unknown name": (
        "defaults = {density.file = 'ball.npz', output.image = '{fame}.png'}",
        "{fame} is no field of a job; did you mean {frame}",
    ),
    "name without a value": (
        "defaults = {density.file = 'ball.npz', output.image = '{frame}.png'}",
        "{frame} has no value",
    ),
    "no image": (
        "defaults = {density.file='ball.npz', output.image='a.gif'}",
        "a.gif: must end in",
    ),
    "open brace": ("defaults = {density.file = 'ball.npz', output.image = '{.png'}", "braces"),
    "orbit without frames": (BASE + "[orbit]\naxis = 'z'", "orbit.frames is missing"),
    "orbit of 0 frames": (BASE + "[orbit]\nframes = 0", "orbit.frames: .*greater than or equal"),
    "orbit about nothing": (BASE + "orbit = {frames = 2, axis = [0, 0, 0]}", "must not be 0,0,0"),
    "orbit about q": (BASE + "orbit = {frames = 2, axis = 'q'}", "orbit.axis"),
    "two numbers of frames": (
        "frames = '1-3'\n" + BASE + "orbit = {frames = 2}",
        "orbit.frames: the frames are those of the sequence",
    ),
    "negative retries": ("retries = -1\n" + BASE, "retries: .*greater than or equal to 0"),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_what_is_wrong_with_a_batch_file_is_told_in_a_line_before_anything_runs(sims, wrong):
    text, message = WRONG[wrong]
    with pytest.raises(UsageError, match=message) as told:
        expand(sims, text)
    assert "\n" not in str(told.value)


def test_a_file_that_is_not_there_is_told_and_a_link_to_an_output_is_that_output(sims):
    with pytest.raises(UsageError, match="no such job file"):
        read_batch(sims / "gone.toml")
    (sims / "other").symlink_to(sims)
    text = BASE + "[[job]]\n[[job]]\noutput.image = 'other/{stem}.png'"
    with pytest.raises(UsageError, match="two jobs write it"):
        expand(sims, text)


# -- cameras --------------------------------------------------------------------------------------


def test_a_turntable_goes_once_around_and_keeps_its_distance(sims):
    text = """
    defaults.density.file = "ball.npz"
    defaults.output.image = "{frame}.png"
    defaults.camera = { eye = [4, 6, 10], target = [4, 4, 4] }
    orbit = { frames = 4 }
    """
    found = expand(sims, text)
    eyes = np.array([item.job.camera.eye for item in found.items])
    np.testing.assert_allclose(eyes, [[4, 6, 10], [10, 6, 4], [4, 6, -2], [-2, 6, 4]], atol=1e-12)
    assert [item.output.name for item in found.items] == ["1.png", "2.png", "3.png", "4.png"]
    assert tuple(eyes[0]) == (4, 6, 10), "the first picture is that of the job, to the bit"


def test_up_turns_with_the_camera_so_that_any_axis_will_do(sims):
    text = """
    defaults.density.file = "ball.npz"
    defaults.output.image = "{frame}.png"
    defaults.camera = { eye = [0, 0, 5], target = [0, 0, 0] }
    orbit = { frames = 2, axis = [2, 0, 0], degrees = 180 }
    """
    cameras = [item.job.camera for item in expand(sims, text).items]
    np.testing.assert_allclose(cameras[1].eye, [0, -5, 0], atol=1e-12)
    np.testing.assert_allclose(cameras[1].up, [0, 0, 1], atol=1e-12)


@pytest.mark.parametrize("sample", ["explosion", "rotated"])
@pytest.mark.parametrize("lens", ["", "camera.type = 'orthographic'"])
def test_a_turntable_that_frames_its_volume_shows_all_of_it_from_every_side(tmp_path, sample, lens):
    text = f"""
    orbit = {{ frames = 12 }}
    [defaults]
    density.file = "{SAMPLES / sample}.vdb"
    output.image = "{{frame}}.png"
    {lens}
    """
    jobs = [item.job for item in expand(tmp_path, text).items]
    box = box_of(jobs[0])
    corners = np.array([[box[i, 0], box[j, 1], box[k, 2]] for i, j, k in np.ndindex(2, 2, 2)])
    fullest = 0.0
    for job in jobs:
        camera = make_camera(job.camera, box)
        away = corners - camera.eye
        along = away @ camera.forward if job.camera.type == "perspective" else 1.0
        x = (away @ camera.right) / along / camera.pixel[0] / (camera.resolution[0] / 2)
        y = (away @ camera.upward) / along / camera.pixel[1] / (camera.resolution[1] / 2)
        assert np.all(np.abs([x, y]) <= 1.0)
        fullest = max(fullest, np.abs([x, y]).max())
    assert fullest > 0.9, "and no farther off than it must be"
    widths = {job.camera.width for job in jobs}
    assert len(widths) == 1, "nothing breathes"


def box_of(job: Job):
    from volcli.estimate import plan_of

    volumes = open_volumes(job)
    plan = plan_of(job, volumes)
    grids, _ = read_grids(job, plan, volumes)
    return scene_box(make_scene(job, plan, volumes, grids)[0])


def test_a_sequence_without_a_camera_has_one_for_all_frames(tmp_path):
    """A cloud that grows: framed by itself, each frame would be as large in its picture."""
    for frame, size in ((1, 8), (2, 20)):
        np.save(tmp_path / f"s.{frame}.npy", np.ones((size,) * 3, np.float32))
    text = "defaults = {density.file = 's.#.npy', output.image = '#.png'}"
    found = expand(tmp_path, text)
    first, second = (item.job.camera for item in found.items)
    assert first == second
    assert first.target == (9.5, 9.5, 9.5)
    assert any("a" in note and "camera" in note for note in found.notes)


def test_a_frame_that_cannot_be_read_does_not_keep_the_others_from_their_camera(sims):
    (sims / "a" / "smoke.0002.npz").write_bytes(b"broken")
    text = "defaults = {density.file = 'a/smoke.####.npz', output.image = '####.png'}"
    found = expand(sims, text)
    assert len({item.job.camera for item in found.items}) == 1
    assert found.items[0].job.camera.eye is not None


def test_a_turntable_over_a_sequence_goes_around_once_while_it_passes(sims):
    text = """
    defaults.density.file = "a/smoke.####.npz"
    defaults.output.image = "####.png"
    defaults.camera = { eye = [0, 0, 1], target = [0, 0, 0] }
    orbit = { axis = "y" }
    """
    eyes = [item.job.camera.eye for item in expand(sims, text).items]
    assert len(eyes) == 5
    np.testing.assert_allclose(eyes[1], [np.sin(2 * np.pi / 5), 0, np.cos(2 * np.pi / 5)])


def test_all_cameras_of_a_transforms_file_are_a_job_each(tmp_path):
    text = f"""
    [defaults]
    density.file = "{SAMPLES / "cloud.vdb"}"
    camera = {{ transforms = "{ROOT / "configs" / "transforms.json"}", frame = "all" }}
    output.image = "out/####.png"
    """
    found = expand(tmp_path, text)
    assert len(found.items) > 1
    assert [item.output.name for item in found.items[:2]] == ["0000.png", "0001.png"]
    assert len({item.job.camera.eye for item in found.items}) == len(found.items)
    assert {item.job.camera.transforms for item in found.items} == {None}
