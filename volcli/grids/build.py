"""A `Tree` to a `BrickGrid`: straight from the leaves, with no dense array on the way.

How the apron is found at each level: a node's cells read from itself and from its seven neighbours
on the + side. Its **signature** is those eight source entries. Where all are one constant, so is
the node; where all are constants but not the same, all nodes with that signature are one shared
node (so the surface of a 4096-voxel tile is a handful of nodes); else the node is refined.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from volcli.grids.brick import (
    APRON,
    BACKGROUND,
    BRICK,
    CORNERS,
    LOWER,
    ROOT_WIDTH,
    UPPER,
    BrickArrays,
    BrickGrid,
)
from volcli.grids.threads import in_threads
from volcli.grids.tree import GridHeader, Tree
from volcli.memory import reserve

_CHUNK = 16
"""Nodes refined at a time: bounds the memory of the work to some tens of MB."""

_KEY_BITS = 21
"""Of a root cell's coordinate in its key: an int32 coordinate / 4096, and a cell beyond."""

_ROW_BYTES = 200
"""What a child takes while it is told whether another is the same, with all that is sorted."""

_LEAVES = 512
"""Leaves or bricks worked on at a time, so that what is made of them stays in the cache."""


def build(tree: Tree, header: GridHeader) -> BrickGrid:
    """Build the bricks of a tree.

    Parameters
    ----------
    tree
        Leaves and tiles of any value type; values become float32.
    header
        Gives the transform.

    Raises
    ------
    MemoryLimit
        If the bricks would take more memory than they may. (Tiles that all differ take thousands
        of times what they take in a file.)
    """
    assert header.world_from_index is not None, "readers refuse grids without a linear transform"
    values = tree.leaf_values.astype(np.float32, copy=False)
    constants, tile_entries = _constants(tree)
    active_box = _active_box(tree)

    source = _SourceTables(tree, tile_entries)
    roots, root_signatures = source.root_signatures()
    root_entries, upper_signatures = _entries(root_signatures)
    upper, lower_signatures = _refine(upper_signatures, source.upper, UPPER)
    lower, brick_signatures = _refine(
        lower_signatures, source.lower, LOWER, drop=_background_parts(values, constants[0])
    )
    atlas = _fill(brick_signatures, values, constants)

    keep = root_entries != BACKGROUND
    first = (active_box[0] - 1) // ROOT_WIDTH
    planes, keys = _root_index(roots[keep] - first, active_box[1] // ROOT_WIDTH - first)
    order = np.argsort(keys)
    return BrickGrid(
        arrays=BrickArrays(
            atlas,
            constants,
            lower,
            _occupied(lower),
            upper,
            keys[order],
            root_entries[keep][order],
            *planes,
        ),
        origin=first * ROOT_WIDTH,
        world_from_index=np.asarray(header.world_from_index, np.float64),
        active_box=active_box,
    )


def _constants(tree: Tree) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """The distinct constants, the background first, and the entry of each tile."""
    background = np.asarray(tree.background, np.float32)[None]
    every = np.concatenate(
        [background, tree.tile_values.astype(np.float32).reshape(-1, *background.shape[1:])]
    )
    unique, which = np.unique(every, axis=0, return_inverse=True)
    which = which.reshape(-1)
    rank = np.empty(len(unique), np.int32)  # the background becomes constant 0
    rest = np.delete(np.arange(len(unique)), which[0])
    order = np.concatenate([which[:1], rest])
    rank[order] = np.arange(len(unique), dtype=np.int32)
    return np.ascontiguousarray(unique[order]), (-1 - rank[which[1:]]).astype(np.int32)


def _active_box(tree: Tree) -> NDArray[np.int64]:
    """Smallest and largest lattice point that is active or differs from the background."""
    boxes = [np.array([[1, 1, 1], [0, 0, 0]], np.int64)]
    if len(tree.tile_origins):
        lo = tree.tile_origins.astype(np.int64)
        hi = lo + tree.tile_widths.astype(np.int64)[:, None] - 1
        boxes.append(np.array([lo.min(axis=0), hi.max(axis=0)]))
    ends = [[_outermost(tree, axis, side) for axis in range(3)] for side in (0, 1)]
    if ends[0][0] is not None:
        boxes.append(np.array(ends, np.int64))
    if len(boxes) == 1:
        return boxes[0]
    found = np.array(boxes[1:])
    return np.array([found[:, 0].min(axis=0), found[:, 1].max(axis=0)])


def _outermost(tree: Tree, axis: int, side: int) -> int | None:
    """The first (side 0) or last (side 1) lattice point along an axis that a leaf uses.

    Looks at the outermost leaves alone, and further in only while those use nothing.
    """
    along = tree.leaf_origins[:, axis]
    layers = np.unique(along)
    for origin in layers if side == 0 else layers[::-1]:
        used = np.flatnonzero(_used(tree, along == origin).any(axis=(0, *_others(axis))))
        if len(used):
            return int(origin) + int(used[0 if side == 0 else -1])
    return None


def _others(axis: int) -> tuple[int, int]:
    """The axes of (n, x, y, z) that are neither n nor this one."""
    a, b = (other + 1 for other in range(3) if other != axis)
    return a, b


def _used(tree: Tree, leaves: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(n, 8, 8, 8): which lattice points of some leaves are active, or not background."""
    values = tree.leaf_values[leaves]
    differs = values != tree.background
    if values.ndim == 5:
        differs = differs.any(axis=-1)
    active = np.unpackbits(tree.leaf_masks[leaves], axis=1, bitorder="little").astype(bool)
    return differs | active.reshape(differs.shape)


class _SourceTables:
    """The tree as tables of entries, one a level: what a signature's entries point into."""

    def __init__(self, tree: Tree, tile_entries: NDArray[np.int32]) -> None:
        origins = np.concatenate([tree.leaf_origins, tree.tile_origins]).astype(np.int64)
        leaves = np.arange(len(tree.leaf_origins), dtype=np.int32)
        entries = np.concatenate([leaves, tile_entries])
        widths = np.concatenate([np.full(len(leaves), BRICK), tree.tile_widths])
        in_root, in_block, at_brick = widths == ROOT_WIDTH, widths == 128, widths == BRICK

        roots = origins // ROOT_WIDTH
        self.roots, root_of = _unique_roots(roots)
        self.root_entries = np.full(len(self.roots), BACKGROUND, np.int32)
        self.root_entries[root_of[in_root]] = entries[in_root]
        with_upper = np.unique(root_of[~in_root])
        self.root_entries[with_upper] = np.arange(len(with_upper))

        block = _flat(origins // 128 % UPPER, UPPER)
        upper_of = self.root_entries[root_of]
        self.upper = np.full((len(with_upper), UPPER**3), BACKGROUND, np.int32)
        self.upper[upper_of[in_block], block[in_block]] = entries[in_block]

        node_key = upper_of.astype(np.int64) * UPPER**3 + block
        nodes, lower_of = np.unique(node_key[at_brick], return_inverse=True)
        self.upper.reshape(-1)[nodes] = np.arange(len(nodes))
        self.lower = np.full((len(nodes), LOWER**3), BACKGROUND, np.int32)
        brick = _flat(origins // BRICK % LOWER, LOWER)
        self.lower[lower_of.reshape(-1), brick[at_brick]] = entries[at_brick]

    def root_signatures(self) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
        """The root cells whose field may differ from the background, and their signatures."""
        reached = (self.roots[:, None] - CORNERS).reshape(-1, 3)
        cells, _ = _unique_roots(reached)
        known = _root_keys(self.roots)
        wanted = _root_keys((cells[:, None] + CORNERS).reshape(-1, 3))
        at = np.minimum(np.searchsorted(known, wanted), max(len(known) - 1, 0))
        signatures = np.full(len(wanted), BACKGROUND, np.int32)
        if len(known):
            found = known[at] == wanted
            signatures[found] = self.root_entries[at[found]]
        return cells, signatures.reshape(-1, 8)


def _unique_roots(roots: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.intp]]:
    """The distinct rows in order, and which of them each row is."""
    keys, root_of = np.unique(_root_keys(roots), return_inverse=True)
    mask = (1 << _KEY_BITS) - 1
    axes = [keys >> 2 * _KEY_BITS, keys >> _KEY_BITS & mask, keys & mask]
    return np.stack(axes, axis=1) - (1 << _KEY_BITS - 1), root_of


def _root_keys(roots: NDArray[np.int64]) -> NDArray[np.int64]:
    """One number for each of n root cells, in the order of their coordinates."""
    x, y, z = (roots + (1 << _KEY_BITS - 1)).T
    keys: NDArray[np.int64] = (x << 2 * _KEY_BITS) | (y << _KEY_BITS) | z
    return keys


def _flat(coordinates: NDArray[np.int64], width: int) -> NDArray[np.int64]:
    return (coordinates[:, 0] * width + coordinates[:, 1]) * width + coordinates[:, 2]


def _entries(signatures: NDArray[np.int32]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """An entry for each signature (n, 8), and the signatures (m, 8) that become children."""
    entries = signatures[:, 0].copy()
    uniform = (entries < 0) & (signatures == signatures[:, :1]).all(axis=1)
    rest = np.flatnonzero(~uniform)
    rows = signatures[rest]
    all_constant = (rows < 0).all(axis=1)
    shared, which = np.unique(rows[all_constant], axis=0, return_inverse=True)
    own = rows[~all_constant]
    entries[rest[all_constant]] = which.reshape(-1)
    entries[rest[~all_constant]] = len(shared) + np.arange(len(own))
    return entries, np.concatenate([shared, own])


def _refine(
    signatures: NDArray[np.int32],
    tables: NDArray[np.int32],
    width: int,
    drop: NDArray[np.bool_] | None = None,
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """One level down: the table of each node (m, width^3), and the signatures of their children.

    Parameters
    ----------
    signatures
        (m, 8): the nodes, by the entries of their source and its + neighbours.
    tables
        (k, width^3): the source tables that those entries point into.
    drop
        (n, 8): for each source child and corner, whether the part of it that a node's corner reads
        is all background, so that it counts as that constant.
    """
    cubes = tables.reshape(-1, width, width, width)
    reserve(4 * len(signatures) * width**3, f"its {len(signatures):,} nodes")
    nodes = np.empty((len(signatures), width**3), np.int32)
    found = [np.empty((0, 8), np.int32)]
    places = [np.empty(0, np.int64)]
    mixed_count = 0
    for start in range(0, len(signatures), _CHUNK):
        extended = _extended(signatures[start : start + _CHUNK], cubes, width)
        corners = [extended[:, x : x + width, y : y + width, z : z + width] for x, y, z in CORNERS]
        nodes[start : start + _CHUNK] = corners[0].reshape(-1, width**3)
        uniform = corners[0] < 0
        for corner in corners[1:]:
            uniform &= corner == corners[0]
        mixed = np.nonzero(~uniform)
        found.append(np.stack([corner[mixed] for corner in corners], axis=-1))
        places.append(start * width**3 + np.flatnonzero(~uniform))
        mixed_count += len(places[-1])
        reserve(mixed_count * _ROW_BYTES, f"its {mixed_count:,} nodes and bricks")
    rows = np.concatenate(found)
    if drop is not None and len(drop):
        rows[(rows >= 0) & drop[np.maximum(rows, 0), np.arange(8)]] = BACKGROUND
    nodes.reshape(-1)[np.concatenate(places)], children = _entries(rows)
    return nodes, children


def _extended(
    signatures: NDArray[np.int32], cubes: NDArray[np.int32], width: int
) -> NDArray[np.int32]:
    """(m, width+1, ...): each node's source entries with one layer of its + neighbours'."""
    extended = np.empty((len(signatures), width + 1, width + 1, width + 1), np.int32)
    for corner, (x, y, z) in enumerate(CORNERS):
        region = extended[:, _part(x, width), _part(y, width), _part(z, width)]
        entry = signatures[:, corner]
        region[...] = entry[:, None, None, None]
        child = entry >= 0
        region[child] = cubes[:, _read(x), _read(y), _read(z)][entry[child]]
    return extended


def _part(side: int, width: int) -> slice:
    """Where along an axis the entries of the node itself (0) or of its + neighbour (1) go."""
    return slice(width, width + 1) if side else slice(0, width)


def _read(side: int) -> slice:
    """What along an axis is read of the node itself (0): all; of its + neighbour (1): a layer."""
    return slice(0, 1) if side else slice(None)


def _background_parts(
    values: NDArray[np.float32], background: NDArray[np.float32]
) -> NDArray[np.bool_]:
    """(n, 8): whether the part of each leaf that a brick's corner reads is all background."""
    empty = np.empty((len(values), 8), np.bool_)
    for start in range(0, len(values), _LEAVES):
        same = values[start : start + _LEAVES] == background
        if values.ndim == 5:
            same = same.all(axis=-1)
        for corner, (x, y, z) in enumerate(CORNERS):
            part = same[:, _read(x), _read(y), _read(z)]
            empty[start : start + _LEAVES, corner] = part.all(axis=(1, 2, 3))
    return empty


def _fill(
    signatures: NDArray[np.int32], values: NDArray[np.float32], constants: NDArray[np.float32]
) -> NDArray[np.float32]:
    """The atlas: for each brick, its leaf's values and the apron out of its + neighbours'.

    In threads, mostly so that fresh memory is touched for the first time by several at once: that
    costs more than what is written.
    """
    channels = values.shape[4:]
    size = APRON**3 * 4 * (channels[0] if channels else 1)
    reserve(len(signatures) * size, f"its {len(signatures):,} bricks")
    atlas = np.empty((len(signatures), APRON, APRON, APRON, *channels), np.float32)

    def fill(start: int) -> None:
        rows, bricks = signatures[start : start + _LEAVES], atlas[start : start + _LEAVES]
        for corner, (x, y, z) in enumerate(CORNERS):
            region = bricks[:, _part(x, BRICK), _part(y, BRICK), _part(z, BRICK)]
            entry = rows[:, corner]
            constant = np.flatnonzero(entry < 0)
            if len(constant) < len(entry):  # of a constant's leaf any, overwritten at once
                region[...] = values[:, _read(x), _read(y), _read(z)][np.maximum(entry, 0)]
            region[constant] = constants[-1 - entry[constant]].reshape(-1, 1, 1, 1, *channels)

    for _ in in_threads(fill, range(0, len(signatures), _LEAVES)):
        pass
    return atlas.reshape(-1, APRON**3, *channels)


def _occupied(lower: NDArray[np.int32]) -> NDArray[np.int64]:
    cells = (lower != BACKGROUND).reshape(-1, 4, 4, 4, 4, 4, 4).any(axis=(2, 4, 6))
    return np.packbits(cells.reshape(-1, 64), axis=1, bitorder="little").view("<i8").ravel()


def _root_index(
    cells: NDArray[np.int64], last: NDArray[np.int64]
) -> tuple[list[NDArray[np.float64]], NDArray[np.int64]]:
    """Planes along each axis, in local voxels, and the key of each root cell among them.

    The planes reach from 0 to the end of the cell ``last``, so that they hold all of the support.
    """
    ends = [[0, max(int(last[a]), 0) + 1] for a in range(3)]
    edges = [np.unique(np.concatenate([cells[:, a], cells[:, a] + 1, ends[a]])) for a in range(3)]
    at = [np.searchsorted(edges[a], cells[:, a]) for a in range(3)]
    counts = [len(e) - 1 for e in edges]
    keys = (at[0] * counts[1] + at[1]) * counts[2] + at[2]
    return [e * float(ROOT_WIDTH) for e in edges], keys.astype(np.int64)
