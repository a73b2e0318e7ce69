"""`volcli tradeoff`: what it prints and writes, whose setting it names, and what it refuses."""

import csv
import json
import tomllib

import numpy as np
import pytest
from commandline import SAMPLES, volcli, write_ball

from volcli.images import read_exr
from volcli.tradeoff.settings import MAX_ERRORS, STEPS

pytestmark = pytest.mark.needs_jit

SMALL = ("--size", "24x16")
FILES = ["tradeoff.csv", "tradeoff.json", "tradeoff.png"]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The user stands in a folder with a ball and nothing else."""
    monkeypatch.chdir(tmp_path)
    write_ball(tmp_path / "ball.npz")
    return tmp_path


def printed(*arguments, code=0):
    ran = volcli("tradeoff", *arguments, "--json")
    assert ran.code == code, ran.err
    return json.loads(ran.out)


def test_it_writes_a_table_data_and_a_picture_and_prints_the_same(folder):
    data = printed("ball.npz", "-o", "out", *SMALL)
    assert sorted(p.name for p in (folder / "out").iterdir()) == FILES
    assert data["files"] == [f"out/{name}" for name in FILES]
    written = json.loads((folder / "out" / "tradeoff.json").read_text())
    assert {**written, "files": data["files"]} == data
    with (folder / "out" / "tradeoff.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert [line["rule"] for line in lines] == [one["rule"] for one in data["settings"]]
    assert len(lines) == 1 + len(STEPS) + len(MAX_ERRORS)
    assert (folder / "out" / "tradeoff.png").read_bytes().startswith(b"\x89PNG")
    assert data["size"] == data["measured_size"] == [24, 16]
    for one in data["settings"]:
        assert len(one["seconds"]) == data["rounds"] == 5
        if one["max_error"]:
            assert one["largest_error"] <= one["error_bound"] <= one["max_error"]
    assert data["settings"][0]["largest_error"] < 1e-7
    assert data["advice"] is None
    assert data["own"] is None


def test_the_table_has_a_line_for_each_setting_and_the_order_of_midpoint(folder):
    ran = volcli("tradeoff", SAMPLES / "cloud.vdb", "-o", "out", "--size", "60x40")
    assert ran.code == 0, ran.err
    assert "\nexact" in ran.out
    assert "\nmidpoint 0.125 " in ran.out
    assert "\ncertified 0.001 " in ran.out
    assert "midpoint: its error falls as step^" in ran.out
    assert ran.out.rstrip().endswith("out/tradeoff.png")


@pytest.mark.parametrize(
    ("arguments", "own"),
    [
        (("--step", "3"), "midpoint 3"),
        (("--max-error", "0.01"), "certified 0.01"),
        (("--set", "quadrature.rule=midpoint"), "midpoint 0.5"),
    ],
)
def test_the_users_own_setting_is_measured_and_named(folder, arguments, own):
    data = printed("ball.npz", "-o", "out", *SMALL, *arguments)
    assert data["own"] == own
    assert [one["rule"] for one in data["settings"] if one["own"]] == [own]


def test_a_jobs_target_error_is_measured_with_the_step_that_its_pilot_chooses(folder):
    (folder / "job.toml").write_text(
        "[density]\nfile = 'ball.npz'\n[camera]\nresolution = [24, 16]\n"
        "[quadrature]\ntarget_error = 0.1\n"
    )
    volcli("render", "job.toml", "-o", "a.exr")
    rule = str(read_exr("a.exr")[1]["volcli:rule"])
    assert printed("job.toml", "-o", "out")["own"] == rule.removeprefix("calibrated 0.1: ")


def test_the_advice_rendered_meets_the_target(folder):
    cloud, size = SAMPLES / "cloud.vdb", ("--size", "90x60")
    data = printed(
        *(cloud, "-o", "out", *size, "--target-error", "0.01", "--write-job", "job.toml")
    )
    advice = data["advice"]
    assert advice["largest_error"] <= 0.01
    assert "job.toml" in data["files"]
    volcli("render", cloud, "-o", "exact.exr", *size)
    ran = volcli("render", "job.toml", "-o", "advised.exr", "--json")
    assert json.loads(ran.out)["rule"] == advice["rule"]
    exact, advised = (read_exr(name)[0] for name in ("exact.exr", "advised.exr"))
    off = np.abs(exact["A"].astype(np.float64) - advised["A"])
    assert off.max() <= 0.01
    assert off.max() == pytest.approx(advice["largest_error"], abs=1e-6)


def test_the_job_that_is_written_keeps_all_of_the_users_but_the_rule(folder):
    (folder / "job.toml").write_text(
        "[density]\nfile = 'ball.npz'\nscale = 2.5\n[camera]\nresolution = [24, 16]\n"
        "[quadrature]\nmax_error = 0.1\n[output]\nimage = 'there/a.png'\nmaps = ['error_bound']\n"
    )
    ran = volcli(
        *("tradeoff", "job.toml", "-o", "out", "--time-budget", "1000"),
        *("--write-job", "better.toml"),
    )
    assert ran.code == 0, ran.err
    job = tomllib.loads((folder / "better.toml").read_text())
    assert job["density"]["scale"] == 2.5
    assert job["camera"]["eye"]
    assert job["output"]["image"] == str(folder / "there" / "a.png")
    certified = "max_error" in job["quadrature"]
    assert job["output"]["maps"] == (["error_bound"] if certified else [])
    assert volcli("render", "better.toml", "-o", "a.png").code == 0


def test_a_quick_picture_is_small_and_its_times_are_those_of_the_whole(folder):
    data = printed("ball.npz", "-o", "out", "--size", "400x200", "--quick")
    assert data["size"] == [400, 200]
    assert data["measured_size"] == [160, 80]
    assert data["quick"]
    small = printed("ball.npz", "-o", "out", "--size", "160x80")
    for one, other in zip(data["settings"], small["settings"], strict=True):
        assert one["evaluations"] == other["evaluations"], "the same view"
    ran = volcli("tradeoff", "ball.npz", "-o", "out", "--size", "400x200", "--quick")
    assert "an estimate: measured on a picture of 160x80" in ran.out


def test_what_cannot_be_had_is_said_and_what_was_found_is_written(folder):
    arguments = ("tradeoff", "ball.npz", "-o", "out", *SMALL, "--write-job", "job.toml")
    ran = volcli(*arguments, "--time-budget", "1e-9")
    assert ran.code == 1
    assert "volcli: no setting takes 1e-09 s or less; the fastest, " in ran.err
    assert "midpoint 8" in ran.out
    assert sorted(p.name for p in (folder / "out").iterdir()) == FILES
    assert not (folder / "job.toml").exists()
    ran = volcli(*arguments, "--target-error", "1e-12")
    assert ran.code == 1
    assert "volcli: no setting stays below 1e-12; " in ran.err


REFUSED = {
    "a job without advice": (
        ("--write-job", "a.toml"),
        2,
        "--write-job writes what --target-error or --time-budget names; give one",
    ),
    "a target of 0": (("--target-error", "0"), 2, "--target-error 0: must be above 0"),
    "a budget below 0": (("--time-budget", "-1"), 2, "--time-budget -1: must be above 0"),
    "two rules": (
        ("--step", "1", "--max-error", "0.1"),
        2,
        "--step and --max-error exclude each other; give one",
    ),
    "few rounds": (("--rounds", "2"), 2, "--rounds: must be greater than or equal to 5"),
    "a job of another kind": (
        ("--target-error", "0.1", "--write-job", "a.json"),
        2,
        "a.json: unknown extension '.json'; use .toml",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_wrong_is_said_in_one_line_before_any_work(folder, case):
    arguments, code, message = REFUSED[case]
    ran = volcli("tradeoff", "ball.npz", "-o", "out", *arguments)
    assert (ran.code, ran.out) == (code, "")
    assert ran.err.startswith(f"volcli: {message}")
    assert ran.err.count("\n") == 1


def test_a_folder_that_is_none_and_files_that_are_there_are_refused(folder):
    (folder / "file").write_text("")
    ran = volcli("tradeoff", "ball.npz", "-o", "file", *SMALL)
    assert ran.code == 4
    assert ran.err.startswith("volcli: file: ")
    (folder / "out").mkdir()
    (folder / "out" / "tradeoff.csv").write_text("mine")
    ran = volcli("tradeoff", "ball.npz", "-o", "out", *SMALL, "--no-overwrite")
    assert ran.code == 4
    assert "tradeoff.csv: already exists" in ran.err
    assert (folder / "out" / "tradeoff.csv").read_text() == "mine"


def test_a_picture_of_volclis_is_a_source_as_well(folder):
    volcli("render", "ball.npz", "-o", "a.exr", *SMALL, "--step", "1.5")
    assert printed("a.exr", "-o", "out")["own"] == "midpoint 1.5"
