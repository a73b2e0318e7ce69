"""OpenVDB's own library behind the interface of readers, and what is said when it is not there."""

import os
import stat
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from test_grids_vdb import CONFORMANCE, REAL, assert_same_trees, needs, random_grid, world_of
from vdbwriter import Grid, write_vdb

from volcli.errors import VolumeError
from volcli.grids import pyopenvdb
from volcli.grids.pyopenvdb import INTERPRETER_VARIABLE, find_interpreter, open_openvdb
from volcli.grids.vdb import open_vdb


@pytest.fixture
def library():
    try:
        return find_interpreter()
    except VolumeError as error:
        pytest.skip(str(error))


@pytest.mark.parametrize("value_type", ["float", "bool", "vec3s"])
def test_both_readers_give_the_same_tree(tmp_path, library, value_type):
    path = tmp_path / "a.vdb"
    write_vdb(path, [random_grid(np.random.default_rng(1), value_type)])
    ours, theirs = open_vdb(path), open_openvdb(path)
    steps = []
    tree = theirs.read_tree(theirs.headers[0], lambda done, total: steps.append((done, total)))
    assert_same_trees(ours.read_tree(ours.headers[0]), tree)
    assert steps == [(4, 4)]


@pytest.mark.parametrize(
    "name",
    [
        *("bool.vdb", "empty.vdb", "far.vdb", "half_ls.vdb", "in_pmbg.vdb", "instanced.vdb"),
        *("nan.vdb", "stream.vdb", "tiles_bool.vdb", "tiles_only.vdb", "tiles_vec.vdb"),
        *("vec3s_half.vdb", "x_affine.vdb"),
    ],
)
def test_both_readers_agree_on_conformance_files(library, name):
    needs(CONFORMANCE)
    compare(CONFORMANCE / name)


@pytest.mark.parametrize(
    "name", ["density_and_heat.vdb", "level_set_unnamed.vdb", "three_density_grids.vdb"]
)
def test_both_readers_agree_on_real_files(library, name):
    needs(REAL)
    compare(REAL / name)


def compare(path):
    ours, theirs = open_vdb(path), open_openvdb(path)
    by_label = {header.label: header for header in ours.headers}
    assert by_label.keys() == {header.label for header in theirs.headers}
    for other in theirs.headers:
        one = by_label[other.label]
        for name in ("name", "value_type", "grid_class", "map_type", "active_voxels", "active_box"):
            assert getattr(one, name) == getattr(other, name), name
        points = [(0, 0, 0), (1, 2, 3), (-40.5, 7, 0)]
        np.testing.assert_allclose(
            world_of(one, points), world_of(other, points), rtol=1e-12, atol=1e-12
        )
        assert_same_trees(ours.read_tree(one), theirs.read_tree(other))


def test_a_grid_that_the_library_does_not_know_leaves_the_others_readable(tmp_path, library):
    path = tmp_path / "a.vdb"
    good = random_grid(np.random.default_rng(2), name="good")
    write_vdb(path, [Grid(name="odd", type_name="Tree_ptdataidx32_5_4_3"), good])
    volume = open_openvdb(path)
    headers = {header.label: header for header in volume.headers}
    ours = open_vdb(path)
    assert_same_trees(ours.read_tree(ours.headers[1]), volume.read_tree(headers["good"]))
    with pytest.raises(VolumeError, match="grid 'odd': not supported: OpenVDB's library: "):
        volume.read_tree(headers["odd"])


def test_a_frustum_is_refused(library):
    needs(CONFORMANCE)
    volume = open_openvdb(CONFORMANCE / "x_frustum.vdb")
    with pytest.raises(VolumeError, match="frustum transform"):
        volume.read_tree(volume.headers[0])


def test_what_is_no_openvdb_file_is_a_volume_error(tmp_path, library):
    path = tmp_path / "a.vdb"
    path.write_bytes(b"NOT A VDB FILE" * 20)
    with pytest.raises(VolumeError, match=r"a\.vdb: OpenVDB's library"):
        open_openvdb(path)


def test_a_missing_file_is_a_volume_error(tmp_path):
    with pytest.raises(VolumeError, match="no such file"):
        open_openvdb(tmp_path / "no.vdb")


def test_the_library_is_never_imported_here(tmp_path, library):
    write_vdb(tmp_path / "a.vdb", [Grid()])
    code = (
        "import sys; from volcli.grids.pyopenvdb import open_openvdb as o; "
        f"v = o({str(tmp_path / 'a.vdb')!r}); v.read_tree(v.headers[0]); "
        "assert not {'openvdb', 'pyopenvdb'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def fake_interpreter(path, script):
    """An interpreter that passes the search for one, then does what ``script`` says."""
    if os.name != "posix":
        pytest.skip("needs a shell")
    path.write_text(f'#!/bin/sh\nif [ "$2" = -c ]; then exit 0; fi\n{script}\n')
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return str(path)


def test_a_crash_of_the_library_is_a_volume_error(tmp_path, monkeypatch):
    crashing = fake_interpreter(tmp_path / "python", "kill -SEGV $$")
    monkeypatch.setenv(INTERPRETER_VARIABLE, crashing)
    write_vdb(tmp_path / "a.vdb", [Grid()])
    with pytest.raises(VolumeError, match="was killed by SIGSEGV"):
        open_openvdb(tmp_path / "a.vdb")


def test_the_worker_sees_nothing_of_our_environment(tmp_path, monkeypatch):
    said = tmp_path / "said"
    spy = fake_interpreter(tmp_path / "python", f'env > "{said}"; echo "$1" >> "{said}"; exit 1')
    monkeypatch.setenv(INTERPRETER_VARIABLE, spy)
    monkeypatch.setenv("PYTHONPATH", "/elsewhere")
    monkeypatch.setenv("VIRTUAL_ENV", "/elsewhere")
    write_vdb(tmp_path / "a.vdb", [Grid()])
    with pytest.raises(VolumeError, match="ended with 1"):
        open_openvdb(tmp_path / "a.vdb")
    lines = said.read_text().splitlines()
    assert not [line for line in lines if line.startswith(("PYTHON", "VIRTUAL_ENV"))]
    assert lines[-1] == "-I"


def test_without_the_library_the_message_says_what_to_do(tmp_path, monkeypatch):
    monkeypatch.delenv(INTERPRETER_VARIABLE, raising=False)
    monkeypatch.setattr(pyopenvdb, "_has_openvdb", lambda interpreter: False)
    write_vdb(tmp_path / "a.vdb", [Grid()])
    with pytest.raises(VolumeError, match=f"python3-openvdb or set {INTERPRETER_VARIABLE}"):
        open_openvdb(tmp_path / "a.vdb")


def test_an_interpreter_that_was_chosen_is_not_replaced_by_another(tmp_path, monkeypatch):
    monkeypatch.setenv(INTERPRETER_VARIABLE, str(tmp_path / "none"))
    with pytest.raises(VolumeError, match="this interpreter has no openvdb"):
        find_interpreter()


def test_the_worker_imports_nothing_of_volcli():
    worker = Path(pyopenvdb.__file__).with_name("_openvdb_worker.py").read_text()
    assert "import volcli" not in worker
    assert "from volcli" not in worker
