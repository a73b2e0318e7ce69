"""Mistakes in what a job says of colour, emission and density by value: one line, by its field."""

import re

import numpy as np
import pytest
from commandline import volcli, write_ball, write_grid


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder to stand in, with a ball of three grids and a level set."""
    write_ball(tmp_path / "ball.npz")
    arrays = dict(np.load(tmp_path / "ball.npz"))
    arrays["celsius"] = 1000 * arrays["density"] - 300
    np.savez(tmp_path / "ball.npz", **arrays)
    level_set = {"class": ("string", b"level set")}
    write_grid(tmp_path / "set.vdb", name="surface", metadata=level_set)
    monkeypatch.chdir(tmp_path)
    return tmp_path


RAMP = 'ramp = { grid = "density", %s }'

# what is wrong: (the job, exit code, parts of the message)
WRONG = {
    # two sources
    "two colours": (
        "[color]\nconstant = [1, 1, 1]\nramp = { map = 'jet' }",
        2,
        "color.constant and color.ramp exclude each other",
    ),
    "grid and blackbody": (
        "[color]\ngrid = 'Cd'\nblackbody = { grid = 'density' }",
        2,
        "color.grid and color.blackbody exclude",
    ),
    "two emissions": (
        "[emission]\ngrid = 'Cd'\nramp = { map = 'jet' }",
        2,
        "emission.grid and emission.ramp exclude",
    ),
    "map and stops": (
        "[color]\n" + RAMP % "map = 'jet', stops = [[0, 0, 0, 0]]",
        2,
        "color.ramp: map is for a map; stops",
    ),
    "emission of no grid": ("[emission]\nconstant = [1, 1, 1]", 2, "name it as emission.grid"),
    # ramps
    "empty range": ("[color]\n" + RAMP % "range = [1, 1]", 2, "color.ramp.range: must be .*low"),
    "range turned": ("[color]\n" + RAMP % "range = [2, 1]", 2, "color.ramp.range: must be .*low"),
    "range NaN": ("[color]\n" + RAMP % "range = [nan, 1]", 2, "color.ramp.range: must be finite"),
    "range of three": (
        "[color]\n" + RAMP % "range = [1, 2, 3]",
        2,
        "color.ramp.range: must be a list of 2 numbers",
    ),
    "stops out of order": (
        "[color]\n" + RAMP % "stops = [[1, 0, 0, 0], [0, 1, 1, 1]]",
        2,
        "color.ramp.stops: must ascend; 0 follows 1",
    ),
    "stops of one value": (
        "[emission]\n" + RAMP % "stops = [[1, 0, 0, 0], [1, 1, 1, 1]]",
        2,
        "emission.ramp.stops: must ascend; 1 follows 1",
    ),
    "no stops": ("[color]\n" + RAMP % "stops = []", 2, "color.ramp.stops: must hold at least one"),
    "stops of three": (
        "[color]\n" + RAMP % "stops = [[1, 0, 0]]",
        2,
        r"color.ramp.stops: must be a list of \[value, R, G, B\] rows",
    ),
    "stops below 0": (
        "[color]\n" + RAMP % "stops = [[1, -1, 0, 0]]",
        2,
        "color.ramp.stops: must be at least 0, not -1",
    ),
    "density stops turned": (
        "[density]\nramp = { stops = [[0.5, 1], [0.3, 0]] }",
        2,
        "density.ramp.stops: must ascend; 0.3 follows 0.5",
    ),
    "density below 0": (
        "[density]\nramp = { stops = [[0.5, -1]] }",
        2,
        "density.ramp.stops: must be at least 0",
    ),
    "density of no stops": ("[density]\nramp = {}", 2, "density.ramp.stops: is missing; give a li"),
    "unknown map": (
        "[color]\n" + RAMP % "map = 'infreno'",
        2,
        "color.ramp.map: no colour map 'infreno' .*did you mean 'inferno'",
    ),
    "unknown map of emission": (
        "[emission]\n" + RAMP % "map = 'magmaa'",
        2,
        "emission.ramp.map: .*did you mean 'magma'",
    ),
    "unknown key of a ramp": (
        "[color]\n" + RAMP % "rnage = [0, 1]",
        2,
        "unknown key 'color.ramp.rnage'; did you mean 'color.ramp.range'",
    ),
    "a ramp that is a name": ("[color]\nramp = 'jet'", 2, r"must be a table, \[color.ramp\]"),
    # grids
    "a ramp of vectors": (
        "[color]\nramp = { grid = 'Cd' }",
        3,
        "grid 'Cd' is vec3float32, and color.ramp.grid is scalar; choose another: density",
    ),
    "a blackbody of vectors": (
        "[emission]\nblackbody = { grid = 'Cd' }",
        3,
        "and emission.blackbody.grid is scalar",
    ),
    "a constant times vectors": (
        "[emission]\ngrid = 'Cd'\nconstant = [1, 1, 1]",
        3,
        "and emission.grid is scalar",
    ),
    "no such grid": (
        "[color]\nramp = { grid = 'densty' }",
        3,
        "no scalar grid 'densty' for color.ramp.grid; .*did you mean 'density'",
    ),
    "no such emission": (
        "[emission]\ngrid = 'flame'",
        3,
        "no grid 'flame' for emission.grid; it has: ",
    ),
    "a blackbody of nothing": ("[color]\nblackbody = {}", 2, "color.blackbody.grid: is missing"),
    "no such file": ("[emission]\nfile = 'bal.npz'\ngrid = 'Cd'", 3, "did you mean ball.npz"),
    # temperatures
    "below 0 K": (
        "[color]\nblackbody = { grid = 'celsius' }",
        3,
        "grid 'celsius': is -300 to 700, .* color.blackbody makes that -300 to 700 K, below 0 K; "
        "change color.blackbody.scale or color.blackbody.offset",
    ),
    "far too hot": (
        "[color]\nblackbody = { grid = 'density', scale = 1e300 }",
        3,
        r"color.blackbody makes that 0 to 1e\+300 K, above 1e\+09 K",
    ),
    "a word for a switch": (
        "[color]\nblackbody = { grid = 'density', normalized = 'yes' }",
        2,
        "color.blackbody.normalized: must be true or false, not 'yes'",
    ),
    # the rest
    "no tint": ("[density]\ntint = [0, 0, 0]", 2, "density.tint: must not be 0,0,0"),
    "tint below 0": ("[density]\ntint = [1, -1, 0]", 2, "density.tint: must be at least 0"),
    "nothing to see": ("[density]\nscale = 0", 2, "nothing is emitted, so there is nothing to se"),
    "no such fog": ("[density]\nlevel_set = 'solid'", 2, "density.level_set: must be 'fog'"),
}


def with_volume(job):
    """The job with its volume named first in [density]."""
    head, table, rest = job.partition("[density]\n")
    return (
        f"[density]\nfile = 'ball.npz'\n{rest}\n{head}"
        if table
        else (f"[density]\nfile = 'ball.npz'\n{job}\n")
    )


@pytest.mark.parametrize("case", WRONG)
def test_a_mistake_is_answered_by_the_path_of_its_field(folder, case):
    job, code, message = WRONG[case]
    (folder / "job.toml").write_text(with_volume(job))
    ran = volcli("render", "job.toml", "-o", "a.exr", "--size", "8x6", "--quiet")
    assert ran.code == code, ran.err
    assert ran.err.startswith("volcli: ")
    assert ran.err.count("\n") == 1, ran.err
    assert re.search(message, ran.err), ran.err
    assert not (folder / "a.exr").exists()


def test_a_grid_of_one_value_has_no_range_for_a_map(tmp_path):
    write_grid(tmp_path / "flat.vdb", background=1)
    ran = volcli("render", tmp_path / "flat.vdb", "--explain", "--set", "color.ramp.map=jet")
    assert ran.code == 3
    assert "is 1 wherever it is active" in ran.err
    assert "give color.ramp.range" in ran.err


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("color.ramp.range=[3,1]", r"^volcli: --set color.ramp.range=\[3,1\]: must be \[low, high"),
        ("color.ramp.stops=[[1,0,0,0],[0,1,1,1]]", "^volcli: --set color.ramp.stops=.*must ascend"),
        (
            "color.ramp={map='jet', range=[3,3]}",
            r"^volcli: --set color.ramp=\{.*\}: color.ramp.range: must be \[low, high",
        ),
        (
            "color.ramp={rnage=[0,1]}",
            r"^volcli: --set color.ramp=.*\}: unknown key 'color.ramp.rna",
        ),
        ("color.ramp.map.x=1", "write PART.FIELD=VALUE"),
        ("color.constant.x=1", "unknown key 'color.constant.x'|must be a"),
        ("density.tint=[0,0,0]", "^volcli: --set density.tint=.*must not be 0,0,0"),
    ],
)
def test_a_setting_is_answered_as_it_was_written(folder, setting, message):
    ran = volcli("render", "ball.npz", "-o", "a.exr", "--set", setting)
    assert ran.code == 2
    assert ran.err.count("\n") == 1
    assert re.search(message, ran.err), ran.err


def test_a_level_set_is_refused_with_the_setting_that_takes_it(folder):
    ran = volcli("render", "set.vdb", "-o", "a.exr")
    assert ran.code == 3
    assert "--set density.level_set=fog" in ran.err


def test_a_volume_without_a_density_is_told_how_to_show_its_emission(tmp_path):
    write_grid(tmp_path / "light.vdb", name="Cd", value_type="vec3s", background=(0, 0, 0))
    ran = volcli("render", tmp_path / "light.vdb", "--explain", "--set", "emission.grid=Cd")
    assert ran.code == 3
    assert "emission alone needs none: density.scale = 0" in ran.err
    settings = ("--set", "emission.grid=Cd", "--set", "density.scale=0")
    assert volcli("render", tmp_path / "light.vdb", "--explain", *settings).code == 0
