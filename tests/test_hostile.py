"""Files that are made to do harm: refused by name, at the byte, before anything is allocated."""

import json
import os
import re
import struct
import subprocess
import sys
import time
import tracemalloc

import numpy as np
import pytest
from commandline import SAMPLES, VOLUMES, volcli
from vdbwriter import Grid, write_vdb

from volcli import render
from volcli.errors import VolumeError
from volcli.grids import load_density, open_volume
from volcli.grids.build import build
from volcli.memory import MemoryLimit, held_memory, memory_limited_to

FULL = np.ones((8, 8, 8), np.float32), np.ones((8, 8, 8), bool)


def written(path, *grids, **options):
    """The bytes of a file of some grids, and where they lie."""
    layouts = write_vdb(path, list(grids) or [Grid(leaves={(0, 0, 0): FULL})], **options)
    return bytearray(path.read_bytes()), layouts


def refused(path, raw, message):
    path.write_bytes(raw)
    tracemalloc.start()
    with pytest.raises(VolumeError, match=message) as caught:
        volume = open_volume(path)
        load_density(volume, volume.headers[0], "error")
    assert tracemalloc.get_traced_memory()[1] < 3e6
    tracemalloc.stop()
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("at", [0, 8, 16])
@pytest.mark.parametrize("value", [-1, 0, 1, 2**31, 2**63 - 1])
def test_offsets_that_lead_back_outside_or_across_are_refused(tmp_path, at, value):
    path = tmp_path / "a.vdb"
    raw, (layout,) = written(path)
    places = raw.index(struct.pack("<3q", layout.begin, layout.blocks, layout.end))
    struct.pack_into("<q", raw, places + at, value)
    refused(path, raw, r"at byte \d+: .*from byte .* with leaves from")


def test_grids_that_share_bytes_are_refused(tmp_path):
    path = tmp_path / "a.vdb"
    raw, (first, second) = written(path, Grid(name="a"), Grid(name="b"))
    places = raw.index(struct.pack("<3q", second.begin, second.blocks, second.end))
    struct.pack_into("<3q", raw, places, first.begin, first.blocks, first.end)
    refused(path, raw, "grid 'b' from byte")


def test_a_tree_may_not_go_on_into_the_next_grid(tmp_path):
    path = tmp_path / "a.vdb"
    grids = [Grid(name=name, leaves={(0, 0, 0): FULL}) for name in "ab"]
    raw, (first, _) = written(path, *grids)
    places = raw.index(struct.pack("<3q", first.begin, first.blocks, first.end))
    cut = bytes(raw[: first.end - 100] + raw[first.end :])
    raw = bytearray(cut)
    struct.pack_into("<q", raw, places + 16, first.end - 100)
    second = raw.index(b"\1\0\0\0b")
    struct.pack_into("<3q", raw, raw.index(struct.pack("<3q", *_of(raw, second))), *_moved(raw))
    refused(path, raw, "grid 'a': at byte .* left")


def _of(raw, second):
    name, kind = 5, 4 + struct.unpack_from("<I", raw, second + 5)[0]
    return struct.unpack_from("<3q", raw, second + name + kind + 4)


def _moved(raw):
    return [place - 100 for place in _of(raw, raw.index(b"\1\0\0\0b"))]


@pytest.mark.parametrize("parents", [{"a": "a"}, {"a": "b", "b": "a"}, {"a": "none"}])
def test_instances_of_themselves_of_each_other_and_of_nothing_are_refused(tmp_path, parents):
    path = tmp_path / "a.vdb"
    raw, _ = written(path, *(Grid(name=name, parent=parent) for name, parent in parents.items()))
    refused(path, raw, "instance of '.*', which has no tree to share")


def test_a_second_node_or_tile_at_one_place_is_refused(tmp_path):
    path = tmp_path / "a.vdb"
    tiles = {((4096 * i, 0, 0), 4096): (1.0, True) for i in range(2)}
    raw, (layout,) = written(path, Grid(tiles=tiles))
    struct.pack_into("<i", raw, layout.root + 8, 4096)
    refused(path, raw, "two tiles at one place")
    raw, (layout,) = written(path, Grid(leaves={(0, 0, 0): FULL}, tiles=tiles | {}))
    first = raw.index(struct.pack("<3i", 0, 0, 0), layout.root + 8)
    assert first == layout.root + 8
    refused(path, raw, r"a second node or tile at \(0, 0, 0\)")


def test_masks_that_promise_more_children_than_the_file_holds_are_refused(tmp_path):
    path = tmp_path / "a.vdb"
    raw, (layout,) = written(path)
    at = layout.root + 8 + 12
    raw[at : at + 4096] = b"\xff" * 4096
    refused(path, raw, "32768 nodes: .* bytes needed, .* left")


@pytest.mark.parametrize("length", [2**31, 2**31 - 1, 2**32 - 1])
def test_strings_longer_than_the_file_are_refused(tmp_path, length):
    path = tmp_path / "a.vdb"
    raw, _ = written(path)
    struct.pack_into("<I", raw, raw.index(b"\x07\0\0\0density"), length)
    refused(path, raw, f"the name of a grid: {length} bytes needed")


def test_a_name_cannot_give_orders_to_a_terminal(tmp_path):
    path = tmp_path / "a.vdb"
    written(path, Grid(name="\x1b]0;owned\x07\x1b[2J" + "x" * 5000, leaves={(0, 0, 0): FULL}))
    ran = volcli("info", path)
    assert ran.code == 0
    assert "\x1b" not in ran.out + ran.err


def root_tiles(path, count, values):
    """A file of so many tiles of the root, each apart from the others, in 17 bytes each."""
    raw, (layout,) = written(path, Grid())
    table = np.zeros(count, np.dtype([("at", "<i4", 3), ("value", "<f4"), ("on", "u1")]))
    cells = np.arange(count)
    table["at"] = 4096 * np.stack([cells % 100, cells // 100 % 100, cells // 10_000], axis=1)
    table["value"], table["on"] = values, 1
    body = struct.pack("<II", count, 0) + table.tobytes()
    places = raw.index(struct.pack("<3q", layout.begin, layout.blocks, layout.end))
    raw[layout.root :] = body
    struct.pack_into("<2q", raw, places + 8, len(raw), len(raw))
    path.write_bytes(raw)
    return path


def test_tiles_that_all_differ_are_refused_before_their_bricks_take_thousands_of_times(tmp_path):
    path = root_tiles(tmp_path / "a.vdb", 20_000, np.arange(20_000) + 1.0)
    assert path.stat().st_size < 350_000
    volume = open_volume(path)
    limit = held_memory(os.getpid()) + 10**9
    with memory_limited_to(limit), pytest.raises(VolumeError, match=r"need about .* GB of memory"):
        load_density(volume, volume.headers[0], "error")


def test_many_tiles_that_are_alike_are_read_at_once(tmp_path):
    path = root_tiles(tmp_path / "a.vdb", 60_000, 1.0)
    begin = time.perf_counter()
    volume = open_volume(path)
    grid, _ = load_density(volume, volume.headers[0], "error")
    assert time.perf_counter() - begin < 8
    assert grid.nbytes < 3e8


def test_what_does_not_fit_is_refused_with_what_it_needs_before_a_voxel_is_read(tmp_path):
    volume = open_volume(SAMPLES / "cloud.vdb")
    (header,) = (h for h in volume.headers if h.label == "density")
    with memory_limited_to(1), pytest.raises(VolumeError) as caught:
        volume.read_tree(header, lambda done, total: pytest.fail("voxels were read"))
    assert "need about" in str(caught.value) and "--max-memory" in str(caught.value)
    tree = volume.read_tree(header)
    with memory_limited_to(1), pytest.raises(MemoryLimit):
        build(tree, header)
    ran = volcli("render", SAMPLES / "cloud.vdb", "-o", tmp_path / "a.exr", "--max-memory", "1")
    assert ran.code in (2, 3)
    assert "--max-memory" in ran.err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["cloud", "explosion", "colored_smoke", "rotated"])
def test_the_census_of_a_grid_is_near_what_its_bricks_take(name):
    volume = open_volume(SAMPLES / f"{name}.vdb")
    for header in (h for h in volume.headers if not h.is_vector):
        census = volume.census(header)
        grid, _ = load_density(volume, header, "error")
        assert grid.nbytes / 1.1 < census.grid_bytes < grid.nbytes * 1.1
        assert census.leaves == len(volume.read_tree(header).leaf_origins)


@pytest.mark.parametrize("path", sorted(VOLUMES.glob("malformed/*.vdb")), ids=lambda p: p.name)
def test_a_malformed_file_ends_in_little_memory(path, tmp_path):
    code = (
        "import sys, volcli.run\n"
        "from volcli.cli import main\n"
        "try: main(sys.argv[1:])\n"
        "except SystemExit as end: print(end.code, volcli.run.peak_memory_bytes())"
    )
    command = ["render", path, "-o", tmp_path / "a.exr", "--size", "64x48", "--quiet"]
    ran = subprocess.run(
        [sys.executable, "-c", code, *map(str, command)],
        capture_output=True,
        text=True,
        timeout=240,
    )
    code, peak = ran.stdout.split()[-2:]
    assert int(peak) < 300e6
    if "truncated" in path.name:
        assert code == "3"
        assert re.search(r"at byte \d+", ran.stderr)
    else:
        assert code == "0", ran.stderr
        assert "is empty; it absorbs nothing" in ran.stderr


def test_numbers_that_json_does_not_have_are_null(tmp_path):
    path = tmp_path / "a.vdb"
    raw, _ = written(path)
    at = raw.index(b"UniformScaleMap") + len("UniformScaleMap")
    struct.pack_into("<2d", raw, at, np.nan, np.inf)
    path.write_bytes(raw)
    ran = volcli("info", path, "--stats", "--json")
    assert ran.code == 0, ran.err
    (grid,) = json.loads(ran.out)["grids"]
    assert grid["refusal"] == "transform with NaN or Inf"
    assert grid["world_from_index"][0][0] is None


@pytest.mark.needs_jit
@pytest.mark.parametrize(
    ("volume", "options"),
    [
        ("rotated", ("--size", "64x48")),
        ("cloud", ()),
        ("cloud", ("--color-grid", "Cd", "--size", "1000x1000")),
        ("cloud", ("--size", "2000x1500", "--bits", "16")),
        ("ball", ("--size", "200x200")),
        ("sparse", ("--size", "200x200")),
    ],
)
def test_the_peak_is_near_the_memory_that_explain_promised(volume, options, tmp_path):
    """`benchmarks/memory.py` goes on to fifty million voxels."""
    path = SAMPLES / f"{volume}.vdb"
    if volume in ("ball", "sparse"):
        values = np.random.default_rng(2).random((200, 200, 200), np.float32)
        if volume == "sparse":
            values[20:] = 0
        path = tmp_path / "a.npy"
        np.save(path, values)
    out = tmp_path / ("a.png" if "--bits" in options else "a.exr")
    command = ["render", path, "-o", out, *options, "--explain", "--json", "--quiet"]
    command = [sys.executable, "-c", "from volcli.cli import main; main()", *map(str, command)]
    told = json.loads(subprocess.run(command, capture_output=True, timeout=240).stdout)
    assert 0.8 < told["peak_memory_bytes"] / told["memory_bytes"] < 1.2


@pytest.mark.parametrize("value", [-0.5, 1.5])
def test_a_transmittance_that_is_no_probability_is_a_defect_and_never_a_picture(
    value, tmp_path, monkeypatch
):
    monkeypatch.setattr("volcli.render._mean", lambda v, mean=render._mean: mean(v) * 0 + value)
    ran = volcli("render", SAMPLES / "rotated.vdb", "-o", tmp_path / "a.exr", "--size", "8x6")
    assert ran.code == 1
    assert "transmittance is a probability" in ran.err
    assert list(tmp_path.iterdir()) == []


def test_a_density_whose_optical_depth_is_beyond_all_numbers_is_described(tmp_path):
    path = tmp_path / "a.npy"
    np.save(path, np.full((9, 9, 9), 1e308))
    ran = volcli("info", path, "--stats", "--json")
    assert ran.code == 0, ran.err
    assert json.loads(ran.out)["grids"][0]["optical_depth"] is None
