"""The cache of bricks: what comes out of it is what went in, and nothing wrong comes out of it."""

import json
import os
import shutil

import numba
import numpy as np
import pytest
from commandline import VOLUMES, volcli, write_ball, write_grid

from volcli.errors import VolumeError
from volcli.grids import cache as caching
from volcli.grids import load_density, load_source, open_volume
from volcli.grids.dense import DenseVolume
from volcli.grids.vdb import VdbFile
from volcli.images import read_exr

SMALL = ("--size", "16x12", "--quiet")


@pytest.fixture
def ball(tmp_path):
    """A file with a density, some of it below 0 and one value NaN, and a colour."""
    path = write_ball(tmp_path / "ball.npz")
    arrays = dict(np.load(path))
    arrays["density"][4, 4, 4] = np.nan
    arrays["density"][0, 0, :3] = -1
    np.savez(path, **arrays)
    return path


def load(path, folder, label="density", nonfinite="zero", reader=load_density):
    volume = open_volume(path)
    header = next(h for h in volume.headers if h.label == label)
    return reader(volume, header, nonfinite, None, folder)


def assert_same(one, other):
    for a, b in zip(one.arrays, other.arrays, strict=True):
        assert a.shape == b.shape
        assert a.tobytes() == b.tobytes()
        assert numba.typeof(a) == numba.typeof(b), "the kernels would be compiled once more"
    for name in ("origin", "world_from_index", "active_box"):
        a, b = getattr(one, name), getattr(other, name)
        assert (a.dtype, a.tolist()) == (b.dtype, b.tolist())


def entries(folder):
    return sorted(folder.iterdir())


def no_reading(monkeypatch):
    """From here on only the cache can give bricks."""
    for reader in (DenseVolume, VdbFile):
        monkeypatch.setattr(reader, "read_tree", lambda *_: pytest.fail("the file was read"))


@pytest.mark.parametrize("label", ["density", "Cd"])
def test_the_second_load_is_the_first_with_its_warnings(ball, tmp_path, monkeypatch, label):
    folder = tmp_path / "a" / "cache"
    reader = load_source if label == "Cd" else load_density
    plain, warned = load(ball, None, label, reader=reader)
    assert len(warned) == (2 if label == "density" else 0)
    first, first_warned = load(ball, folder, label, reader=reader)
    no_reading(monkeypatch)
    second, second_warned = load(ball, folder, label, reader=reader)
    assert_same(plain, first)
    assert_same(plain, second)
    assert warned == first_warned == second_warned
    assert len(entries(folder)) == 1


@pytest.mark.parametrize("name", ["smoke.vdb", "temperature_tiles.vdb"])
def test_real_volumes_come_back_to_the_bit(tmp_path, monkeypatch, name):
    path = VOLUMES / "real" / name
    if not path.exists():
        pytest.skip(f"{path.name} is not there")
    label = open_volume(path).headers[0].label
    plain, _ = load(path, None, label)
    load(path, tmp_path, label)
    no_reading(monkeypatch)
    assert_same(plain, load(path, tmp_path, label)[0])


def test_an_empty_grid_comes_back(tmp_path, monkeypatch):
    path = write_grid(tmp_path / "a.vdb", leaves={})
    plain, warned = load(path, tmp_path / "cache")
    no_reading(monkeypatch)
    again, warned_again = load(path, tmp_path / "cache")
    assert_same(plain, again)
    assert warned == warned_again
    assert "is empty" in warned[0]


def test_a_file_that_was_moved_is_found_and_warned_of_by_its_new_name(ball, tmp_path, monkeypatch):
    load(ball, tmp_path / "cache")
    moved = ball.rename(tmp_path / "moved.npz")
    no_reading(monkeypatch)
    _, warned = load(moved, tmp_path / "cache")
    assert all(warning.startswith(f"{moved}: grid 'density': ") for warning in warned)


def test_each_grid_setting_and_state_of_the_file_has_its_own_entry(ball, tmp_path, monkeypatch):
    folder = tmp_path / "cache"
    load(ball, folder)
    load(ball, folder, "Cd", reader=load_source)
    assert len(entries(folder)) == 2
    with pytest.raises(VolumeError, match="NaN"):
        load(ball, folder, nonfinite="error")  # never out of the entry that took NaN as 0
    assert len(entries(folder)) == 2
    os.utime(ball, ns=(0, ball.stat().st_mtime_ns + 1))
    load(ball, folder)
    assert len(entries(folder)) == 3
    monkeypatch.setattr(caching, "FORMAT", caching.FORMAT + 1)
    load(ball, folder)
    assert len(entries(folder)) == 4


def test_other_values_of_the_same_size_and_time_are_told_apart_by_the_ends_of_the_file(tmp_path):
    path = tmp_path / "a.npy"
    np.save(path, np.full((4, 4, 4), 1.0, np.float32))
    os.utime(path, ns=(0, 10**18))
    one, _ = load(path, tmp_path / "cache")
    np.save(path, np.full((4, 4, 4), 2.0, np.float32))
    os.utime(path, ns=(0, 10**18))
    two, _ = load(path, tmp_path / "cache")
    assert (one.brightest, two.brightest) == (1.0, 2.0)


def test_a_file_that_changes_while_it_is_read_leaves_no_entry(ball, tmp_path):
    def change():
        loaded = load(ball, None)
        os.utime(ball, ns=(0, 1))
        return loaded

    caching.through_cache(tmp_path / "cache", ball, "density", (), change)
    assert not (tmp_path / "cache").exists()


def damage(kind, entry):
    raw = bytearray(entry.read_bytes())
    body = raw.index(b"\n") + 1
    if kind == "empty":
        raw = b""
    elif kind == "half":
        raw = raw[: len(raw) // 2]
    elif kind == "longer":
        raw += bytes(64)
    elif kind == "header":
        raw[body // 2] ^= 1
    elif kind == "no header":
        raw = os.urandom(4096).replace(b"\n", b"x")
    elif kind == "another's":
        raw = b"%PDF-1.4\n" + raw
    else:
        raw[{"first": body, "middle": (body + len(raw)) // 2}[kind]] ^= 64
    entry.write_bytes(raw)


@pytest.mark.parametrize(
    "kind", ["empty", "half", "longer", "header", "no header", "another's", "first", "middle"]
)
def test_a_damaged_entry_is_a_warning_and_built_anew(ball, tmp_path, monkeypatch, kind):
    folder = tmp_path / "cache"
    plain, warned = load(ball, folder)
    (entry,) = entries(folder)
    damage(kind, entry)
    again, warned_again = load(ball, folder)
    assert_same(plain, again)
    assert warned_again[:-1] == warned
    assert "damaged" in warned_again[-1]
    assert "\n" not in warned_again[-1]
    no_reading(monkeypatch)
    assert load(ball, folder)[1] == warned


def test_an_entry_that_is_replaced_or_gone_leaves_the_grid_that_was_mapped(ball, tmp_path):
    folder = tmp_path / "cache"
    plain, _ = load(ball, folder)
    mapped, _ = load(ball, folder)
    shutil.rmtree(folder)
    assert_same(plain, mapped)


def test_writing_to_a_mapped_grid_does_not_reach_the_entry(ball, tmp_path):
    plain, _ = load(ball, tmp_path / "cache")
    load(ball, tmp_path / "cache")[0].arrays.atlas[:] = 7
    assert_same(plain, load(ball, tmp_path / "cache")[0])


def test_what_fails_while_an_entry_is_written_leaves_nothing(ball, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pathlib.Path.replace", full)
    _, warned = load(ball, tmp_path / "cache")
    assert "No space left" in warned[-1]
    assert entries(tmp_path / "cache") == []


# -- volcli render --cache ------------------------------------------------------------------------


def test_pictures_are_the_same_with_and_without(tmp_path):
    ball = write_ball(tmp_path / "ball.npz")
    pictures = []
    for name, extra in (
        ("a", ()),
        ("b", ("--cache", tmp_path / "c")),
        ("c", ("--cache", tmp_path / "c")),
    ):
        out = tmp_path / f"{name}.exr"
        ran = volcli("render", ball, "--color-grid", "Cd", "-o", out, *SMALL, "--json", *extra)
        assert ran.code == 0, ran.err
        assert json.loads(ran.out)["warnings"] == []
        pictures.append(read_exr(out)[0])
    assert len(entries(tmp_path / "c")) == 2
    for picture in pictures[1:]:
        assert all(picture[c].tobytes() == pictures[0][c].tobytes() for c in pictures[0])


def test_a_folder_that_cannot_be_written_is_one_warning(tmp_path):
    ball = write_ball(tmp_path / "ball.npz")
    (tmp_path / "file").write_text("in the way")
    out = tmp_path / "a.exr"
    for folder in (tmp_path / "file", tmp_path / "file" / "below"):
        ran = volcli(
            "render", ball, "--color-grid", "Cd", "-o", out, *SMALL, "--cache", folder, "--json"
        )
        assert ran.code == 0, ran.err
        (warning,) = json.loads(ran.out)["warnings"]
        assert warning.startswith(f"{folder}: the cache cannot be written: ")
        assert ran.err.count("cannot be written") == 1
