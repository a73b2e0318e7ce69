"""NumPy files as volumes: values, placement, and files that are not what they seem."""

import tracemalloc

import numpy as np
import pytest
import reference

from volcli.errors import VolumeError
from volcli.grids import density_grid, load_density, open_volume
from volcli.grids.dense import open_dense, tree_from_array
from volcli.memory import memory_limited_to


def values(shape, seed=0):
    return np.random.default_rng(seed).random(shape).astype(np.float32) + 0.1


def assert_tree_is(tree, array):
    points = np.array(list(np.ndindex(*(n + 4 for n in array.shape[:3])))) - 2
    expected = reference.of_array(array, background=np.zeros(array.shape[3:]))(points)
    np.testing.assert_array_equal(reference.of_tree(tree)(points), expected)


@pytest.mark.parametrize("shape", [(1, 1, 1), (8, 8, 8), (9, 3, 17), (7, 20, 1), (5, 9, 8, 3)])
def test_a_tree_holds_its_array_and_zeros_around_it(shape):
    assert_tree_is(tree_from_array(values(shape)), values(shape))


@pytest.mark.parametrize("dtype", [np.float16, np.float64, np.int16, np.uint8, np.bool_, ">f4"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_arrays_of_any_numbers_in_any_order_are_read(tmp_path, dtype, order):
    array = (values((9, 10, 11)) * 3).astype(dtype)
    file = tmp_path / "a.npy"
    np.save(file, np.asarray(array, order=order))
    volume = open_volume(file)
    (header,) = volume.headers
    assert header.refusal is None
    assert_tree_is(volume.read_tree(header), array.astype(np.float32))


def test_every_point_of_the_array_in_a_kept_leaf_is_active_and_none_beyond():
    tree = tree_from_array(values((9, 8, 3)))
    bits = np.unpackbits(tree.leaf_masks, axis=1, bitorder="little")
    assert bits.sum() == 9 * 8 * 3


def test_leaves_of_zeros_are_left_out():
    array = np.zeros((64, 64, 64), np.float32)
    array[3, 3, 3] = array[60, 5, 60] = 1
    tree = tree_from_array(array)
    assert sorted(map(tuple, tree.leaf_origins.tolist())) == [(0, 0, 0), (56, 0, 56)]
    assert len(tree_from_array(np.zeros((20, 20, 20))).leaf_origins) == 0


def test_an_array_of_zeros_is_an_empty_grid(tmp_path):
    np.save(tmp_path / "a.npy", np.zeros((4, 4, 4)))
    volume = open_volume(tmp_path / "a.npy")
    grid, notes = load_density(volume, volume.headers[0], "error")
    assert grid.is_empty
    assert any("empty" in note for note in notes)


def test_an_npy_file_is_one_density_of_voxel_size_1_at_the_origin(tmp_path):
    np.save(tmp_path / "cloud.npy", values((3, 4, 5)))
    volume = open_volume(tmp_path / "cloud.npy")
    header, notes = density_grid(volume, None)
    assert header.name == "density"
    assert notes == []
    assert header.active_box == ((0, 0, 0), (2, 3, 4))
    np.testing.assert_array_equal(header.world_from_index, np.eye(4))


def test_an_npz_file_holds_named_grids_and_their_place(tmp_path):
    file = tmp_path / "a.npz"
    np.savez(
        file,
        density=values((3, 4, 5)),
        Cd=values((3, 4, 5, 3)),
        voxel_size=[0.5, 2.0, -1.0],
        origin=[1.0, 2.0, 3.0],
    )
    volume = open_volume(file)
    assert [(h.name, h.is_vector) for h in volume.headers] == [("density", False), ("Cd", True)]
    expected = np.array([[0.5, 0, 0, 1], [0, 2, 0, 2], [0, 0, -1, 3], [0, 0, 0, 1]])
    for header in volume.headers:
        np.testing.assert_array_equal(header.world_from_index, expected)
    assert_tree_is(volume.read_tree(volume.headers[1]), values((3, 4, 5, 3)))


def test_one_voxel_size_holds_for_all_axes(tmp_path):
    np.savez_compressed(tmp_path / "a.npz", density=values((2, 2, 2)), voxel_size=0.25)
    (header,) = open_volume(tmp_path / "a.npz").headers
    np.testing.assert_array_equal(header.world_from_index, np.diag([0.25, 0.25, 0.25, 1]))


@pytest.mark.parametrize(
    "placed",
    [
        {"voxel_size": 0.0},
        {"voxel_size": [1.0, 0.0, 1.0]},
        {"voxel_size": np.nan},
        {"voxel_size": [1.0, 2.0]},
        {"origin": [np.inf, 0.0, 0.0]},
        {"origin": [1.0, 2.0, 3.0, 4.0]},
        {"voxel_size": "large"},
    ],
    ids=str,
)
def test_a_place_that_makes_no_lattice_is_refused(tmp_path, placed):
    np.savez(tmp_path / "a.npz", density=values((2, 2, 2)), **placed)
    with pytest.raises(VolumeError, match="voxel_size"):
        open_volume(tmp_path / "a.npz")


@pytest.mark.parametrize(
    "array",
    [
        np.ones((3, 3)),
        np.ones((3, 3, 3, 2)),
        np.float64(1.0),
        np.ones((0, 3, 3)),
        np.ones((3, 3, 3), complex),
        np.full((3, 3, 3), "a"),
    ],
    ids=lambda a: f"{a.dtype}{a.shape}",
)
def test_an_array_that_is_no_grid_says_so_when_it_is_asked_for(tmp_path, array):
    np.savez(tmp_path / "a.npz", density=array, other=values((2, 2, 2)))
    volume = open_volume(tmp_path / "a.npz")
    with pytest.raises(VolumeError, match=r"a grid is|is empty"):
        volume.read_tree(volume.headers[0])
    volume.read_tree(volume.headers[1])


class Trap:
    """Would make a folder if it were unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        import os

        return os.mkdir, (str(self.path),)


@pytest.mark.parametrize("kind", ["npy", "npz"])
def test_pickled_objects_are_never_read(tmp_path, kind):
    trapped = np.array([[[Trap(tmp_path / "sprung")]]], object)
    file = tmp_path / f"a.{kind}"
    if kind == "npy":
        np.save(file, trapped, allow_pickle=True)
    else:
        np.savez(file, density=trapped)
    with pytest.raises(VolumeError):
        volume = open_volume(file)
        volume.read_tree(volume.headers[0])
    assert not (tmp_path / "sprung").exists()


@pytest.mark.parametrize("keep", [3, 20, 100, 300])
def test_files_cut_short_are_refused(tmp_path, keep):
    np.save(tmp_path / "a.npy", values((5, 5, 5)))
    np.savez(tmp_path / "a.npz", density=values((5, 5, 5)))
    for file in (tmp_path / "a.npy", tmp_path / "a.npz"):
        file.write_bytes(file.read_bytes()[:keep])
        with pytest.raises(VolumeError, match=r"a\.np"):
            volume = open_volume(file)
            volume.read_tree(volume.headers[0])


def test_files_of_other_things_are_refused(tmp_path):
    for name in ("a.npy", "a.npz"):
        (tmp_path / name).write_text("density = 1\n" * 20)
        with pytest.raises(VolumeError, match="not a readable NumPy file"):
            open_dense(tmp_path / name)


def test_an_archive_without_arrays_is_refused(tmp_path):
    np.savez(tmp_path / "a.npz", voxel_size=1.0)
    with pytest.raises(VolumeError, match="holds no array"):
        open_volume(tmp_path / "a.npz")


def test_a_header_that_lies_about_the_shape_allocates_nothing(tmp_path):
    file = tmp_path / "a.npy"
    with file.open("wb") as out:
        header = {"descr": "<f4", "fortran_order": False, "shape": (100_000,) * 3}
        np.lib.format.write_array_header_1_0(out, header)
        out.write(b"\0" * 64)
    tracemalloc.start()
    with pytest.raises(VolumeError, match="is not in the 64 bytes of the file"):
        open_volume(file)
    assert tracemalloc.get_traced_memory()[1] < 1e6
    tracemalloc.stop()


@pytest.mark.parametrize("name", ["density", "voxel_size"])
def test_a_small_archive_of_a_large_array_is_refused_before_it_is_unpacked(tmp_path, name):
    """What zip makes of zeros: a thousandth."""
    arrays = {"density": values((2, 2, 2)), name: np.zeros((400, 400, 100), np.float32)}
    np.savez_compressed(tmp_path / "a.npz", **arrays)
    assert (tmp_path / "a.npz").stat().st_size < 200_000
    tracemalloc.start()
    with memory_limited_to(1), pytest.raises(VolumeError, match=r"need about|one number or three"):
        volume = open_volume(tmp_path / "a.npz")
        volume.read_tree(volume.headers[0])
    assert tracemalloc.get_traced_memory()[1] < 4e6
    tracemalloc.stop()


def test_the_ending_of_a_name_may_be_in_capitals(tmp_path):
    np.save(tmp_path / "a.npy", values((2, 2, 2)))
    (tmp_path / "a.npy").rename(tmp_path / "A.NPY")
    volume = open_volume(tmp_path / "A.NPY")
    assert_tree_is(volume.read_tree(volume.headers[0]), values((2, 2, 2)))
