"""Dense grids: ``.npy`` and ``.npz`` files as volumes.

A ``.npy`` file is one grid of voxel size 1 at the origin. A ``.npz`` file holds named grids, and
optionally ``voxel_size`` (one number or three) and ``origin`` (three numbers: the world position of
the first lattice point), which hold for all of them. Arrays are indexed [x, y, z] or, for colour,
[x, y, z, channel]. Outside an array a grid is 0.

Pickled objects are never read. What a header says of an array's size is held against what the file
or the archive holds, and against the memory there is, before anything is allocated: a megabyte of
zip can be a gigabyte of zeros.
"""

from __future__ import annotations

import math
import struct
import tokenize
import zipfile
import zlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from volcli.errors import VolumeError
from volcli.grids.census import Census, census_of
from volcli.grids.tree import LEAF_WIDTH, GridHeader, Progress, Tree, unique_labels
from volcli.memory import no_room, reserve

_PLACEMENT = ("voxel_size", "origin")
_MAX_HEADER = 1 << 16
_MOST_NUMBERS = 3  # of a voxel size or an origin

_DAMAGE = (
    OSError,
    ValueError,
    KeyError,
    EOFError,
    SyntaxError,
    RuntimeError,  # encrypted; NotImplementedError, a method of compression
    struct.error,
    tokenize.TokenError,
    zipfile.BadZipFile,
    zlib.error,
)
"""What NumPy, zipfile and zlib raise on a file that is damaged."""


@dataclass(frozen=True)
class DenseVolume:
    """An opened ``.npy`` or ``.npz`` file; see `volcli.grids.tree.Volume`."""

    path: Path
    headers: tuple[GridHeader, ...]

    def read_tree(self, header: GridHeader, progress: Progress | None = None) -> Tree:
        """Read one array and cut it into leaves; leaves of zeros alone are left out."""
        if header.refusal:
            raise VolumeError(f"{self.path}: grid '{header.label}': {header.refusal}")
        try:
            reserve(self.census(header).tree_bytes, "its values")
            return tree_from_array(_load(self.path, header.name))
        except MemoryError as error:
            raise no_room(f"{self.path}: grid '{header.label}'", error) from error

    def census(self, header: GridHeader) -> Census:
        """How much a grid holds: of a ``.npy`` file, which is mapped, without its leaves of zeros
        alone; of an archive, whose values are packed, at most.

        Raises
        ------
        VolumeError
            As `read_tree`.
        """
        if header.refusal or header.active_box is None:
            raise VolumeError(f"{self.path}: grid '{header.label}': {header.refusal}")
        is_npy = _is_npy(self.path)
        counts = [end // LEAF_WIDTH + 1 for end in header.active_box[1]]
        leaves, bricks = math.prod(counts), math.prod(count + 1 for count in counts)
        if is_npy:
            used = _used_leaves(_load(self.path, header.name))
            leaves, bricks = int(used.sum()), _reached(used)
        dtype = np.dtype(header.value_type.removeprefix("vec3"))
        if dtype == np.bool_ or dtype == np.float16:
            dtype = np.dtype(np.float32)
        counted = census_of(
            leaves=leaves,
            bricks=bricks,
            blocks=math.prod(count // 16 + 2 for count in counts),
            roots=math.prod(count // 512 + 2 for count in counts),
            tiles=0,
            dtype=np.dtype((dtype, 3)) if header.is_vector else dtype,
            copies=1 if is_npy else 2,
            mapped_bytes=header.file_bytes or 0 if is_npy else 0,
        )
        return replace(counted, stays_mapped=False)


def open_dense(path: Path) -> DenseVolume:
    """Open a ``.npy`` or ``.npz`` file; reads shapes and types, not the values.

    Raises
    ------
    VolumeError
        If the file is damaged, holds no array, or its voxel size or origin make no sense.
    """
    try:
        if _is_npy(path):
            with path.open("rb") as file:
                shape, dtype = _array_header(file)
                _check_size(shape, dtype, path.stat().st_size - file.tell(), "file")
                shapes = {"density": (shape, dtype, path.stat().st_size)}
            world = np.eye(4)
        else:
            with zipfile.ZipFile(path) as archive:
                names = [n.removesuffix(".npy") for n in archive.namelist() if n.endswith(".npy")]
                every = {name: _described(archive, name) for name in names}
            shapes = {name: every[name] for name in names if name not in _PLACEMENT}
            for name in set(every) - set(shapes):
                if math.prod(every[name][0]) > _MOST_NUMBERS:
                    raise _not_a_place(path, f"{name} is of shape {every[name][0]}")
            placed = {name: _load(path, name) for name in _PLACEMENT if name in names}
            world = _placement(path, placed)
    except _DAMAGE as error:
        raise VolumeError(f"{path}: not a readable NumPy file: {_reason(error)}") from error
    if not shapes:
        raise VolumeError(f"{path}: holds no array")
    labels = unique_labels(list(shapes))
    return DenseVolume(
        path,
        tuple(
            _header(name, label, *described, world)
            for label, (name, described) in zip(labels, shapes.items(), strict=True)
        ),
    )


def tree_from_array(values: NDArray[Any]) -> Tree:
    """Cut an array (nx, ny, nz) or (nx, ny, nz, 3) into leaves; its first value is at (0, 0, 0).

    All of the array's lattice points are active. Leaves of zeros alone are left out.
    """
    if values.dtype == np.bool_ or values.dtype == np.float16:
        values = values.astype(np.float32)
    channels = values.shape[3:]
    counts = [-(-n // LEAF_WIDTH) for n in values.shape[:3]]
    # One slab of leaves along x at a time: the padded copy is never larger than a slab.
    origins, leaves, masks = [], [], []
    for bx in range(counts[0]):
        part = values[bx * LEAF_WIDTH : (bx + 1) * LEAF_WIDTH]
        slab = np.zeros(
            (LEAF_WIDTH, *(c * LEAF_WIDTH for c in counts[1:]), *channels), values.dtype
        )
        inside = np.zeros(slab.shape[:3], bool)
        slab[: part.shape[0], : part.shape[1], : part.shape[2]] = part
        inside[: part.shape[0], : part.shape[1], : part.shape[2]] = True
        blocks = _blocks(slab, counts[1], counts[2])
        used = (blocks != 0).reshape(len(blocks), -1).any(axis=1)
        at = np.argwhere(used.reshape(counts[1:]))
        origins.append(np.column_stack([np.full(len(at), bx), at]) * LEAF_WIDTH)
        leaves.append(blocks[used])
        bits = _blocks(inside, counts[1], counts[2])[used].reshape(-1, LEAF_WIDTH**3)
        masks.append(np.packbits(bits, axis=1, bitorder="little"))
    return Tree(
        background=np.zeros(channels, values.dtype),
        leaf_origins=np.concatenate(origins).astype(np.int32),
        leaf_values=np.concatenate(leaves),
        leaf_masks=np.concatenate(masks),
        tile_origins=np.empty((0, 3), np.int32),
        tile_widths=np.empty(0, np.int32),
        tile_values=np.empty((0, *channels), values.dtype),
        tile_active=np.empty(0, bool),
    )


def _used_leaves(values: NDArray[Any]) -> NDArray[np.bool_]:
    """(bx, by, bz): which leaves of an array hold another value than 0."""
    w = LEAF_WIDTH
    counts = [-(-n // w) for n in values.shape[:3]]
    used = np.zeros(counts, bool)
    for bx in range(counts[0]):  # one slab at a time, as `tree_from_array`
        columns = np.zeros((counts[1] * w, counts[2] * w), bool)
        nonzero = (values[bx * w : (bx + 1) * w] != 0).any(axis=0)
        columns[: values.shape[1], : values.shape[2]] = nonzero.reshape(*values.shape[1:3], -1).any(
            axis=-1
        )
        used[bx] = columns.reshape(counts[1], w, counts[2], w).any(axis=(1, 3))
    return used


def _reached(used: NDArray[np.bool_]) -> int:
    """How many bricks read a leaf that is used: its own, and those below it along each axis."""
    reached = np.pad(used, ((1, 0),) * 3)
    for axis in range(3):
        reached |= np.roll(reached, -1, axis)  # what comes round is the empty layer
    return int(reached.sum())


def _blocks(slab: NDArray[Any], ny: int, nz: int) -> NDArray[Any]:
    """(8, 8 ny, 8 nz, ...) to (ny nz, 8, 8, 8, ...)."""
    w = LEAF_WIDTH
    split = slab.reshape(w, ny, w, nz, w, *slab.shape[3:])
    order = (1, 3, 0, 2, 4, *range(5, split.ndim))
    return np.ascontiguousarray(split.transpose(order)).reshape(ny * nz, w, w, w, *slab.shape[3:])


def _array_header(file: Any) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Shape and dtype out of the header of a ``.npy`` stream."""
    version = np.lib.format.read_magic(file)
    read = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }
    if version not in read:
        raise ValueError(f"unknown .npy version {version}")
    shape, _, dtype = read[version](file, max_header_size=_MAX_HEADER)
    return shape, dtype


def _described(archive: zipfile.ZipFile, name: str) -> tuple[tuple[int, ...], np.dtype[Any], int]:
    """Shape and dtype of an array of an archive, and what it takes there."""
    info = archive.getinfo(name + ".npy")
    with archive.open(info) as file:
        shape, dtype = _array_header(file)
        _check_size(shape, dtype, info.file_size - file.tell(), "archive")
    return shape, dtype, info.compress_size


def _check_size(shape: tuple[int, ...], dtype: np.dtype[Any], size: int, where: str) -> None:
    """Refuse an array that is said to be larger than ``size``, the bytes that there are of it."""
    if min(shape, default=1) < 0 or (
        math.prod(shape) * dtype.itemsize > size and not dtype.hasobject
    ):
        raise ValueError(
            f"an array of shape {shape} and {dtype} is not in the {size} bytes of the {where}"
        )


def _load(path: Path, name: str) -> NDArray[Any]:
    try:
        loaded = np.load(path, allow_pickle=False, mmap_mode="r" if _is_npy(path) else None)
        return loaded if _is_npy(path) else loaded[name]
    except _DAMAGE as error:
        raise VolumeError(f"{path}: array '{name}' cannot be read: {_reason(error)}") from error


def _reason(error: Exception) -> str:
    return str(error).strip().split("\n")[0] or "it ends too early"


def _is_npy(path: Path) -> bool:
    return path.suffix.lower() == ".npy"


def _placement(path: Path, placed: dict[str, NDArray[Any]]) -> NDArray[np.float64]:
    """(4, 4) world_from_index of a voxel size and an origin."""
    world = np.eye(4)
    try:
        size = np.broadcast_to(np.asarray(placed.get("voxel_size", 1.0), np.float64), 3)
        origin = np.broadcast_to(np.asarray(placed.get("origin", 0.0), np.float64), 3)
    except ValueError as error:
        raise _not_a_place(path, str(error)) from error
    if not (np.isfinite(size).all() and (size != 0).all() and np.isfinite(origin).all()):
        raise VolumeError(f"{path}: voxel_size {size} and origin {origin} make no lattice")
    world[:3, :3] = np.diag(size)
    world[:3, 3] = origin
    return world


def _not_a_place(path: Path, reason: str) -> VolumeError:
    return VolumeError(f"{path}: voxel_size must be one number or three, origin three: {reason}")


def _header(
    name: str,
    label: str,
    shape: tuple[int, ...],
    dtype: np.dtype[Any],
    file_bytes: int,
    world: NDArray[np.float64],
) -> GridHeader:
    vector = len(shape) == 4 and shape[3] == 3
    refusal = None
    if not (len(shape) == 3 or vector):
        refusal = f"array of shape {shape}: a grid is (x, y, z) or (x, y, z, 3)"
    elif dtype.kind not in "fiub":
        refusal = f"array of dtype {dtype}: a grid is of numbers"
    elif 0 in shape:
        refusal = f"array of shape {shape} is empty"
    ends = tuple(n - 1 for n in shape[:3])
    return GridHeader(
        name=name,
        label=label,
        value_type="vec3" + dtype.name if vector else dtype.name,
        grid_class="fog volume" if not vector else "unknown",
        map_type="ScaleTranslateMap",
        world_from_index=world,
        background=0.0,
        active_voxels=math.prod(shape[:3]),
        active_box=((0, 0, 0), ends) if len(ends) == 3 else None,
        stored="dense",
        file_bytes=file_bytes,
        refusal=refusal,
    )
