"""The benchmarks' own arithmetic, and what they make of a renderer that is not there."""

import json
import subprocess
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest
from commandline import volcli
from numpy.lib.stride_tricks import sliding_window_view

from benchmarks import common, parts, peers, report, scaling, startup, workers
from volcli.grids import density_grid, load_density, open_volume
from volcli.grids.build import build
from volcli.grids.dense import tree_from_array
from volcli.kernels.traversal import segment_buffer


def test_a_line_is_found_and_how_far_measurements_lie_from_it():
    x = [1e3, 1e4, 1e6]
    line = scaling.fit(x, [5 + 2 * v for v in x])
    assert line["at_zero"] == pytest.approx(5)
    assert line["slope"] == pytest.approx(2)
    assert line["worst"] < 1e-12
    off = scaling.fit(x, [2e3, 2e4, 3e6])
    assert off["worst"] > 0.05


def test_a_line_costs_nothing_at_zero_rather_than_less_than_nothing():
    line = scaling.fit([1.0, 2.0, 3.0], [0.9, 2.1, 3.6])
    assert line["at_zero"] == 0.0
    assert line["slope"] == pytest.approx(1.1, rel=0.1)


def test_given_rays_are_those_of_volclis_camera():
    from volcli import schema
    from volcli.camera import make_camera

    eye, target = common.view_of(np.array([[0.0, 0.0, 0.0], [10.0, 20.0, 30.0]]), 30.0)
    scene = {"eye": eye, "target": target, "fov": 30.0, "size": 5}
    camera = make_camera(
        schema.Camera(eye=tuple(eye), target=tuple(target), fov=30.0, resolution=(5, 5)),
        np.zeros((2, 3)),
    )
    expected = camera.rays(slice(None), slice(None))[1]
    np.testing.assert_allclose(workers._directions(scene).T, expected, atol=1e-15)


def test_a_renderer_that_is_not_installed_is_listed_as_such(tmp_path, monkeypatch):
    scene = tmp_path / "scene.json"
    scene.write_text(json.dumps({}))
    monkeypatch.setenv("PATH", "")
    with pytest.raises(peers.GoneError, match="not installed: no vdb_render"):
        peers.Process("vdb_render", scene, tmp_path)


def test_a_renderer_that_fails_is_listed_with_its_last_words(tmp_path):
    scene = tmp_path / "scene.json"
    scene.write_text(json.dumps({"threads": 1, "vdb": str(tmp_path / "none.vdb")}))
    with pytest.raises(peers.GoneError, match=r"failed: .*no such file"):
        peers.Process("volcli", scene, tmp_path)


@pytest.fixture(scope="module")
def part(tmp_path_factory):
    return parts.parts(tmp_path_factory.mktemp("parts"))


def test_reading_and_building_alone_are_those_of_a_load(part):
    volume = open_volume(parts.SAMPLE)
    whole, _ = load_density(volume, density_grid(volume, None)[0], "error")
    tree = part["read"]()
    tiles = tree.tile_widths[tree.tile_active].astype(int) ** 3
    assert np.bitwise_count(tree.leaf_masks).sum(dtype=int) + tiles.sum() == 149_911
    np.testing.assert_array_equal(part["build"]().arrays.atlas, whole.arrays.atlas)


def test_the_walk_alone_meets_every_brick_on_its_way(part):
    assert part["traversal"]() > parts.RAYS
    rng = np.random.default_rng(1)
    blocks = np.zeros((6, 6, 6))  # of 8 voxels each; the outer ones stay empty
    blocks[1:-1, 1:-1, 1:-1] = rng.random((4, 4, 4)) < 0.2
    values = np.kron(blocks, np.ones((8, 8, 8))).astype(np.float32)
    grid = build(tree_from_array(values), SimpleNamespace(world_from_index=np.eye(4)))
    bricks = sliding_window_view(values, (9, 9, 9))[::8, ::8, ::8].any(axis=(3, 4, 5))
    eyes = rng.uniform((8, 8, -9), (40, 40, -9), (200, 3))
    expected = bricks[tuple((eyes[:, :2] // 8).astype(int).T)].sum()
    eyes -= grid.origin
    buffer, support = segment_buffer(), grid.support("linear")
    met = parts.count_segments(grid.arrays, support, eyes, (0.0, 0.0, 1.0), buffer)
    assert met == expected > 0


def test_the_cells_alone_sum_to_the_means_of_their_corners(part):
    """Along an axis through the middle of a cell density is linear."""
    atlas = part["build"]().arrays.atlas.astype(np.float64).reshape(-1, 9, 9, 9)
    corners = [
        atlas[:, x : x + 8, y : y + 8, z : z + 8] for x in (0, 1) for y in (0, 1) for z in (0, 1)
    ]
    sum_of_means = np.mean(corners, axis=0).sum()
    assert part["cell integral"]() == pytest.approx(sum_of_means, rel=1e-12)


def test_a_picture_alone_is_written(part):
    part["encode EXR"]()


def test_all_parts_are_timed(part):
    """Each once, where pytest-benchmark is installed."""
    pytest.importorskip("pytest_benchmark")
    command = [sys.executable, "-m", "pytest", "benchmarks/test_parts.py", "-q", "-n", "0"]
    done = subprocess.run(
        [*command, "--benchmark-disable"], cwd=common.RESULTS.parents[1], capture_output=True
    )
    assert f"{len(part)} passed".encode() in done.stdout, done.stdout


def test_the_parts_of_a_start_add_up_to_it(tmp_path, monkeypatch):
    def in_this_process(code, folder, *arguments):
        assert code == startup.SCRIPT
        begin = time.perf_counter()
        ran = volcli(*arguments)
        assert ran.code == 0, ran.err
        return startup.Ran(time.perf_counter() - begin, 0.0, ran.out)

    monkeypatch.setattr(startup, "start", in_this_process)
    row = startup.picture(tmp_path, "16x12")
    parts_of_it = [row[name] for name in ("start", "load", "compile", "render", "write")]
    assert sum(parts_of_it) == pytest.approx(row["written"])
    # The clock of files is coarse.
    assert all(-0.05 < seconds < row["whole"] for seconds in parts_of_it)
    assert row["written"] < row["whole"] + 0.05
    table = startup.medians([row, row, row])
    assert table["written"]["median"] == row["written"]
    assert set(table["parts"]) == {"start", "load", "compile", "render", "write"}


@pytest.mark.parametrize("page, make", [(p, m) for p, ms in report.PAGES.items() for m in ms])
def test_pages_hold_what_the_results_say(page, make):
    assert report.block(make) in page.read_text(encoding="utf-8")
