"""Level sets as fog: OpenVDB's own conversion, recorded by tests/data/level_sets.cc."""

from pathlib import Path

import numpy as np
import pytest
from commandline import VOLUMES, volcli, write_grid
from scenes import tree_of

from volcli.grids import load_density, open_volume
from volcli.grids.level_set import fog_of_level_set
from volcli.grids.values import settle_nonfinite
from volcli.images import read_exr

DATA = Path(__file__).parent / "data"
NAMES = ["tiled", "small", "deep", "double", "outside"]


def tree(path, label):
    volume = open_volume(path)
    header = next(h for h in volume.headers if h.label == label)
    return settle_nonfinite(volume.read_tree(header), "a", "error")[0]


def in_order(tree):
    """Leaves and tiles by their origins."""
    leaf, tile = np.lexsort(tree.leaf_origins.T), np.lexsort(tree.tile_origins.T)
    return (
        tree.leaf_origins[leaf],
        tree.leaf_values[leaf],
        tree.leaf_masks[leaf],
        tree.tile_origins[tile],
        tree.tile_widths[tile],
        tree.tile_values[tile],
        tree.tile_active[tile],
    )


@pytest.mark.parametrize("label", NAMES)
def test_a_level_set_becomes_the_fog_that_openvdb_makes_of_it(label):
    """To the bit in float; a double level set is rounded to float before it is converted."""
    fog = fog_of_level_set(tree(DATA / "level_sets.vdb", label))
    openvdb = tree(DATA / "level_sets_as_fog.vdb", label)
    assert fog.background == openvdb.background == 0
    for mine, theirs in zip(in_order(fog), in_order(openvdb), strict=True):
        if label == "double" and mine.dtype == np.float32:
            np.testing.assert_allclose(mine, theirs, rtol=3e-7, atol=1e-7)
        else:
            np.testing.assert_array_equal(mine, theirs)


def test_the_recorded_level_sets_have_the_cases_that_differ():
    trees = {name: tree(DATA / "level_sets.vdb", name) for name in NAMES}
    assert (trees["tiled"].tile_widths == 8).any()
    assert all(len(trees[name].tile_widths) == 0 for name in ("small", "deep", "outside"))
    assert trees["outside"].leaf_values.min() > 0


def test_a_tile_of_any_width_inside_is_fog_of_1():
    distances = np.full((8, 8, 8), -0.5, np.float32)
    tiles = [((128, 0, 0), 128, -3.0, False), ((4096, 0, 0), 4096, 3.0, True)]
    fog = fog_of_level_set(tree_of(distances, background=3.0, tiles=tiles))
    assert fog.tile_values.tolist() == [1.0]
    assert fog.tile_widths.tolist() == [128]
    assert fog.leaf_values.max() == 1.0, "no tile of 8 voxels: the deepest voxel is 1"


def test_a_voxel_deeper_than_the_band_is_denser_than_1_as_in_openvdb():
    distances = np.full((8, 8, 8), -4.0, np.float32)
    fog = fog_of_level_set(tree_of(distances, background=2.0, tiles=[((8, 0, 0), 8, -2.0, False)]))
    assert fog.leaf_values.max() == 2.0


def test_the_picture_of_a_level_set_is_that_of_its_fog(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    seen = []
    for name, more in (
        ("level_sets.vdb", ["--set", "density.level_set=fog"]),
        ("level_sets_as_fog.vdb", []),
    ):
        ran = volcli(
            *("render", DATA / name, "--grid", "tiled", "-o", "a.exr", "--size", "24x18"),
            *("--density-scale", "0.2", *more),
        )
        assert ran.code == 0, ran.err
        seen.append(read_exr("a.exr")[0])
    assert seen[0]["A"].max() > 0.5
    for channel, values in seen[0].items():
        np.testing.assert_array_equal(values, seen[1][channel], err_msg=channel)


def test_a_grid_without_an_inside_is_told_to_be_no_level_set(tmp_path):
    write_grid(tmp_path / "fog.vdb")
    ran = volcli("render", tmp_path / "fog.vdb", "--explain", "--set", "density.level_set=fog")
    assert ran.code == 0, ran.err
    assert "is nowhere below 0, and so has no inside" in ran.err


def test_a_real_level_set_is_fog_inside_it():
    path = VOLUMES / "real" / "level_set_unnamed.vdb"
    if not path.exists():
        pytest.skip("the files of other programs are not here")
    volume = open_volume(path)
    distances = volume.read_tree(volume.headers[0])
    fog, notes = load_density(volume, volume.headers[0], "error", level_set=True)
    assert notes == []
    assert fog.field_range == (0.0, 1.0)
    inside = np.count_nonzero(distances.leaf_values < 0)
    interior = fog.arrays.atlas.reshape(-1, 9, 9, 9)[:, :8, :8, :8]
    assert np.count_nonzero((interior > 0) & (interior < 1)) <= inside
