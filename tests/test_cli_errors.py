"""What goes wrong ends in one line that says what, where and what to do, and in its exit code."""

import os
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from commandline import SAMPLES, VOLUMES, volcli, write_ball, write_grid
from hypothesis import given, settings
from hypothesis import strategies as st

from volcli.images import read_exr

SMALL = ("--size", "8x6")
LEVEL_SET = {"class": ("string", b"level set")}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The user stands in a folder with volumes good and bad."""
    monkeypatch.chdir(tmp_path)
    write_ball(tmp_path / "ball.npz")
    write_grid(tmp_path / "fog.vdb")
    write_grid(tmp_path / "set.vdb", name="", metadata=LEVEL_SET)
    write_grid(tmp_path / "vectors.vdb", name="v", value_type="vec3s", background=(0, 0, 0))
    write_grid(tmp_path / "empty_grid.vdb", leaves={})
    whole = (tmp_path / "fog.vdb").read_bytes()
    (tmp_path / "cut.vdb").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "picture.vdb").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(100))
    (tmp_path / "text.vdb").write_text("hello\n")
    (tmp_path / "nothing.vdb").touch()
    (tmp_path / "notes.txt").write_text("hello\n")
    (tmp_path / "nano.nvdb").write_bytes(b"NanoVDB1" + bytes(100))
    (tmp_path / "broken.png").write_bytes(b"GIF")
    (tmp_path / "subfolder").mkdir()
    values = np.ones((8, 8, 8), np.float32)
    values[1, 2, 3] = np.nan
    np.save(tmp_path / "nan.npy", values)
    (tmp_path / "old.exr").write_bytes(b"kept")
    for name, text in JOBS.items():
        (tmp_path / name).write_text(text)
    return tmp_path


JOBS = {
    "job.toml": "[density]\nfile = 'ball.npz'\n",
    "no_file.toml": "[density]\ngrid = 'density'\n",
    "not.toml": "hello world",
    "key.toml": "[density]\nfile = 'ball.npz'\nsclae = 2\n",
    "part.toml": "[densty]\nfile = 'ball.npz'\n",
    "moved.toml": "[density]\nfile = 'ball.npz'\nfov = 2\n",
    "type.toml": "[density]\nfile = 'ball.npz'\nscale = 'x'\n",
    "table.toml": "density = 'ball.npz'\n",
    "number.toml": "[density]\nfile = 3\n",
    "pair.toml": "[density]\nfile = 'ball.npz'\n[camera]\neye = [1, 2]\n",
    "half.toml": "[density]\nfile = 'ball.npz'\n[camera]\nresolution = [1.5, 3]\n",
    "both.toml": "[density]\nfile = 'ball.npz'\n[color]\nconstant = [1, 1, 1]\ngrid = 'Cd'\n",
    "gone.toml": "[density]\nfile = 'gone.vdb'\n",
}

# what is wrong: (arguments after `render`, exit code, parts of the message)
WRONG = {
    # the volume
    "missing file": ("gone.vdb -o a.exr", 3, "gone.vdb: no such file"),
    "misspelt file": ("bal.npz -o a.exr", 3, "did you mean ball.npz?"),
    "a folder": ("subfolder -o a.exr", 3, "is a folder; give a volume file"),
    "a picture named .vdb": ("picture.vdb -o a.exr", 3, "picture.vdb: .*not an OpenVDB file"),
    "text named .vdb": ("text.vdb -o a.exr", 3, "text.vdb: .*not an OpenVDB file"),
    "empty file": ("nothing.vdb -o a.exr", 3, "nothing.vdb: the file is empty"),
    "no volume": ("notes.txt -o a.exr", 3, "notes.txt: is not a volume; volcli reads .vdb"),
    "cut file": ("cut.vdb -o a.exr", 3, "cut.vdb: at byte"),
    "NanoVDB": ("nano.nvdb -o a.exr", 3, "NanoVDB.*nanovdb_convert"),
    "NaN": ("nan.npy -o a.exr", 3, r"1 values.*\(1, 2, 3\).*density.nonfinite=zero"),
    # the grid
    "unknown grid": (
        "ball.npz -o a.exr --grid densty",
        3,
        "it has: density.*mean 'density'",
    ),
    "level set": (
        "set.vdb -o a.exr",
        3,
        r"'\[0\]' is a level set.*not a fog volume; take it .*density.level_set=fog",
    ),
    "vectors as density": ("ball.npz -o a.exr --grid Cd", 3, "a scalar; choose another .*density"),
    "only vectors": ("vectors.vdb -o a.exr", 3, "'v' is vec3s, and a density is a scalar"),
    "unknown colour": ("ball.npz -o a.exr --color-grid cd", 3, "did you mean 'Cd'"),
    "scalar as colour": ("ball.npz -o a.exr --color-grid density", 3, "color.grid is vec3; .*Cd"),
    "no colour": ("fog.vdb -o a.exr --color-grid density", 3, "give one colour with --color"),
    # numbers
    "step 0": ("ball.npz -o a.exr --step 0", 2, "^--step 0: must be above 0$"),
    "step below 0": ("ball.npz -o a.exr --step -1", 2, "^--step -1: must be above 0$"),
    "step NaN": ("ball.npz -o a.exr --step nan", 2, "^--step nan: must be finite$"),
    "step infinite": ("ball.npz -o a.exr --step inf", 2, "^--step inf: must be finite$"),
    "step a word": ("ball.npz -o a.exr --step x", 2, "^--step: must be a valid number"),
    "scale 0": ("ball.npz -o a.exr --density-scale 0", 2, "density.scale is 0 and nothing is"),
    "scale below 0": (
        "ball.npz -o a.exr --density-scale -1",
        2,
        "^--density-scale -1: must be at least 0$",
    ),
    "scale NaN": (
        "ball.npz -o a.exr --density-scale nan",
        2,
        "-scale nan: must be finite",
    ),
    "size 0": ("ball.npz -o a.exr --size 0x10", 2, "--size 0x10: give width and height"),
    "size below 0": ("ball.npz -o a.exr --size -3x10", 2, "--size -3x10: give width and height"),
    "size of one": ("ball.npz -o a.exr --size 10", 2, "--size 10: give width and height.*1280x720"),
    "size beyond all": ("ball.npz -o a.exr --size 70000x1", 2, "--size 70000x1: must be at most"),
    "fov 180": ("ball.npz -o a.exr --fov 180", 2, "--fov 180: must be below 180"),
    "fov 0": ("ball.npz -o a.exr --fov 0", 2, "--fov 0: must be above 0"),
    "ortho 0": ("ball.npz -o a.exr --ortho 0", 2, "--ortho 0: must be above 0"),
    "two lenses": ("ball.npz -o a.exr --ortho 2 --fov 30", 2, "exclude each other"),
    "eye of two": ("ball.npz -o a.exr --eye 1,2", 2, "--eye 1,2: give 3 finite numbers"),
    "eye NaN": ("ball.npz -o a.exr --eye nan,0,0", 2, "--eye nan,0,0: give 3 finite numbers"),
    "target words": ("ball.npz -o a.exr --target a,b,c", 2, "--target a,b,c: give 3 finite"),
    "no up": ("ball.npz -o a.exr --up 0,0,0", 2, "--up 0,0,0: must not be 0,0,0"),
    "eye is target": ("ball.npz -o a.exr --eye 1,1,1 --target 1,1,1", 2, "same point"),
    "up along view": ("ball.npz -o a.exr --eye 4,9,4 --target 4,4,4", 2, "up .*choose another"),
    "colour below 0": ("ball.npz -o a.exr --color -1,0,0", 2, "--color -1,0,0: must be at least 0"),
    "colour NaN": ("ball.npz -o a.exr --color nan,0,0", 2, "--color nan,0,0: give 3 finite"),
    "two colours": ("ball.npz -o a.exr --color 1,1,1 --color-grid Cd", 2, "exclude each other"),
    "threads 0": ("ball.npz -o a.exr --threads 0", 2, "--threads: must be"),
    "bits 7": ("ball.npz -o a.png --bits 7", 2, "--bits 7: must be 8 or 16"),
    # words
    "no option": ("ball.npz -o a.exr --stpe 1", 2, "No such option: --stpe.*see volcli render"),
    "no value": ("ball.npz -o a.exr --step", 2, "--step.*requires an argument"),
    "no source": ("", 2, "Missing argument"),
    "interpolation": ("ball.npz -o a.exr --interpolation cubic", 2, "'linear' or 'nearest'"),
    "reader": ("ball.npz -o a.exr --reader other", 2, "'volcli' or 'openvdb'"),
    "map": ("ball.npz -o a.exr --maps opacity,foo", 2, "--maps opacity,foo: .*'optical_depth'"),
    "background of two": ("ball.npz -o a.exr --background 1,2", 2, "transparent, three numbers"),
    "background NaN": ("ball.npz -o a.exr --background nan,0,0", 2, "must be finite"),
    "no background": ("ball.npz -o a.exr --background gone.png", 2, "gone.png: no such file"),
    "bad background": (
        "ball.npz -o a.exr --background broken.png",
        2,
        "broken.png: not a read",
    ),
    "set of nothing": ("ball.npz -o a.exr --set foo", 2, "--set foo: write PART.FIELD=VALUE"),
    "set of a part": ("ball.npz -o a.exr --set density=3", 2, "write PART.FIELD=VALUE"),
    "set of unknown": ("ball.npz -o a.exr --set density.scal=3", 2, "did you mean 'density.scale'"),
    "set of nowhere": ("ball.npz -o a.exr --set foo.bar=3", 2, "unknown key 'foo'; a job has"),
    "set of a word": ("ball.npz -o a.exr --set density.scale=x", 2, "must be a number"),
    "set of a list": ("ball.npz -o a.exr --set output.maps=depth", 2, r'such as \["depth"\]'),
    "set of a clash": ("ball.npz -o a.exr --step 1 --set quadrature.rule=exact", 2, "is for"),
    # the output
    "no output": ("ball.npz", 2, "nothing to write: give -o"),
    "no folder": ("ball.npz -o none/a.exr", 4, "folder 'none' does not exist; create it"),
    "a folder as output": ("ball.npz -o subfolder", 4, "subfolder: is a folder; name a file"),
    "a file as folder": ("ball.npz -o notes.txt/a.exr", 4, "'notes.txt' is not a folder"),
    "extension": ("ball.npz -o a.jpg", 2, "unknown image format '.jpg'; use .exr or .png"),
    "existing": ("ball.npz -o old.exr --no-overwrite", 4, "old.exr: already exists"),
    # the job
    "missing job": ("gone_job.toml -o a.exr", 2, "gone_job.toml: no such job file"),
    "no TOML": ("not.toml -o a.exr", 2, "not.toml: is not TOML: .*line 1"),
    "no volume in job": ("no_file.toml -o a.exr", 2, "no_file.toml: no density.file"),
    "missing volume in job": ("gone.toml -o a.exr", 3, "gone.vdb: no such file"),
    "unknown key": ("key.toml -o a.exr", 2, "key.toml: unknown key.*mean 'density.scale'"),
    "unknown part": ("part.toml -o a.exr", 2, "part.toml: unknown key.*mean 'density'"),
    "key of another part": ("moved.toml -o a.exr", 2, "did you mean 'camera.fov'"),
    "type of a number": ("type.toml -o a.exr", 2, "density.scale: must be a number, not 'x'"),
    "type of a table": ("table.toml -o a.exr", 2, r"must be a table, \[density\]"),
    "type of a path": ("number.toml -o a.exr", 2, "density.file: must be a path in quotes"),
    "length of a list": ("pair.toml -o a.exr", 2, "camera.eye: must be a list of 3 numbers"),
    "half a pixel": ("half.toml -o a.exr", 2, "camera.resolution: must be a whole number"),
    "two in a job": ("both.toml -o a.exr", 2, "both.toml: color.constant and color.grid exclude"),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_mistake_is_answered_in_one_line_with_its_exit_code_and_nothing_written(folder, case):
    arguments, code, message = WRONG[case]
    before = {p: p.stat().st_mtime_ns for p in folder.rglob("*")}
    ran = volcli("render", *arguments.split())
    assert ran.out == ""
    assert ran.code == code, ran.err
    assert ran.err.startswith("volcli: ")
    assert ran.err.count("\n") == 1
    assert ran.err.endswith("\n")
    assert re.search(message, ran.err.removeprefix("volcli: ").rstrip()), ran.err
    assert {p: p.stat().st_mtime_ns for p in folder.rglob("*")} == before


def test_a_read_only_folder_is_an_output_error(folder, monkeypatch):
    (folder / "subfolder").chmod(0o555)
    if os.geteuid() == 0:  # nothing is read-only to root: say what others would be told
        monkeypatch.setattr(
            "volcli.images.paths.os.access",
            lambda path, mode: not (mode & os.W_OK and Path(path).name == "subfolder"),
        )
    ran = volcli("render", "ball.npz", "-o", "subfolder/a.exr")
    assert ran.code == 4
    assert "not writable" in ran.err


@pytest.mark.parametrize(
    ("file", "message"), [("points_only.vdb", "points grid"), ("x_frustum.vdb", "frustum")]
)
def test_a_grid_that_cannot_be_rendered_is_refused_by_its_kind(file, message):
    path = next(iter(VOLUMES.glob(f"*/{file}")), None)
    if path is None:
        pytest.skip(f"no {file} beside the checkout")
    ran = volcli("render", path, "-o", "never.exr")
    assert ran.code == 3
    assert message in ran.err
    assert ran.err.count("\n") == 1


def test_nan_is_rendered_as_nothing_where_the_job_accepts_it(folder):
    ran = volcli("render", "nan.npy", "-o", "a.exr", *SMALL, "--set", "density.nonfinite=zero")
    assert ran.code == 0
    assert "1 values are NaN or Inf, taken as 0" in ran.err


def test_an_empty_volume_renders_its_background_and_says_so(folder):
    ran = volcli("render", "empty_grid.vdb", "-o", "a.exr", *SMALL, "--background", "1,0.5,0")
    assert ran.code == 0
    assert "is empty; it absorbs nothing" in ran.err
    channels, _ = read_exr("a.exr")
    assert [float(channels[c].min()) for c in "RGBA"] == [1, 0.5, 0, 1]
    assert float(channels["transmittance.Y"].min()) == 1


def test_a_result_that_is_not_finite_is_an_error_of_its_own(folder):
    ran = volcli("render", "ball.npz", "-o", "a.exr", *SMALL, "--density-scale", "1e300")
    assert ran.code == 5
    assert "NaN or Inf" in ran.err
    assert ran.err.count("\n") == 1
    assert not (folder / "a.exr").exists()
    command = shlex.split(ran.err.partition("its ray: ")[2])
    assert command[:2] == ["volcli", "probe"]
    probed = volcli(*command[1:])
    assert probed.code == 0, probed.err
    assert f"pixel {command[4]}" in probed.out
    assert re.search(r"optical depth (inf|\d\.?\d*e\+(2|3)\d\d)", probed.out), probed.out


def test_light_that_is_too_bright_for_a_picture_is_told_by_its_pixel(folder):
    ran = volcli(
        "render", "ball.npz", "-o", "a.exr", *SMALL, "--background", "3e38,0,0",
        "--set", "color.constant=[3e38,0,0]", "--density-scale", "1",
        "--set", "emission.grid=density", "--set", "emission.constant=[3e38,0,0]",
    )  # fmt: skip
    assert ran.code == 5, ran.err
    assert "NaN or Inf, the first at x=" in ran.err
    assert not (folder / "a.exr").exists()


@pytest.mark.parametrize("path", sorted(VOLUMES.glob("malformed/*.vdb")), ids=lambda p: p.name)
def test_a_damaged_file_is_refused_or_read_as_the_empty_tree_that_it_holds(path, tmp_path):
    ran = volcli("render", path, "-o", tmp_path / "a.exr", *SMALL, "--quiet")
    assert ran.code == (3 if "truncated" in path.name else 0), ran.err
    assert "Traceback" not in ran.err
    if ran.code:
        assert ran.err.count("\n") == 1


def test_a_defect_of_volcli_itself_shows_where_it_is_and_asks_for_a_report(monkeypatch, tmp_path):
    def fails(*_, **__):
        raise IndexError("index 8 is out of bounds\nfor axis 0")

    monkeypatch.setattr("volcli.run.prepare_each", fails)
    ran = volcli("render", SAMPLES / "rotated.vdb", "-o", tmp_path / "a.exr")
    assert ran.code == 1
    assert "Traceback" in ran.err
    assert ran.err.endswith(
        "volcli: unexpected IndexError: index 8 is out of bounds for axis 0; please report it\n"
    )


def test_memory_that_is_not_there_is_said_in_one_line(monkeypatch, tmp_path):
    def fails(*_, **__):
        raise MemoryError("Unable to allocate 8 TiB")

    monkeypatch.setattr("volcli.run.prepare_each", fails)
    ran = volcli("render", SAMPLES / "rotated.vdb", "-o", tmp_path / "a.exr")
    assert ran.code == 1
    assert "out of memory (Unable to allocate 8 TiB); a smaller picture" in ran.err


@settings(max_examples=150)
@given(st.data())
def test_a_damaged_array_file_is_refused_or_read_but_never_a_defect(arrays, data):
    suffix = data.draw(st.sampled_from([".npy", ".npz"]))
    whole = bytearray((arrays / f"whole{suffix}").read_bytes())
    for _ in range(data.draw(st.integers(0, 4))):
        whole[data.draw(st.integers(0, len(whole) - 1))] = data.draw(st.integers(0, 255))
    path = arrays / f"damaged{suffix}"
    path.write_bytes(whole[: data.draw(st.integers(0, len(whole)))])
    ran = volcli("info", path, "--stats")
    assert ran.code in (0, 3), ran.err


@pytest.fixture(scope="module")
def arrays(tmp_path_factory):
    folder = tmp_path_factory.mktemp("arrays")
    values = np.random.default_rng(1).random((5, 6, 7), np.float32)
    np.save(folder / "whole.npy", values)
    np.savez_compressed(folder / "whole.npz", density=values, voxel_size=0.5)
    return folder
