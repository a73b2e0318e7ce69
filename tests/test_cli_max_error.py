"""`volcli render --max-error`: what is written and said of a certified picture, and by whom."""

import json

import numpy as np
import pytest
from commandline import SAMPLES, volcli, write_ball

from volcli.bounds import BYTES_A_BRICK
from volcli.config import load_job
from volcli.estimate import estimate
from volcli.grids import open_volume
from volcli.images import read_exr

SMALL = ("--size", "16x12")
CLOUD = SAMPLES / "cloud.vdb"
E = 0.01


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The user stands in a folder with a ball and nothing else."""
    monkeypatch.chdir(tmp_path)
    write_ball(tmp_path / "ball.npz")
    return tmp_path


def test_a_certified_picture_holds_its_error_as_a_layer_a_map_a_header_and_in_the_json(folder):
    ran = volcli(
        *("render", CLOUD, "-o", "a.exr", "--size", "48x32", "--max-error", E),
        *("--maps", "error_bound,opacity", "--json"),
    )
    assert ran.code == 0, ran.err
    printed = json.loads(ran.out)
    assert printed["rule"] == "certified 0.01"
    channels, header = read_exr("a.exr")
    layer = channels["error_bound.Y"]
    assert 0 < layer.max() <= E
    assert printed["error_bound"] == header["volcli:error_bound"] == layer.max()
    assert header["volcli:rule"] == "certified 0.01"
    np.testing.assert_array_equal(read_exr("a.error_bound.exr")[0]["Y"], layer)
    volcli("render", CLOUD, "-o", "exact.exr", "--size", "48x32")
    exact = read_exr("exact.exr")[0]["transmittance.Y"].astype(np.float64)
    assert (np.abs(channels["transmittance.Y"] - exact) <= layer).all()


def test_a_map_of_the_error_as_png_says_what_black_and_white_are(folder):
    ran = volcli(
        *("render", CLOUD, "-o", "a.png", *SMALL, "--max-error", E, "--maps", "error_bound"),
        "--json",
    )
    written = json.loads(ran.out)["maps"]["error_bound"]
    assert 0 <= written["black"] < written["white"] <= E


def test_the_summary_says_what_is_certified(folder):
    ran = volcli("render", "ball.npz", "-o", "a.exr", *SMALL, "--max-error", E)
    rule, certified = ran.out.splitlines()[1:3]
    assert rule.startswith("certified 0.01: 192 rays, ")
    assert certified.startswith("certified: no pixel's transmittance")


@pytest.mark.parametrize("how", [(), ("--step", "1"), ("--max-error", "0")])
def test_other_rules_certify_nothing(folder, how):
    ran = volcli("render", "ball.npz", "-o", "a.exr", *SMALL, *how, "--json")
    assert "error_bound" not in json.loads(ran.out)
    channels, header = read_exr("a.exr")
    assert "error_bound.Y" not in channels
    assert "volcli:error_bound" not in header


def test_an_error_of_0_is_the_exact_picture_to_the_bit(folder):
    for name, how in (("a.exr", ()), ("b.exr", ("--max-error", "0"))):
        volcli("render", "ball.npz", "-o", name, *SMALL, *how)
    one, other = (read_exr(name)[0] for name in ("a.exr", "b.exr"))
    assert {n: v.tobytes() for n, v in one.items()} == {n: v.tobytes() for n, v in other.items()}


REFUSED = {
    "a step as well": (
        ("--step", "1", "--max-error", "0.1"),
        "--step and --max-error exclude each other; give one",
    ),
    "both errors": (
        ("--max-error", "0.1", "--target-error", "0.1"),
        "--max-error and --target-error exclude each other; give one",
    ),
    "finer than a pixel can hold": (
        ("--max-error", "1e-7"),
        "--max-error 1e-07: must be 0, which is exact, or at least 1e-06: pixels are float32",
    ),
    "too large": (("--max-error", "1"), "--max-error 1: must be below 1"),
    "below 0": (("--target-error", "-1"), "--target-error -1: must be at least 0"),
    "a map of what is not certified": (
        ("--maps", "error_bound"),
        "command line: output.maps: error_bound is what quadrature.max_error certifies; give one "
        "above 0",
    ),
    "a map of an error of 0": (
        ("--maps", "error_bound", "--max-error", "0"),
        "command line: output.maps: error_bound is what quadrature.max_error certifies; give one "
        "above 0",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_does_not_go_together_is_refused_in_one_line(folder, case):
    arguments, message = REFUSED[case]
    ran = volcli("render", "ball.npz", "-o", "a.exr", *SMALL, *arguments)
    assert (ran.code, ran.err) == (2, f"volcli: {message}\n")
    assert not (folder / "a.exr").exists()


def test_an_error_on_the_command_line_wins_over_a_step_of_the_job(folder):
    (folder / "job.toml").write_text(
        "[density]\nfile = 'ball.npz'\n[quadrature]\nrule = 'midpoint'\nstep = 2.0\n"
    )
    ran = volcli("render", "job.toml", "-o", "a.exr", *SMALL, "--max-error", E, "--json")
    assert json.loads(ran.out)["rule"] == "certified 0.01"


def test_explain_says_what_is_certified(folder):
    ran = volcli("render", "ball.npz", "--explain", "--max-error", E)
    assert "rule: certified 0.01" in ran.out
    assert "off by at most 0.01, pixel by pixel" in " ".join(ran.out.split())
    printed = json.loads(volcli("render", "ball.npz", "--explain", "--json").out)
    assert printed["rule"] == "exact"
    terms = {term["name"]: term for term in printed["plan"]}
    assert not terms["error bound"]["wanted"]


def test_the_memory_of_bounds_is_counted():
    job = load_job(CLOUD, [("camera.resolution", (4000, 4000))])
    certified = load_job(CLOUD, [("camera.resolution", (4000, 4000)), ("quadrature.max_error", E)])
    volume = open_volume(CLOUD)
    bricks = volume.census(volume.headers[0]).bricks
    assert bricks > 1000
    assert estimate(certified) == estimate(job) + bricks * BYTES_A_BRICK


def test_inspect_and_compare_know_the_error_of_a_picture(folder):
    volcli("render", CLOUD, "-o", "a.exr", "--size", "48x32", "--max-error", E)
    layer = read_exr("a.exr")[0]["error_bound.Y"]
    ran = volcli("inspect", "a.exr", "--json")
    found = json.loads(ran.out)["maps"]["error_bound"]
    assert found["from"] == "layer error_bound"
    assert found["max"] == layer.max()
    ran = volcli("inspect", "a.exr", "--map", "error_bound", "--heatmap", "error.png")
    assert ran.code == 0, ran.err
    assert (folder / "error.png").stat().st_size > 10_000
    ran = volcli("compare", "a.exr", "a.exr", "--json")
    assert json.loads(ran.out)["channels"]["error_bound.Y"]["max"] == 0


def test_probe_shows_the_certified_rule_beside_the_exact_one(folder):
    arguments = ("probe", CLOUD, "--pixel", "24,16", "--size", "48x32")
    ran = volcli(*arguments, "--set", f"quadrature.max_error={E}", "--json")
    exact, certified, midpoint, *_ = json.loads(ran.out)["rays"][0]["rules"]
    assert (exact["rule"], certified["rule"]) == ("exact", "certified 0.01")
    assert exact["error_bound"] is midpoint["error_bound"] is None
    assert certified["error"] <= certified["error_bound"] <= E
    assert "certified" in volcli(*arguments, "--set", f"quadrature.max_error={E}").out
    assert "certified" not in volcli(*arguments).out


def test_a_batch_sweeps_over_errors_as_over_steps(folder):
    (folder / "batch.toml").write_text(
        "[defaults.density]\nfile = 'ball.npz'\n"
        "[defaults.camera]\nresolution = [16, 12]\n"
        "[defaults.quadrature]\nrule = 'midpoint'\nstep = 1.0\n"
        "[defaults.output]\nimage = 'e{quadrature.max_error}.exr'\n"
        "[sweep]\nquadrature.max_error = [0, 0.1, 0.01]\n"
    )
    ran = volcli("batch", "batch.toml", "--workers", "1", "--json")
    assert ran.code == 0, ran.err
    rules = {name: read_exr(name)[1]["volcli:rule"] for name in ("e0.exr", "e0.1.exr", "e0.01.exr")}
    assert list(rules.values()) == ["exact", "certified 0.1", "certified 0.01"]
    lines = [json.loads(line) for line in ran.out.splitlines()]
    bounds = [line["error_bound"] for line in lines if "error_bound" in line]
    assert len(bounds) == 2
