"""The OpenVDB reader against OpenVDB's own reading, and against files that lie."""

import hashlib
import itertools
import json
import struct
import time
import tracemalloc
import zlib
from pathlib import Path

import blosc
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from vdbwriter import ACTIVE_MASK, BLOSC, STORED, ZIP, Grid, write_vdb

from volcli.errors import VolumeError
from volcli.grids import vdb_tree
from volcli.grids.pyopenvdb import find_interpreter, open_openvdb
from volcli.grids.threads import in_threads
from volcli.grids.tree import Tree
from volcli.grids.vdb import open_vdb, unique_labels
from volcli.grids.vdb_codec import BlockCodec

VOLUMES = Path(__file__).parents[2] / "shared" / "volumes"
CONFORMANCE = VOLUMES / "conformance"
REAL = VOLUMES / "real"
MALFORMED = VOLUMES / "malformed"
TREE_FIELDS = tuple(Tree.__dataclass_fields__)


def expected_of(folder):
    """The expected.json of a folder, as a list of files; empty where the folder is absent."""
    file = folder / "expected.json"
    return sorted(json.loads(file.read_text()).items()) if file.is_file() else []


def cases(folder):
    """One case for each file, or one that skips."""
    found = expected_of(folder)
    missing = pytest.param(
        None, None, marks=pytest.mark.skip(reason=f"no {folder.name} volumes beside the checkout")
    )
    return [pytest.param(*case, id=case[0]) for case in found] or [missing]


def needs(folder):
    if not folder.is_dir():
        pytest.skip(f"no {folder.name} volumes beside the checkout")


def sha256(array):
    return hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()


def by_origin(origins):
    return np.lexsort(origins.T[::-1])


def assert_same_trees(one, other):
    """Equal bit for bit, whatever the order of leaves and tiles."""
    for prefix in ("leaf", "tile"):
        names = [name for name in TREE_FIELDS if name.startswith(prefix)]
        order = [by_origin(getattr(tree, f"{prefix}_origins")) for tree in (one, other)]
        for name in names:
            a, b = (getattr(t, name)[o] for t, o in zip((one, other), order, strict=True))
            assert a.dtype == b.dtype, name
            assert a.shape == b.shape, name
            assert a.tobytes() == b.tobytes(), name
    assert one.background.dtype == other.background.dtype
    assert one.background.tobytes() == other.background.tobytes()


def active_count(tree):
    tiles = sum(int(width) ** 3 for width in tree.tile_widths[tree.tile_active])
    return int(np.bitwise_count(tree.leaf_masks).sum()) + tiles


def world_of(header, points):
    return np.asarray(points) @ header.world_from_index[:3, :3].T + header.world_from_index[:3, 3]


def dense(tree, low, high):
    """The values in a box, both ends included."""
    low, high = np.array(low), np.array(high)
    shape = tuple(high - low + 1)
    out = np.empty(shape + tree.background.shape, tree.leaf_values.dtype)
    out[...] = tree.background
    tiles = zip(tree.tile_origins, tree.tile_widths, tree.tile_values, strict=True)
    leaves = zip(tree.leaf_origins, itertools.repeat(8), tree.leaf_values, strict=False)
    for origin, width, values in itertools.chain(tiles, leaves):
        start, stop = np.maximum(origin - low, 0), np.minimum(origin - low + width, shape)
        if (start < stop).all():
            where = tuple(map(slice, start, stop))
            if values.ndim > tree.background.ndim:
                inner = start - (origin - low)
                values = values[tuple(map(slice, inner, inner + stop - start))]
            out[where] = values
    return out


def random_grid(rng, value_type="float", **options):
    """Four leaves in three 16^3 nodes and two 32^3 nodes, and a tile on each level."""
    stored, shape = STORED[value_type]

    def values(*lead):
        if stored == "u1":
            return rng.integers(0, 2, (*lead, *shape)).astype("u1")
        return rng.integers(-99, 99, (*lead, *shape)).astype(stored)

    def leaf():
        return values(8, 8, 8), rng.random((8, 8, 8)) < 0.4

    background = 1 if value_type in ("bool", "half") else 0 if value_type == "mask" else -7
    return Grid(
        value_type=value_type,
        background=background,
        leaves={
            (8, 0, 16): leaf(),
            (0, 0, 24): leaf(),
            (-8, 4096, -8): leaf(),
            (0, 128, 0): leaf(),
        },
        tiles={
            ((16, 0, 0), 8): (values(), True),
            ((0, 256, 0), 128): (values(), True),
            ((4096, 0, -4096), 4096): (values(), True),
        },
        **options,
    )


def assert_holds(tree, grid):
    """The tree is what the grid was written from, where all values are stored."""
    dtype = tree.leaf_values.dtype
    at = {tuple(origin): n for n, origin in enumerate(tree.leaf_origins.tolist())}
    assert at.keys() == grid.leaves.keys()
    for origin, (values, active) in grid.leaves.items():
        bits = np.packbits(active.reshape(-1), bitorder="little")
        if grid.value_type == "mask":
            values = active
        elif grid.compression & ACTIVE_MASK and grid.value_type != "bool":
            lead = active.reshape(*active.shape, *(1,) * (values.ndim - 3))
            values = np.where(lead, values, np.asarray(grid.background, values.dtype))
        assert np.array_equal(tree.leaf_values[at[origin]], np.asarray(values, dtype))
        assert np.array_equal(tree.leaf_masks[at[origin]], bits)
    tiles = {
        (tuple(origin.tolist()), int(width)): (np.asarray(value).tolist(), bool(active))
        for origin, width, value, active in zip(
            tree.tile_origins, tree.tile_widths, tree.tile_values, tree.tile_active, strict=True
        )
    }
    assert tiles == {
        key: (np.asarray(value, dtype).tolist(), active)
        for key, (value, active) in grid.tiles.items()
    }


# What OpenVDB reads from the same files


@pytest.mark.parametrize(("name", "grids"), cases(CONFORMANCE))
def test_conformance_files_read_as_openvdb_reads_them(name, grids):
    volume = open_vdb(CONFORMANCE / name)
    headers = list(volume.headers)
    assert len(headers) == len(grids)
    for expected in grids:
        header = next(header for header in headers if header.name == expected["name"])
        headers.remove(header)
        assert header.map_type == expected["maptype"]
        if "ptdataidx" in expected["type"]:
            assert header.refusal == "points grid (ptdataidx32)"
            continue
        assert np.array_equal(header.background, expected["background"])
        if header.map_type == "NonlinearFrustumMap":
            assert header.refusal == "frustum transform"
            assert header.world_from_index is None
            continue
        assert header.refusal is None
        points = expected["index_to_world"]
        np.testing.assert_allclose(
            world_of(header, points["of"]), points["points"], rtol=1e-14, atol=1e-12
        )
        tree = volume.read_tree(header)
        order = by_origin(tree.leaf_origins)
        assert len(order) == expected["leaves"]
        assert str(tree.leaf_values.dtype) == expected["dtype"]
        assert list(tree.leaf_values.shape) == expected["values_shape"]
        assert sha256(tree.leaf_origins[order]) == expected["sha256_origins"]
        assert sha256(tree.leaf_values[order]) == expected["sha256_values"]
        assert sha256(tree.leaf_masks[order]) == expected["sha256_masks"]
        assert np.array_equal(tree.background, expected["background"])
        assert active_count(tree) == expected["active"]
        assert len(tree.tile_origins) == expected["tiles"]
        for tile in expected.get("tile_table", []):
            (at,) = np.flatnonzero((tree.tile_origins == tile["origin"]).all(axis=1))
            assert tree.tile_widths[at] == tile["width"]
            assert tree.tile_active[at] == tile["active"]
            assert np.array_equal(tree.tile_values[at], tile["value"])


@pytest.mark.parametrize(("name", "expected"), cases(REAL))
def test_real_files_read_as_openvdb_reads_them(name, expected):
    volume = open_vdb(REAL / name)
    assert len(volume.headers) == len(expected["grids"])
    for header, grid in zip(volume.headers, expected["grids"], strict=True):
        assert header.name == grid["name"]
        assert header.value_type == grid["type"]
        assert header.grid_class == grid["cls"]
        assert header.map_type == grid["xf"]
        world = world_of(header, [(0, 0, 0), (1, 2, 3)])
        np.testing.assert_allclose(world, [grid["w000"], grid["w123"]], rtol=1e-14, atol=1e-14)
        tree = volume.read_tree(header)
        assert np.array_equal(tree.background, grid["bg"])
        assert len(tree.leaf_origins) == grid["leafs"]
        assert active_count(tree) == grid["active"]
        values = dense(tree, *grid["bbox"])
        assert list(values.shape[:3]) == grid["dense_dims"]
        total = values.sum(axis=(0, 1, 2), dtype=np.float64)
        np.testing.assert_allclose(total, grid["dense_sum"], rtol=1e-12)
        active = np.unpackbits(tree.leaf_masks, axis=1, bitorder="little").astype(bool)
        leaves = tree.leaf_values.reshape(*active.shape, -1)[active]
        tiles = tree.tile_values[tree.tile_active].reshape(-1, leaves.shape[-1])
        stored = np.concatenate([leaves, tiles])
        order = np.lexsort(stored.T[::-1])  # vectors by their first component, as OpenVDB has it
        assert np.array_equal(stored[order[0]], np.ravel(grid["min"]))
        assert np.array_equal(stored[order[-1]], np.ravel(grid["max"]))
        if "argmax" in grid:
            where = np.array(grid["argmax"]) - grid["bbox"][0]
            assert values[tuple(where)] == values.max()


def test_declared_statistics_are_in_the_header():
    needs(REAL)
    (header,) = open_vdb(REAL / "smoke.vdb").headers
    assert header.active_voxels == 1049275
    assert header.stored == "half, active mask"
    assert header.active_box == ((1, 2, 1), (111, 223, 112))


def test_a_file_of_points_opens_and_refuses_to_be_read():
    needs(REAL)
    volume = open_vdb(REAL / "points_only.vdb")
    (header,) = volume.headers
    with pytest.raises(VolumeError, match=r"grid 'points': .*points grid \(ptdataidx32\)"):
        volume.read_tree(header)


def test_a_nanovdb_file_is_called_what_it_is():
    needs(REAL)
    with pytest.raises(VolumeError, match="NanoVDB"):
        open_vdb(REAL / "teapot_cloud.nvdb")


# Headers


def test_labels_are_unique_and_bare_where_the_name_is():
    names = ["density", "", "heat", "density", "", "flame[1]", "flame", "flame"]
    assert unique_labels(names) == [
        *("density[0]", "[0]", "heat", "density[1]", "[1]", "flame[1]", "flame[0]", "flame[2]")
    ]
    assert unique_labels([""]) == ["[0]"]


def test_grids_of_one_name_are_read_apart(tmp_path):
    rng = np.random.default_rng(1)
    grids = [random_grid(rng, name=name) for name in ("density\x1e0", "density\x1e1", "heat")]
    write_vdb(tmp_path / "a.vdb", grids)
    volume = open_vdb(tmp_path / "a.vdb")
    assert [header.name for header in volume.headers] == ["density", "density", "heat"]
    assert [header.label for header in volume.headers] == ["density[0]", "density[1]", "heat"]
    for header, grid in zip(volume.headers, grids, strict=True):
        assert_holds(volume.read_tree(header), grid)


def test_metadata_come_as_python_values(tmp_path):
    grid = Grid(
        metadata={
            "class": ("string", b"level set"),
            "on": ("bool", b"\1"),
            "frame": ("int32", struct.pack("<i", -3)),
            "file_voxel_count": ("int64", struct.pack("<q", 2**40)),
            "time": ("float", struct.pack("<f", 0.5)),
            "exact": ("double", struct.pack("<d", 0.1)),
            "file_bbox_min": ("vec3i", struct.pack("<3i", -1, -2, -3)),
            "file_bbox_max": ("vec3i", struct.pack("<3i", 1, 2, 3)),
            "up": ("vec3s", struct.pack("<3f", 0, 1, 0)),
            "matrix": ("mat4d", struct.pack("<16d", *range(16))),
            "new": ("something", b"\0\1"),
            "short": ("int32", b"\0"),
        }
    )
    write_vdb(tmp_path / "a.vdb", [grid])
    (header,) = open_vdb(tmp_path / "a.vdb").headers
    assert header.metadata == {
        "name": "density",
        "class": "level set",
        "on": True,
        "frame": -3,
        "file_voxel_count": 2**40,
        "time": 0.5,
        "exact": 0.1,
        "file_bbox_min": (-1, -2, -3),
        "file_bbox_max": (1, 2, 3),
        "up": (0.0, 1.0, 0.0),
        "matrix": ((0, 1, 2, 3), (4, 5, 6, 7), (8, 9, 10, 11), (12, 13, 14, 15)),
        "new": b"\0\1",
        "short": b"\0",
    }
    assert header.grid_class == "level set"
    assert header.active_voxels == 2**40
    assert header.active_box == ((-1, -2, -3), (1, 2, 3))


def test_the_file_says_who_wrote_it(tmp_path):
    write_vdb(tmp_path / "a.vdb", [], version=223)
    volume = open_vdb(tmp_path / "a.vdb")
    assert (volume.version, volume.library_version) == (223, (10, 0))
    assert volume.uuid == "01234567-89ab-cdef-0123-456789abcdef"
    assert volume.headers == ()


def test_opening_touches_nothing_behind_the_headers(tmp_path):
    path = tmp_path / "a.vdb"
    layouts = write_vdb(path, [random_grid(np.random.default_rng(2), name=name) for name in "ab"])
    raw = bytearray(path.read_bytes())
    for layout in layouts:
        raw[layout.root : layout.end] = b"\xff" * (layout.end - layout.root)
    path.write_bytes(raw)
    volume = open_vdb(path)
    assert [header.label for header in volume.headers] == ["a", "b"]
    assert all(header.background == -7 for header in volume.headers)
    for header in volume.headers:
        with pytest.raises(VolumeError, match=f"a.vdb: grid '{header.label}': at byte"):
            volume.read_tree(header)


def test_only_the_grid_that_was_asked_for_is_read(tmp_path):
    path = tmp_path / "a.vdb"
    grids = [random_grid(np.random.default_rng(3), name=name, compression=BLOSC) for name in "abc"]
    layouts = write_vdb(path, grids)
    raw = bytearray(path.read_bytes())
    raw[layouts[1].root : layouts[1].end] = b"\xff" * (layouts[1].end - layouts[1].root)
    path.write_bytes(raw)
    volume = open_vdb(path)
    for at in (0, 2):
        assert_holds(volume.read_tree(volume.headers[at]), grids[at])
    with pytest.raises(VolumeError, match="grid 'b'"):
        volume.read_tree(volume.headers[1])


@pytest.mark.parametrize(
    ("map_type", "numbers", "world"),
    [
        ("UniformScaleMap", (2, 2, 2, *[0] * 12), (2, 4, 6)),
        ("ScaleMap", (2, -3, 4, *[0] * 12), (2, -6, 12)),
        ("TranslationMap", (5, 6, 7), (6, 8, 10)),
        ("ScaleTranslateMap", (5, 6, 7, 2, 3, 4, *[0] * 12), (7, 12, 19)),
        ("UniformScaleTranslateMap", (5, 6, 7, 2, 2, 2, *[0] * 12), (7, 10, 13)),
        ("AffineMap", (0, 1, 0, 0, -1, 0, 0, 0, 1, 0, 2, 0, 10, 20, 30, 1), (11, 21, 36)),
        ("UnitaryMap", (0, 1, 0, 0, -1, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1), (-2, 1, 3)),
    ],
)
def test_linear_transforms_carry_column_vectors(tmp_path, map_type, numbers, world):
    write_vdb(tmp_path / "a.vdb", [Grid(map_type=map_type, map_numbers=numbers)])
    (header,) = open_vdb(tmp_path / "a.vdb").headers
    assert np.array_equal(header.world_from_index @ (1, 2, 3, 1), (*world, 1))


@pytest.mark.parametrize(
    ("changes", "refusal"),
    [
        ({"type_name": "Tree_string_5_4_3"}, "values of type string"),
        ({"type_name": "Tree_float_4_3_2"}, "tree of configuration 4_3_2"),
        ({"type_name": "Tree_ptidx32_5_4_3"}, r"points grid \(ptidx32\)"),
        ({"type_name": "Something"}, "grid of type 'Something'"),
        ({"map_type": "CurvedMap"}, "transform of type 'CurvedMap'"),
        ({"map_numbers": (0.0,) * 15}, "transform without an inverse"),
        ({"map_numbers": (np.nan,) * 15}, "transform with NaN or Inf"),
        (
            {"map_type": "AffineMap", "map_numbers": (1.0, 0.0, 0.0, 0.5) * 4},
            "transform with a perspective",
        ),
        ({"parent": "missing"}, "instance of 'missing'"),
        ({"parent": "odd"}, "instance of 'odd', which has no tree"),
    ],
)
def test_a_grid_that_cannot_be_read_is_named_and_the_others_are_read(tmp_path, changes, refusal):
    good = random_grid(np.random.default_rng(4))
    write_vdb(tmp_path / "a.vdb", [Grid(name="odd", **changes), good])
    volume = open_vdb(tmp_path / "a.vdb")
    assert_holds(volume.read_tree(volume.headers[1]), good)
    with pytest.raises(VolumeError, match=f"grid 'odd': not supported: {refusal}"):
        volume.read_tree(volume.headers[0])


def test_an_instance_has_its_parents_voxels_under_its_own_transform(tmp_path):
    parent = random_grid(np.random.default_rng(5), name="a")
    instance = Grid(name="b", parent="a", map_type="TranslationMap", map_numbers=(1, 2, 3))
    for offsets in (True, False):
        write_vdb(tmp_path / "a.vdb", [instance, parent], offsets=offsets)
        volume = open_vdb(tmp_path / "a.vdb")
        assert_holds(volume.read_tree(volume.headers[0]), parent)
        assert volume.headers[0].world_from_index[:3, 3].tolist() == [1, 2, 3]
        assert volume.headers[1].world_from_index[:3, 3].tolist() == [0, 0, 0]


# Trees


@pytest.mark.parametrize("offsets", [True, False])
@pytest.mark.parametrize("compression", [0, ZIP, BLOSC, ACTIVE_MASK, ZIP | 2, BLOSC | 2])
@pytest.mark.parametrize("value_type", STORED)
def test_every_type_and_compression_reads_back(tmp_path, value_type, compression, offsets):
    rng = np.random.default_rng(6)
    grids = [
        random_grid(rng, value_type, name="a", compression=compression),
        random_grid(rng, value_type, name="b", compression=compression, half=True),
    ]
    write_vdb(tmp_path / "a.vdb", grids, offsets=offsets)
    volume = open_vdb(tmp_path / "a.vdb")
    for header, grid in zip(volume.headers, grids, strict=True):
        tree = volume.read_tree(header)
        assert_holds(tree, grid)
        stored = np.dtype(STORED[value_type][0])
        assert tree.leaf_values.dtype == (np.float32 if value_type == "half" else stored)


@pytest.mark.parametrize("zipped", [False, True])
@pytest.mark.parametrize("version", [220, 221])
@pytest.mark.parametrize("value_type", ["float", "vec3s", "bool", "int64", "mask"])
def test_files_from_before_block_modes_read_back(tmp_path, version, zipped, value_type):
    rng = np.random.default_rng(7)
    grids = [
        random_grid(rng, value_type, name="a"),
        random_grid(rng, value_type, name="b", half=True, extra_buffers=2),
    ]
    for offsets in (True, False):
        write_vdb(tmp_path / "a.vdb", grids, version=version, zipped=zipped, offsets=offsets)
        volume = open_vdb(tmp_path / "a.vdb")
        for header, grid in zip(volume.headers, grids, strict=True):
            assert_holds(volume.read_tree(header), grid)


@pytest.mark.parametrize("half", [False, True])
@pytest.mark.parametrize("compression", [0, ZIP, BLOSC, ZIP | ACTIVE_MASK, BLOSC | ACTIVE_MASK])
def test_parts_of_one_leaf_and_threads_read_what_one_part_does(
    tmp_path, monkeypatch, compression, half
):
    path = tmp_path / "a.vdb"
    grid = random_grid(np.random.default_rng(9), "float", compression=compression, half=half)
    first = next(iter(grid.leaves))
    grid.leaves[first] = (grid.leaves[first][0], np.ones((8, 8, 8), bool))  # full beside others
    write_vdb(path, [grid])
    volume = open_vdb(path)
    whole = volume.read_tree(volume.headers[0])
    assert_holds(whole, grid)
    monkeypatch.setattr(vdb_tree, "_LEAVES_AT_ONCE", 1)
    assert_same_trees(whole, volume.read_tree(volume.headers[0]))
    monkeypatch.setattr(BlockCodec, "locate_leaves", lambda *_: None)
    assert_same_trees(whole, volume.read_tree(volume.headers[0]))


def test_work_in_threads_comes_back_in_order_and_its_first_error_is_raised():
    assert list(in_threads(lambda n: n * n, range(100))) == [n * n for n in range(100)]
    with pytest.raises(ZeroDivisionError):
        list(in_threads(lambda n: 1 // (n - 50), range(100)))


@pytest.mark.parametrize("version", [220, 221, 222, 223, 224])
@pytest.mark.parametrize("value_type", ["float", "vec3s", "bool"])
def test_openvdb_reads_the_files_of_the_test_writer_alike(tmp_path, version, value_type):
    try:
        find_interpreter()
    except VolumeError as error:
        pytest.skip(str(error))
    path = tmp_path / "a.vdb"
    rng = np.random.default_rng(8)
    grids = [
        random_grid(rng, value_type, name="a", compression=ACTIVE_MASK),
        random_grid(rng, value_type, name="b", half=value_type != "bool"),
    ]
    write_vdb(path, grids, version=version, zipped=True)
    ours, theirs = open_vdb(path), open_openvdb(path)
    for one, other in zip(ours.headers, theirs.headers, strict=True):
        assert one.label == other.label
        assert_same_trees(ours.read_tree(one), theirs.read_tree(other))


def test_progress_ends_with_all_leaves(tmp_path):
    write_vdb(tmp_path / "a.vdb", [random_grid(np.random.default_rng(9))])
    volume = open_vdb(tmp_path / "a.vdb")
    steps = []
    volume.read_tree(volume.headers[0], lambda done, total: steps.append((done, total)))
    assert steps[-1] == (4, 4)


# Files that lie


def malformed():
    found = sorted(MALFORMED.glob("*.vdb"))
    skip = pytest.mark.skip(reason="no malformed volumes beside the checkout")
    return [pytest.param(f, id=f.name) for f in found] or [pytest.param(None, marks=skip)]


@pytest.mark.parametrize("path", malformed())
def test_malformed_files_are_refused_or_empty_quickly_and_in_little_memory(path):
    tracemalloc.start()
    started = time.perf_counter()
    try:
        volume = open_vdb(path)
        for header in volume.headers:
            tree = volume.read_tree(header)
            assert len(tree.leaf_origins) == len(tree.tile_origins) == 0
    except VolumeError as error:
        assert "truncated" in path.name
        assert "at byte" in str(error)
    seconds = time.perf_counter() - started
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert seconds < 2
    assert peak < 4e6


@pytest.mark.parametrize("raw", [b"", b"short", b"NOT A VDB FILE" * 20, b"\0" * 200])
def test_what_is_no_openvdb_file_is_refused(tmp_path, raw):
    path = tmp_path / "a.vdb"
    path.write_bytes(raw)
    with pytest.raises(VolumeError, match=r"a\.vdb"):
        open_vdb(path)


def test_a_missing_file_and_a_folder_are_refused(tmp_path):
    with pytest.raises(VolumeError, match=r"no\.vdb: No such file"):
        open_vdb(tmp_path / "no.vdb")
    with pytest.raises(VolumeError, match="not a file"):
        open_vdb(tmp_path)


@pytest.mark.parametrize("version", [219, 226, 2**32 - 1])
def test_other_versions_are_refused_by_number(tmp_path, version):
    path = tmp_path / "a.vdb"
    write_vdb(path, [])
    raw = bytearray(path.read_bytes())
    struct.pack_into("<I", raw, 8, version)
    path.write_bytes(raw)
    with pytest.raises(VolumeError, match=f"version {version}"):
        open_vdb(path)


def test_a_file_cut_anywhere_is_refused(tmp_path):
    path, cut = tmp_path / "a.vdb", tmp_path / "cut.vdb"
    write_vdb(path, [random_grid(np.random.default_rng(10), compression=BLOSC | ACTIVE_MASK)])
    raw = path.read_bytes()
    for size in sorted({*range(0, len(raw), 997), *range(400), len(raw) - 1}):
        cut.write_bytes(raw[:size])
        with pytest.raises(VolumeError):
            open_vdb(cut)


def test_a_stream_cut_in_its_leaves_says_where(tmp_path):
    path = tmp_path / "a.vdb"
    (layout,) = write_vdb(path, [random_grid(np.random.default_rng(11))], offsets=False)
    path.write_bytes(path.read_bytes()[: layout.end - 100])
    volume = open_vdb(path)
    with pytest.raises(VolumeError, match=r"a\.vdb: grid 'density': at byte \d+: .* left"):
        volume.read_tree(volume.headers[0])


@pytest.mark.parametrize("compression", [ZIP, BLOSC])
@pytest.mark.parametrize("size", [1, 2047, 2049, 10**7])
def test_a_block_of_another_size_than_its_node_is_refused(tmp_path, compression, size):
    path = tmp_path / "a.vdb"
    good = np.zeros((8, 8, 8), np.float32), np.ones((8, 8, 8), bool)
    grid = Grid(leaves={(0, 0, 0): good}, compression=compression)
    (layout,) = write_vdb(path, [grid])
    raw = path.read_bytes()[: layout.blocks]
    packed = zlib.compress(bytes(size)) if compression == ZIP else blosc.compress(bytes(size), 1)
    raw += b"\xff" * 64 + b"\6" + struct.pack("<q", len(packed)) + packed
    at = raw.index(struct.pack("<3q", layout.begin, layout.blocks, layout.end))
    raw = raw[: at + 16] + struct.pack("<q", len(raw)) + raw[at + 24 :]
    path.write_bytes(raw)
    volume = open_vdb(path)
    with pytest.raises(VolumeError, match="at byte"):
        volume.read_tree(volume.headers[0])


def test_counts_beyond_the_file_allocate_nothing(tmp_path):
    path = tmp_path / "a.vdb"
    (layout,) = write_vdb(path, [Grid()])
    raw = bytearray(path.read_bytes())
    for tiles, children in ((2**32 - 1, 0), (0, 2**32 - 1), (2**31, 2**31)):
        struct.pack_into("<II", raw, layout.root, tiles, children)
        path.write_bytes(raw)
        volume = open_vdb(path)
        tracemalloc.start()
        with pytest.raises(VolumeError, match="bytes needed"):
            volume.read_tree(volume.headers[0])
        assert tracemalloc.get_traced_memory()[1] < 1e6
        tracemalloc.stop()


def read_all(path):
    """Read a file wholly; whatever it holds, only VolumeError may come of it."""
    try:
        volume = open_vdb(path)
    except VolumeError as error:
        assert "\n" not in str(error)
        return
    for header in volume.headers:
        try:
            assert isinstance(volume.read_tree(header), Tree)
        except VolumeError as error:
            assert str(error).startswith(f"{path}: grid '")


FUZZED = [
    (version, value_type, compression, half, offsets)
    for version, compression in ((221, 0), (224, 0), (224, ZIP | ACTIVE_MASK), (224, BLOSC | 2))
    for value_type, half in (("float", False), ("vec3s", True), ("bool", False))
    for offsets in (True, False)
]


@pytest.fixture(scope="module")
def fuzzed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fuzzed")
    raws = []
    for version, value_type, compression, half, offsets in FUZZED:
        rng = np.random.default_rng(12)
        grids = [
            random_grid(rng, value_type, name=name, half=half, compression=compression)
            for name in "ab"
        ]
        write_vdb(folder / "a.vdb", grids, version=version, offsets=offsets, zipped=True)
        raws.append((folder / "a.vdb").read_bytes())
    return folder / "mutated.vdb", raws


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_mutated_files_raise_volume_errors_or_give_trees(fuzzed, data):
    path, raws = fuzzed
    raw = bytearray(data.draw(st.sampled_from(raws)))
    for _ in range(data.draw(st.integers(1, 6))):
        # headers are short: half of the blows must land there
        last = data.draw(st.sampled_from([400, len(raw)])) - 8
        at = data.draw(st.integers(0, last))
        blow = data.draw(
            st.one_of(
                st.binary(min_size=1, max_size=8),
                st.sampled_from([b"\xff" * 8, b"\0" * 8, b"\xff\xff\xff\x7f", b"\0\0\0\x80"]),
            )
        )
        raw[at : at + len(blow)] = blow
    if data.draw(st.booleans()):
        del raw[data.draw(st.integers(0, len(raw))) :]
    path.write_bytes(raw)
    read_all(path)


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_bytes_behind_a_good_magic_raise_volume_errors(fuzzed, data):
    path, _ = fuzzed
    raw = struct.pack("<qI", 0x56444220, data.draw(st.integers(220, 225)))
    path.write_bytes(raw + data.draw(st.binary(max_size=300)))
    read_all(path)
