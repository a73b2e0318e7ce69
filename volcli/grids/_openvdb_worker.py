"""Runs inside an interpreter that has OpenVDB's Python module, never inside volcli's own process.

    _openvdb_worker.py headers FILE OUT [NAMES.json]    writes OUT/headers.json
    _openvdb_worker.py tree FILE OUT NAME               writes OUT/<array>.npy

What fails is written to OUT/error.txt, in one line, and ends the process with 3. This file imports
nothing of volcli; `pyopenvdb` starts it.
"""

from __future__ import annotations

import itertools
import json
import operator
import os
import resource
import sys
from typing import Any

import numpy as np

try:
    import openvdb  # type: ignore[import-not-found]
except ImportError:
    import pyopenvdb as openvdb  # type: ignore[import-not-found]

Array = np.ndarray[Any, Any]
Point = tuple[int, ...]
Tile = tuple[Point, int, Any, bool]  # origin, width, value, active

FAILED = 3
ROOT, UPPER, LOWER, LEAF = 4096, 128, 8, 1  # width of what the root, a node and a leaf hold
MOST_ROOT_CELLS = 100000
FARTHEST = 2**29  # beyond it copyToArray has crashed and hung
DTYPES = {
    "float": "f4",
    "double": "f8",
    "half": "f4",
    "bool": "?",
    "int32": "i4",
    "int64": "i8",
    "vec3s": "f4",
    "vec3d": "f8",
    "vec3i": "i4",
}


def grid_headers(path: str, names: list[str] | None) -> list[dict[str, Any]]:
    """Headers of all grids at once, or of those named: a grid of unknown type then costs itself."""
    if names is None:
        return [header(grid) for grid in openvdb.readAllGridMetadata(path)]
    found = []
    for name in names:
        try:
            found.append(header(openvdb.readGridMetadata(path, name)))
        except (TypeError, RuntimeError, KeyError) as error:
            found.append({"name": name, "refusal": one_line(error)})
    return found


def header(grid: Any) -> dict[str, Any]:
    transform = grid.transform
    linear = bool(getattr(transform, "isLinear", True))
    corner = transform.indexToWorld((0.0, 0.0, 0.0))
    columns = [transform.indexToWorld(unit) for unit in np.eye(3).tolist()]
    matrix = np.eye(4)
    matrix[:3, 3] = corner
    matrix[:3, :3] = np.transpose(columns) - np.array(corner)[:, None]
    return {
        "name": grid.name,
        "value_type": grid.valueTypeName,
        "grid_class": str(grid.gridClass),
        "map_type": transform.typeName,
        "world_from_index": matrix.tolist() if linear else None,
        "half": bool(grid.saveFloatAsHalf),
        "metadata": {key: grid.metadata[key] for key in grid.metadata},
    }


def write_tree(path: str, out: str, name: str) -> None:
    grid = openvdb.read(path, name)
    if grid.valueTypeName not in DTYPES:
        raise TypeError(f"values of type {grid.valueTypeName} cannot be copied")
    dtype = np.dtype(DTYPES[grid.valueTypeName])
    shape = (3,) if grid.valueTypeName.startswith("vec3") else ()
    nodes, tiles = descend(grid)
    values = leaf_values(grid, nodes, dtype, shape)
    arrays = {
        "background": np.array(grid.background, dtype),
        "leaf_origins": np.array(list(itertools.chain(*nodes)), "i4").reshape(-1, 3),
        "leaf_values": values,
        "leaf_masks": leaf_masks(grid, nodes, values),
        "tile_origins": np.array([tile[0] for tile in tiles], "i4").reshape(-1, 3),
        "tile_widths": np.array([tile[1] for tile in tiles], "i4"),
        "tile_values": np.array([tile[2] for tile in tiles], dtype).reshape(-1, *shape),
        "tile_active": np.array([tile[3] for tile in tiles], "?"),
    }
    for key, array in arrays.items():
        np.save(os.path.join(out, key + ".npy"), array)  # noqa: PTH118


def descend(grid: Any) -> tuple[list[list[Point]], list[Tile]]:
    """Find the leaves, by 16^3 node, and the tiles, asking at which depth single points lie."""
    accessor = grid.getConstAccessor()
    background = grid.background
    nodes: list[list[Point]] = []
    tiles: list[Tile] = []

    def visit(origin: Point, width: int, depth: int) -> list[Point]:
        """Return the children, ``width`` wide, of the node at ``origin``; note its tiles."""
        children: list[Point] = []
        steps = [range(x, x + width * (32 if depth == 1 else 16), width) for x in origin]
        for point in itertools.product(*steps):
            if accessor.getValueDepth(point) > depth:
                children.append(point)
            else:
                note_tile(point, width)
        return children

    def note_tile(point: Point, width: int) -> None:
        value, active = accessor.probeValue(point)
        if active or (value != background and value == value):
            tiles.append((point, width, value, active))

    for root_cell in root_cells(grid):
        depth = accessor.getValueDepth(root_cell)
        if depth == 0:
            note_tile(root_cell, ROOT)
        elif depth > 0:
            for lower in visit(root_cell, UPPER, 1):
                leaves = visit(lower, LOWER, 2)
                if leaves:
                    nodes.append(leaves)
    return nodes, tiles


def root_cells(grid: Any) -> list[Point]:
    """Where children and tiles of the root can be: the box of all leaves and active values.

    Where that box is vast (two far corners) the active values are listed instead: slow, and leaves
    without any, alone in their 4096^3, are missed.
    """
    boxes = [grid.evalActiveVoxelBoundingBox(), grid.evalLeafBoundingBox()]
    boxes = [box for box in boxes if all(a <= b for a, b in zip(*box, strict=True))]
    if not boxes:
        return []
    low = [min(box[0][axis] for box in boxes) & -ROOT for axis in range(3)]
    high = [max(box[1][axis] for box in boxes) for axis in range(3)]
    steps = [range(a, b + 1, ROOT) for a, b in zip(low, high, strict=True)]
    if len(steps[0]) * len(steps[1]) * len(steps[2]) <= MOST_ROOT_CELLS:
        return list(itertools.product(*steps))
    return sorted({tuple(x & -ROOT for x in value.min) for value in grid.citerOnValues()})


def leaf_values(grid: Any, nodes: list[list[Point]], dtype: Any, shape: Any) -> Array:
    """Copy leaves out, (n, 8, 8, 8, ...): one dense copy of their box for each 16^3 node."""
    values = np.empty((sum(map(len, nodes)), 8, 8, 8, *shape), dtype)
    done = 0
    for leaves in nodes:
        part = values[done : done + len(leaves)]
        done += len(leaves)
        at = np.array(leaves)
        low, high = at.min(axis=0), at.max(axis=0)
        if low.min() <= -FARTHEST or high.max() >= FARTHEST:
            copy_voxels(grid, leaves, part)
            continue
        cells = (high - low) // 8 + 1
        dense = np.empty((*(8 * cells), *shape), dtype)
        grid.copyToArray(dense, ijk=tuple(low.tolist()))
        x, y, z = ((at - low) // 8).T
        split = dense.reshape(cells[0], 8, cells[1], 8, cells[2], 8, *shape)
        part[...] = split[x, :, y, :, z]
    return values


def copy_voxels(grid: Any, leaves: list[Point], out: Array) -> None:
    """Copy leaves voxel by voxel, where copyToArray cannot be trusted: slow, and rare."""
    value_at = grid.getConstAccessor().getValue
    for leaf, values in zip(leaves, out, strict=True):
        for xyz in itertools.product(range(8), repeat=3):
            values[xyz] = value_at(tuple(a + b for a, b in zip(leaf, xyz, strict=True)))


def leaf_masks(grid: Any, nodes: list[list[Point]], values: Array) -> Array:
    """The active voxels: those that change when all active values of a copy are replaced.

    The library has no cheaper way to ask. Where values are bool each is negated; else each becomes
    the first whole number that no leaf holds.
    """
    changed = grid.deepCopy()
    if values.dtype == bool:
        changed.mapOn(operator.not_)
    else:
        number = next(n for n in itertools.count(1) if not (values == n).any())
        mark: Any = type(grid.background)(number) if values.ndim == 4 else (number,) * 3
        changed.mapOn(lambda value: mark)
    after = leaf_values(changed, nodes, values.dtype, values.shape[4:])
    active = (after != values) & ~((after != after) & (values != values))
    active = active.reshape(len(values), 512, *values.shape[4:])
    active = active.any(axis=2) if active.ndim == 3 else active
    return np.packbits(active, axis=1, bitorder="little")


def one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__


def as_json(value: Any) -> Any:
    """What JSON cannot hold of a metadatum: its text."""
    return value.tolist() if hasattr(value, "tolist") else str(value)


def main(task: str, path: str, out: str, *rest: str) -> int:
    openvdb.setLoggingLevel("fatal")
    memory = int(os.environ.get("VOLCLI_MEMORY", "0"))
    if memory:
        resource.setrlimit(resource.RLIMIT_DATA, (memory, memory))
    try:
        if task == "tree":
            write_tree(path, out, rest[0])
            return 0
        names = None
        if rest:
            with open(rest[0], encoding="utf-8") as file:  # noqa: PTH123
                names = json.load(file)
        found = grid_headers(path, names)
        with open(os.path.join(out, "headers.json"), "w", encoding="utf-8") as file:  # noqa: PTH118, PTH123
            json.dump(found, file, default=as_json)
    except Exception as error:
        with open(os.path.join(out, "error.txt"), "w", encoding="utf-8") as file:  # noqa: PTH118, PTH123
            file.write(one_line(error))
        return FAILED
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
