"""`volcli info`: what it says of a file is what OpenVDB says of it."""

import json
import os

import numpy as np
import pytest
from commandline import SAMPLES, VOLUMES, volcli, write_ball, write_grid


def described(path, *options):
    ran = volcli("info", path, "--json", *options)
    assert ran.code == 0, ran.err
    assert ran.out.count("\n") == 1
    return json.loads(ran.out, parse_constant=lambda c: pytest.fail(f"{c} is not JSON"))


def expected(folder):
    path = VOLUMES / folder / "expected.json"
    return json.loads(path.read_text()) if path.exists() else {}


REAL = expected("real")
CONFORMANCE = expected("conformance")
POINTS = "ptdataidx32"


def _name(label):
    """A grid's name in its file, of the label that a user gives: ``density[1]`` is a density."""
    return label.partition("[")[0]


def _listed(grid):
    return _name(grid["name"]), grid["name"]


def test_the_files_to_compare_with_are_known():
    if not VOLUMES.exists():
        pytest.skip("no volumes of other programs beside the checkout")
    assert len(REAL) > 10
    assert len(CONFORMANCE) > 60


@pytest.mark.parametrize("name", sorted(REAL))
def test_a_real_file_is_described_as_openvdb_describes_it(name):
    if "grids" not in REAL[name]:
        pytest.skip("OpenVDB says nothing of it")
    path = VOLUMES / "real" / name
    grids = described(path, "--stats")["grids"]
    assert len(grids) == len(REAL[name]["grids"])
    for found, want in zip(grids, REAL[name]["grids"], strict=True):
        assert found["class"] == want["cls"]
        if found["refusal"]:
            assert POINTS in found["type"]
            continue
        assert found["grid"].partition("[")[0] == want["name"]
        assert found["type"] == want["type"]
        assert found["transform"] == want["xf"]
        assert found["voxels"] == want["active"]
        assert found["leaves"] == want["leafs"]
        assert found["box"] == want["bbox"]
        np.testing.assert_allclose(found["voxel_size"], want["voxel"], rtol=1e-6)
        matrix = np.array(found["world_from_index"])
        np.testing.assert_allclose(matrix[:3, 3], want["w000"], atol=1e-9)
        np.testing.assert_allclose((matrix @ [1, 2, 3, 1])[:3], want["w123"], atol=1e-6)
        assert np.allclose(found["background"], want["bg"])
        if "min" in want and not isinstance(want["min"], list):
            assert found["max"] == pytest.approx(want["max"], rel=1e-6)


@pytest.mark.parametrize("name", sorted(CONFORMANCE))
def test_a_file_of_every_kind_is_described_as_openvdb_describes_it(name):
    path = VOLUMES / "conformance" / name
    grids = described(path, "--stats")["grids"]
    assert len(grids) == len(CONFORMANCE[name])
    # OpenVDB lists grids by name, a file in the order in which they lie in it.
    order = sorted(grids, key=lambda g: (_name(g["grid"]), g["grid"]))
    for found, want in zip(order, sorted(CONFORMANCE[name], key=_listed), strict=True):
        assert want["type"] == f"Tree_{found['type']}_5_4_3" or found["refusal"]
        assert found["transform"] == want.get("maptype", found["transform"])
        if found["refusal"]:
            continue
        if "active" in want:
            assert found["voxels"] == want["active"]
        if "leaves" in want:
            assert found["leaves"] == want["leaves"]
        if found["world_from_index"] and "index_to_world" in want:
            of = np.array([[*p, 1.0] for p in want["index_to_world"]["of"]])
            there = (of @ np.array(found["world_from_index"]).T)[:, :3]
            np.testing.assert_allclose(there, want["index_to_world"]["points"], rtol=1e-12)


def test_only_headers_are_read_without_stats(monkeypatch):
    def refuse(*_):
        raise AssertionError("read voxels")

    monkeypatch.setattr("volcli.grids.vdb.read_tree", refuse)
    (grid,) = described(SAMPLES / "rotated.vdb")["grids"]
    assert grid["voxels"] == 21974
    assert "min" not in grid


def test_statistics_are_those_of_the_values(tmp_path):
    write_ball(tmp_path / "ball.npz", peak=2)
    with np.load(tmp_path / "ball.npz") as arrays:
        values = arrays["density"]
    density, color = described(tmp_path / "ball.npz", "--stats")["grids"]
    assert density["max"] == values.max()
    assert density["nan"] == density["inf"] == density["negative"] == 0
    assert color["mean"] == [1, 0.5, 0.25]


def test_values_that_are_no_numbers_are_counted_and_kept_out_of_the_range(tmp_path):
    values = np.ones((8, 8, 8), np.float32)
    values[0, 0, :3] = np.nan, np.inf, -2
    np.save(tmp_path / "odd.npy", values)
    (grid,) = described(tmp_path / "odd.npy", "--stats")["grids"]
    assert (grid["min"], grid["max"], grid["mean"]) == (-2, 1, None)
    assert (grid["nan"], grid["inf"], grid["negative"]) == (1, 1, 1)


@pytest.mark.parametrize("columns", [60, 100, 320])
def test_tables_keep_to_the_width_of_the_terminal(monkeypatch, columns):
    monkeypatch.setenv("COLUMNS", str(columns))
    monkeypatch.chdir(SAMPLES)  # the path that the user gives is printed whole, however long
    ran = volcli("info", "explosion.vdb", "--stats")
    assert max(map(len, ran.out.splitlines())) <= columns
    for text in ("149,911", "0.046", "UniformScaleTranslateMap", "3008", "min", "memory"):
        assert text in ran.out
    assert ran.out.count("temperature") == {60: 6, 100: 4, 320: 1}[columns]


def test_without_a_terminal_100_columns_are_enough(monkeypatch):
    monkeypatch.delenv("COLUMNS", raising=False)
    monkeypatch.chdir(SAMPLES)
    ran = volcli("info", "cloud.vdb", "--stats")
    if not os.isatty(1):
        assert max(map(len, ran.out.splitlines())) <= 100


def test_a_grid_that_cannot_be_rendered_is_listed_with_its_reason():
    path = VOLUMES / "real" / "points_only.vdb"
    if not path.exists():
        pytest.skip(f"no {path.name} beside the checkout")
    ran = volcli("info", path, "--stats")
    assert ran.code == 0
    assert "points: cannot be rendered: points grid" in ran.out


def test_a_level_set_is_called_one(tmp_path):
    path = write_grid(tmp_path / "set.vdb", name="", metadata={"class": ("string", b"level set")})
    (grid,) = described(path)["grids"]
    assert (grid["grid"], grid["class"]) == ("[0]", "level set")


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        ("gone.vdb", 3, "gone.vdb: no such file"),
        (".", 3, "is a folder"),
        ("x.vdb --reader other", 2, "--reader other: must be 'volcli' or 'openvdb'"),
        ("", 2, "Missing argument"),
    ],
)
def test_a_mistake_is_one_line(arguments, code, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ran = volcli("info", *arguments.split())
    assert (ran.code, ran.out) == (code, "")
    assert message in ran.err
    assert ran.err.count("\n") == 1
