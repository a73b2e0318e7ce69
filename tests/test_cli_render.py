"""`volcli render`: what wins over what, what it prints, and what it writes."""

import json
import os
import signal
import subprocess
import sys
import time
import tomllib
from importlib.metadata import version
from unittest import mock

import numpy as np
import pytest
from commandline import ROOT, SAMPLES, volcli, write_ball

from volcli.images import read_exr

SMALL = ("--size", "16x12")
JOB = "[density]\nfile = 'ball.npz'\n"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The user stands in a folder with a ball and nothing else."""
    monkeypatch.chdir(tmp_path)
    write_ball(tmp_path / "ball.npz")
    return tmp_path


def rendered(*arguments):
    """Channels and resolved job of a picture rendered by ``volcli render ARGUMENTS``."""
    ran = volcli("render", *arguments, "-o", "out.exr")
    assert ran.code == 0, ran.err
    channels, attributes = read_exr("out.exr")
    return channels, tomllib.loads(str(attributes["volcli:job"]))


def same(one, other):
    return one.keys() == other.keys() and all(
        one[name].tobytes() == other[name].tobytes() for name in one
    )


# -- what is printed ------------------------------------------------------------------------------


def test_json_is_one_object_of_the_keys_promised_and_nothing_else_on_stdout(folder):
    ran = volcli("render", "ball.npz", "-o", "a.exr", *SMALL, "--json", "--maps", "depth,opacity")
    assert ran.code == 0
    assert ran.out.count("\n") == 1
    printed = json.loads(ran.out, parse_constant=lambda c: pytest.fail(f"{c} is not JSON"))
    assert list(printed) == [
        "image",
        "maps",
        "size",
        "rule",
        "rays",
        "cells",
        "seconds",
        "transmittance",
        "peak_memory_bytes",
        "warnings",
    ]
    assert printed["image"] == "a.exr"
    assert {name: m["file"] for name, m in printed["maps"].items()} == {
        "depth": "a.depth.exr",
        "opacity": "a.opacity.exr",
    }
    assert printed["size"] == [16, 12]
    assert printed["rule"] == "exact"
    assert printed["rays"] == 16 * 12
    assert printed["cells"] > 0
    assert list(printed["seconds"]) == ["load", "compile", "render", "write"]
    t = printed["transmittance"]
    stored = read_exr("a.exr")[0]["transmittance.Y"]
    assert (t["min"], t["max"]) == (stored.min(), stored.max())
    assert t["mean"] == pytest.approx(stored.mean(dtype=np.float64), abs=1e-12)
    assert printed["peak_memory_bytes"] > 1e7
    assert printed["warnings"] == []


def test_warnings_are_in_the_json_and_on_stderr(folder):
    np.save("minus.npy", np.full((4, 4, 4), -1.0, np.float32))
    ran = volcli("render", "minus.npy", "-o", "a.exr", *SMALL, "--json")
    (warning,) = json.loads(ran.out)["warnings"]
    assert "64 values below 0, taken as 0" in warning
    first, second = ran.err.splitlines()
    assert first == f"volcli: {warning}"
    assert second.startswith("volcli: camera chosen: --eye")


def test_a_picture_is_reported_with_its_maps_and_the_camera_that_was_chosen(folder):
    ran = volcli("render", "ball.npz", "-o", "a.exr", *SMALL, "--maps", "opacity")
    first, second, third, fourth = ran.out.splitlines()
    assert first == "a.exr  picture 16x12"
    assert second == "a.opacity.exr  opacity"
    assert third.startswith("exact: 192 rays, ")
    assert fourth.startswith("load ")
    assert ran.err.startswith("volcli: camera chosen: --eye 3.5,3.5,")


def test_the_flags_of_a_chosen_camera_give_the_same_view(folder):
    ran = volcli("render", "ball.npz", "-o", "a.exr", *SMALL)
    flags = ran.err.removeprefix("volcli: camera chosen: ").split()
    again, _ = rendered("ball.npz", *SMALL, *flags)
    np.testing.assert_allclose(again["A"], read_exr("a.exr")[0]["A"], atol=1e-5)


def test_the_flags_of_a_chosen_panorama_give_the_same_view(folder):
    panorama = ("--set", "camera.type=panorama", *SMALL)
    ran = volcli("render", "ball.npz", "-o", "a.exr", *panorama)
    flags = ran.err.removeprefix("volcli: camera chosen: ").split()
    assert flags[-2:] == ["--set", "camera.type=panorama"]
    assert flags[1] == "3.5,3.5,3.5", "the middle of the box"
    again, _ = rendered("ball.npz", *SMALL, *flags)
    np.testing.assert_allclose(again["A"], read_exr("a.exr")[0]["A"], atol=1e-5)


def test_rays_are_counted_with_the_samples_of_a_pixel(folder):
    settings = (*SMALL, "--set", "camera.samples=5", "--json")
    printed = json.loads(volcli("render", "ball.npz", "-o", "a.exr", *settings).out)
    assert printed["rays"] == 16 * 12 * 5


def test_quiet_leaves_only_the_result(folder):
    ran = volcli("render", "ball.npz", "-o", "a.exr", *SMALL, "--quiet")
    assert ran.err == ""
    assert ran.out.startswith("a.exr")


def test_explain_without_an_output_prints_the_plan_and_renders_nothing(folder, monkeypatch):
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.setattr("volcli.run.render", lambda *_, **__: pytest.fail("rendered"))
    ran = volcli("render", "ball.npz", "--explain")
    assert ran.code == 0
    lines = ran.out.splitlines()
    assert lines[0].split() == ["term", "in", "grid", "read", "held", "a", "cell", "why"]
    assert lines[1].split()[:4] == ["optical", "depth", "yes", "density"]
    assert "closed form" in ran.out
    assert sorted(p.name for p in folder.iterdir()) == ["ball.npz"]


def test_explain_with_an_output_prints_the_plan_and_renders(folder):
    ran = volcli("render", "ball.npz", "--explain", "-o", "a.exr", *SMALL)
    assert ran.out.index("optical depth") < ran.out.index("a.exr  picture")
    assert (folder / "a.exr").exists()


def test_explain_as_json_gives_the_terms_with_the_memory_that_they_hold(folder):
    ran = volcli("render", "ball.npz", "--explain", "--json", "--color-grid", "Cd")
    plan = {term["name"]: term for term in json.loads(ran.out)["plan"]}
    assert plan["optical depth"]["bytes_held"] > 729 * 4
    assert plan["colour"]["grid"] == "Cd"
    assert not plan["background"]["wanted"]


def test_a_grid_that_no_term_needs_is_never_read(folder, monkeypatch):
    from volcli.grids import dense

    read = []
    load = dense._load
    monkeypatch.setattr(dense, "_load", lambda path, name: read.append(name) or load(path, name))
    volcli("render", "ball.npz", "-o", "a.exr", *SMALL)
    assert read == ["density"]


# -- what wins over what --------------------------------------------------------------------------

# (flag and value), (the field it sets, and its value), what a job says instead
FLAGS = [
    ("--grid density", "density.grid", "density", '"Cd"'),
    ("--density-scale 3", "density.scale", 3.0, "0.5"),
    ("--interpolation linear", "density.interpolation", "linear", '"nearest"'),
    ("--reader volcli", "density.reader", "volcli", '"openvdb"'),
    ("--color 0.1,0.2,0.3", "color.constant", [0.1, 0.2, 0.3], "[1.0, 1.0, 1.0]"),
    ("--color-grid Cd", "color.grid", "Cd", '"other"'),
    ("--eye 9,9,9", "camera.eye", [9.0, 9.0, 9.0], "[1.0, 2.0, 3.0]"),
    ("--target 4,4,5", "camera.target", [4.0, 4.0, 5.0], "[1.0, 2.0, 3.0]"),
    ("--up 0,0,1", "camera.up", [0.0, 0.0, 1.0], "[1.0, 0.0, 0.0]"),
    ("--fov 25", "camera.fov", 25.0, "70.0"),
    ("--ortho 12", "camera.type", "orthographic", '"perspective"'),
    ("--size 6x5", "camera.resolution", [6, 5], "[7, 7]"),
    ("--step 0.25", "quadrature.step", 0.25, "2.0"),
    ("--background 1,0,0", "background.color", [1.0, 0.0, 0.0], "[0.0, 0.0, 1.0]"),
    ("--maps depth", "output.maps", ["depth"], '["opacity"]'),
    ("--bits 16", "output.bits", 16, "8"),
    ("-o won.exr", "output.image", "won.exr", '"lost.exr"'),
]


def resolved(*arguments):
    """The job that ``volcli render ARGUMENTS`` makes of its arguments, as plain data."""
    with mock.patch("volcli.run.prepare_each", side_effect=KeyboardInterrupt) as prepare:
        ran = volcli("render", *arguments)
    assert prepare.call_args is not None, ran.err
    return prepare.call_args.args[0].model_dump(mode="json")


@pytest.mark.parametrize(("flag", "key", "value", "written"), FLAGS)
def test_a_flag_wins_over_the_job_and_the_job_over_the_default(folder, flag, key, value, written):
    part, name = key.split(".")
    job = {"density": {"file": "'ball.npz'"}}
    if key == "quadrature.step":
        job["quadrature"] = {"rule": "'midpoint'"}
    job.setdefault(part, {})[name] = written
    text = "\n".join(
        f"[{table}]\n" + "\n".join(f"{k} = {v}" for k, v in fields.items())
        for table, fields in job.items()
    )
    (folder / "job.toml").write_text(text)
    from_file = resolved("job.toml")[part][name]
    assert from_file == tomllib.loads(f"v = {written}")["v"]
    assert resolved("job.toml", *flag.split())[part][name] == value
    as_setting = resolved("job.toml", "--set", f"{key}={json.dumps(value)}")
    assert as_setting[part][name] == value
    assert resolved("job.toml", "--set", f"{key}=")[part][name] == resolved("ball.npz")[part][name]


def test_settings_win_over_flags(folder):
    job = resolved("ball.npz", "--density-scale", "3", "--set", "density.scale=4")
    assert job["density"]["scale"] == 4


@pytest.mark.parametrize(
    ("job", "flags", "part", "expected"),
    [
        ("[color]\nconstant = [1, 0, 0]", "--color-grid Cd", "color", (None, "Cd")),
        ("[color]\ngrid = 'Cd'", "--color 0,1,0", "color", ([0, 1, 0], None)),
        ("[background]\nimage = 'a.png'", "--background 0,1,0", "background", ([0, 1, 0], None)),
        ("[background]\ncolor = [1, 1, 1]", "--background b.png", "background", (None, "b.png")),
        ("[background]\nimage = 'a.png'", "--background transparent", "background", (None, None)),
        ("[quadrature]\nrule = 'midpoint'\nstep = 2", "--set quadrature.rule=exact", "quadrature",
         ("exact", None)),
    ],
)  # fmt: skip
def test_a_flag_drops_what_it_excludes_of_a_job(folder, job, flags, part, expected):
    (folder / "job.toml").write_text(f"{JOB}{job}\n")
    found = resolved("job.toml", *flags.split())[part]
    assert tuple(found.values())[: len(expected)] == expected


def test_fov_makes_an_orthographic_job_perspective(folder):
    (folder / "job.toml").write_text(f"{JOB}[camera]\ntype = 'orthographic'\nwidth = 3\n")
    camera = resolved("job.toml", "--fov", "30")["camera"]
    assert (camera["type"], camera["fov"], camera["width"]) == ("perspective", 30, None)


def test_paths_of_a_job_are_relative_to_it_and_those_of_flags_to_the_user(folder):
    (folder / "jobs").mkdir()
    (folder / "jobs" / "job.toml").write_text(
        "[density]\nfile = '../ball.npz'\n[background]\nimage = 'sky.png'\n"
        "[output]\nimage = 'a.exr'\n[color]\nfile = 'c.vdb'\n[emission]\nfile = 'e.vdb'\n"
    )
    job = resolved("jobs/job.toml")
    assert job["density"]["file"] == "jobs/../ball.npz"
    assert job["background"]["image"] == "jobs/sky.png"
    assert job["output"]["image"] == "jobs/a.exr"
    assert (job["color"]["file"], job["emission"]["file"]) == ("jobs/c.vdb", "jobs/e.vdb")
    assert resolved("jobs/job.toml", "-o", "b.exr")["output"]["image"] == "b.exr"


def test_a_job_with_a_byte_order_mark_is_read(folder):
    (folder / "job.toml").write_text(JOB, encoding="utf-8-sig")
    assert resolved("job.toml")["density"]["file"] == "ball.npz"


# -- what is written ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "lens",
    [
        (),
        ("--ortho", "7.3"),
        ("--set", "camera.type=orthographic"),
        ("--set", "camera.type=panorama"),
        ("--set", "camera.samples=3"),
    ],
    ids=" ".join,
)
def test_the_job_in_the_header_makes_the_identical_picture(folder, tmp_path, monkeypatch, lens):
    picture, job = rendered("ball.npz", "--size", "17x11", "--density-scale", "0.3", *lens)
    _, attributes = read_exr("out.exr")
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    (elsewhere / "again.toml").write_text(str(attributes["volcli:job"]))
    again, job_again = rendered("again.toml")
    assert same(picture, again)
    del job["output"], job_again["output"]
    assert job == job_again


@pytest.mark.needs_jit
def test_the_job_in_the_header_names_what_was_chosen_of_the_camera(folder):
    _, job = rendered("ball.npz")
    assert job["camera"]["fov"] == 40
    assert job["camera"]["resolution"] == [800, 600]
    assert job["camera"]["eye"][:2] == job["camera"]["target"][:2]


def test_the_header_says_what_made_the_picture(folder):
    rendered("ball.npz", *SMALL)
    _, attributes = read_exr("out.exr")
    assert str(attributes["Software"]).startswith("volcli 0.")
    assert attributes["volcli:rule"] == "exact"
    assert {f"volcli:seconds_{n}" for n in ("load", "compile", "render")} <= set(attributes)


def test_an_existing_picture_is_replaced_unless_the_user_says_no(folder):
    rendered("ball.npz", *SMALL)
    before = (folder / "out.exr").read_bytes()
    kept = volcli("render", "ball.npz", "-o", "out.exr", "--size", "4x4", "--no-overwrite")
    assert kept.code == 4
    assert (folder / "out.exr").read_bytes() == before
    channels, _ = rendered("ball.npz", "--size", "4x4")
    assert channels["A"].shape == (4, 4)


@pytest.mark.parametrize("job", sorted((ROOT / "configs").glob("*.toml")), ids=lambda p: p.stem)
def test_every_shipped_job_shows_its_volume(job, tmp_path):
    out = tmp_path / "picture.exr"
    ran = volcli("render", job, "--size", "48x36", "-o", out, "--json")
    assert ran.code == 0, ran.err
    transmittance = json.loads(ran.out)["transmittance"]
    assert transmittance["min"] < 0.2
    assert 0.3 < transmittance["mean"] < 0.95
    assert transmittance["max"] > 0.9999
    channels, _ = read_exr(out)
    assert channels["R"].std() > 0.05


def test_every_sample_has_a_job():
    jobs = {p.stem for p in (ROOT / "configs").glob("*.toml")}
    assert {p.stem for p in SAMPLES.glob("*.vdb")} <= jobs


# -- the process ----------------------------------------------------------------------------------

COMMAND = [sys.executable, "-c", "from volcli.cli import main; main()"]


def test_a_reader_that_goes_away_is_no_error(folder):
    read, write = os.pipe()
    os.close(read)
    arguments = ["render", "ball.npz", "-o", "a.exr", *SMALL, "--quiet"]
    ended = subprocess.run(
        [*COMMAND, *arguments], stdout=write, stderr=subprocess.PIPE, timeout=100
    )
    os.close(write)
    assert (ended.returncode, ended.stderr) == (0, b"")
    assert (folder / "a.exr").exists()


@pytest.mark.parametrize("after_seconds", [2, 4])
def test_an_interrupt_ends_at_once_with_130_and_leaves_nothing(folder, after_seconds):
    arguments = ["render", "ball.npz", "-o", "a.exr", "--size", "9000x9000"]
    process = subprocess.Popen(
        [*COMMAND, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )  # a shell has what it starts in the background ignore interrupts
    time.sleep(after_seconds)
    process.send_signal(signal.SIGINT)
    asked = time.monotonic()
    out, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert (out, err) == ("", "volcli: interrupted\n")
    assert time.monotonic() - asked < 10
    assert [p.name for p in folder.iterdir()] == ["ball.npz"]


def test_results_and_notes_keep_their_order_when_they_share_a_stream(folder):
    arguments = ["render", "ball.npz", "-o", "a.exr", *SMALL, "--explain"]
    ended = subprocess.run(
        [*COMMAND, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=100,
        env={k: v for k, v in os.environ.items() if k != "PYTHONUNBUFFERED"},
    )
    order = [ended.stdout.index(s) for s in ("optical depth", "camera chosen", "a.exr  picture")]
    assert order == sorted(order)


def test_help_names_every_option_with_its_default():
    ran = volcli("render", "--help")
    assert ran.code == 0
    for text in ("[default: 1]", "[default: 0,1,0]", "Absent: 800x600", "--set KEY=VALUE"):
        assert text in " ".join(ran.out.split())


def test_no_arguments_print_the_help_and_are_a_usage_error():
    ran = volcli()
    assert ran.code == 2
    assert "render" in ran.out


def test_the_version_is_that_of_the_package():
    assert volcli("--version").out == f"volcli {version('volcli')}\n"


def test_the_summary_of_a_command_is_the_first_line_of_its_help():
    from volcli.cli.app import COMMANDS

    for name, summary in COMMANDS.items():
        assert volcli(name, "--help").out.splitlines()[2].strip() == summary
        assert f"{name}  " in volcli("--help").out
        assert summary in volcli("--help").out
