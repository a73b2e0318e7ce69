"""Walks the tree of one grid of an OpenVDB file: nodes, tiles, and the blocks of leaves.

    tree       root tiles, 32^3 nodes; each: masks, block, its 16^3 nodes;
               each: masks, block, the masks of its leaves
    leaves     each: mask again, [origin and buffer count < 222], block of 512

A block is `vdb_codec`'s; files, grids and their headers are `vdb`'s.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from struct import Struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from volcli.grids.census import Census, take_census
from volcli.grids.threads import in_threads
from volcli.grids.tree import Progress, Tree
from volcli.grids.vdb_codec import Block, BlockCodec, Cursor, Damage, Mode, unpack_bits
from volcli.memory import memory_left, reserve

_ROOT = Struct("<II")  # tiles, children
_ORIGIN = Struct("<3i")
_UPPER_LOG2, _LOWER_LOG2 = 5, 4
_ROOT_WIDTH, _UPPER_CHILD, _LOWER_CHILD = 4096, 128, 8  # widths in voxels
_LEAF_VOXELS, _LEAF_MASK = 512, 64
_LEAVES_AT_ONCE = 1024
_UPPER_NODE_BYTES = 12 + 2 * 4096 + 1  # the least that a child of the root takes
_LOWER_NODE_BYTES = 2 * 512 + 1  # the same of its children
_MOST_BYTES_PER_LEAF = 8 * 729 * 4 * 3  # of bricks: eight of three channels


@dataclass
class _Topology:
    """Leaf origins in the order of the leaves' blocks, and tiles, while a tree is walked."""

    leaf_origins: list[NDArray[np.int32]] = field(default_factory=list)
    leaf_masks: list[memoryview] = field(default_factory=list)
    tile_origins: list[NDArray[np.int32]] = field(default_factory=list)
    tile_widths: list[NDArray[np.int32]] = field(default_factory=list)
    tile_values: list[NDArray[Any]] = field(default_factory=list)
    tile_active: list[NDArray[np.bool_]] = field(default_factory=list)
    tiles: int = 0

    def add_tiles(
        self,
        origins: NDArray[np.int32],
        width: int,
        values: NDArray[Any],
        active: NDArray[np.bool_],
    ) -> None:
        self.tiles += len(origins)
        size = values.itemsize * (values.size // max(len(values), 1)) + 17
        reserve(self.tiles * size, f"its {self.tiles:,} tiles")
        self.tile_origins.append(origins)
        self.tile_widths.append(np.full(len(origins), width, np.int32))
        self.tile_values.append(values)
        self.tile_active.append(active)


def _read_topology(cursor: Cursor, codec: BlockCodec, values: bool = True) -> _Topology:
    """Walk a tree from the root's table to its last leaf mask.

    Without ``values`` tiles are passed over: only the leaves are found.
    """
    topology = _Topology()
    tiles, children = cursor.unpack(_ROOT, "the root")
    taken = _read_root_tiles(cursor, codec, tiles, topology if values else None)
    cursor.need(children * _UPPER_NODE_BYTES, f"{children} nodes")
    found: dict[tuple[int, int, int], list[tuple[NDArray[np.int32], memoryview]]] = {}
    for _ in range(children):
        at = cursor.at
        origin = cursor.unpack(_ORIGIN, "the origin of a node")
        if any(x % _ROOT_WIDTH for x in origin):
            raise Damage(at, f"no node can be at {origin}")
        if origin in taken:
            raise Damage(at, f"a second node or tile at {origin}")
        taken.add(origin)
        kept = topology if values else None
        nodes = found[origin] = []
        lowers = _read_node(cursor, codec, origin, _UPPER_LOG2, _UPPER_CHILD, kept)
        cursor.need(len(lowers) * _LOWER_NODE_BYTES, f"{len(lowers)} nodes")
        for lower in lowers:
            leaves = _read_node(cursor, codec, lower, _LOWER_LOG2, _LOWER_CHILD, kept)
            nodes.append((leaves, cursor.take(_LEAF_MASK * len(leaves), "the masks of leaves")))
    # OpenVDB stores the blocks of leaves by the order of its map of nodes: x, then y, then z.
    in_order = [node for origin in sorted(found) for node in found[origin]]
    topology.leaf_origins = [leaves for leaves, _ in in_order]
    topology.leaf_masks = [masks for _, masks in in_order]
    return topology


def _read_root_tiles(
    cursor: Cursor, codec: BlockCodec, count: int, topology: _Topology | None
) -> set[tuple[int, int, int]]:
    """Read the tiles of the root's table; return where there are any."""
    at = cursor.at
    size = _ORIGIN.size + codec.kind.stored_bytes + 1
    raw = np.frombuffer(cursor.take(count * size, f"{count} tiles"), np.uint8).reshape(count, size)
    origins = raw[:, :12].copy().view("<i4")
    values = codec.to_memory(raw[:, 12:-1].copy().view(codec.kind.stored))
    values = values.reshape(count, *codec.kind.shape)
    active = raw[:, -1] != 0
    if (origins % _ROOT_WIDTH).any():
        raise Damage(at, "a tile where none can be")
    taken = set(map(tuple, origins.tolist()))
    if len(taken) < count:
        raise Damage(at, "two tiles at one place")
    if topology is not None:
        keep = active | _differs(values, codec.background)
        topology.add_tiles(origins[keep], _ROOT_WIDTH, values[keep], active[keep])
    return taken


def _read_node(
    cursor: Cursor,
    codec: BlockCodec,
    origin: Any,
    log2: int,
    child_width: int,
    topology: _Topology | None,
) -> NDArray[np.int32]:
    """Read the masks and the block of a node; return the origins of its children, (n, 3)."""
    size = 1 << 3 * log2
    raw = np.frombuffer(cursor.take(size // 4, "the masks of a node"), np.uint8)
    is_child, active = unpack_bits(raw.reshape(2, -1))
    count = size if codec.has_mode else size - np.count_nonzero(is_child)
    block = codec.locate(cursor.at, int(count), int(np.count_nonzero(active)))
    cursor.at = block[3] + abs(block[4])

    def origins_of(at: NDArray[np.intp]) -> NDArray[np.int32]:
        xyz = np.stack(np.unravel_index(at, (1 << log2,) * 3), axis=1)
        return (xyz * child_width + np.asarray(origin)).astype(np.int32)

    is_tile = active & ~is_child
    if topology is not None and (is_tile.any() or block[:3] != (Mode.BACKGROUND, block[1], 0)):
        values = _read_node_values(codec, block, is_child, active)
        is_tile |= ~is_child & _differs(values, codec.background)
        at = np.flatnonzero(is_tile)
        topology.add_tiles(origins_of(at), child_width, values[at], active[at])
    return origins_of(np.flatnonzero(is_child))


def _read_node_values(
    codec: BlockCodec, block: Block, is_child: NDArray[np.bool_], active: NDArray[np.bool_]
) -> NDArray[Any]:
    values = np.empty((active.size, *codec.kind.shape), codec.kind.dtype)
    if codec.has_mode:
        codec.read([block], active[None], values[None])
    else:  # only the values that are no children are stored
        stored = np.empty((1, block[2], *codec.kind.shape), codec.kind.dtype)
        codec.read([block], np.ones((1, block[2]), np.bool_), stored)
        values[...] = codec.background
        values[~is_child] = stored[0]
    return codec.to_memory(values)


def _differs(values: NDArray[Any], background: NDArray[Any]) -> NDArray[np.bool_]:
    """Which of n values are not the background; NaN is the same as NaN."""
    differs = (values != background) & ~((values != values) & (background != background))
    return differs.any(axis=1) if differs.ndim == 2 else differs


def _locate_leaves(
    cursor: Cursor, codec: BlockCodec, origins: NDArray[np.int32]
) -> tuple[list[int], list[Block]]:
    """Find the masks and the blocks of the leaves that follow, and leave the cursor behind them."""
    quick = codec.locate_leaves(cursor.at, len(origins))
    if quick is not None:
        masks_at, blocks, cursor.at = quick
        return masks_at, blocks
    masks_at, blocks = [], []
    data, locate, end, at = cursor.data, codec.locate, cursor.end, cursor.at
    # The mask is followed by the block, or up to version 221 by an origin and a buffer count.
    fixed = _LEAF_MASK if codec.has_mode else _LEAF_MASK + _ORIGIN.size + 1
    for leaf in range(len(origins)):
        if at + fixed > end:
            raise Damage(at, f"the file ends before leaf {leaf} of the next {len(origins)}")
        active = int.from_bytes(data[at : at + _LEAF_MASK], "little").bit_count()
        block = locate(at + fixed, _LEAF_VOXELS, active)
        masks_at.append(at)
        blocks.append(block)
        behind = block[3] + abs(block[4])
        if not codec.has_mode:
            if _ORIGIN.unpack_from(data, at + _LEAF_MASK) != tuple(origins[leaf].tolist()):
                raise Damage(at + _LEAF_MASK, "a leaf at another place than in its tree")
            for _ in range(1, data[at + fixed - 1]):  # auxiliary buffers, of no use
                extra = locate(behind, _LEAF_VOXELS, active)
                behind = extra[3] + abs(extra[4])
        at = behind
    cursor.at = at
    return masks_at, blocks


def skip_tree(cursor: Cursor, codec: BlockCodec) -> None:
    """Walk past a tree, from the table of its root on, unpacking nothing."""
    origins = _read_topology(cursor, codec, values=False).leaf_origins
    for lower in origins:
        if codec.fixed_leaf_bytes is not None:
            cursor.take(codec.fixed_leaf_bytes * len(lower), "the values of leaves")
        else:
            _locate_leaves(cursor, codec, lower)


def count_tree(cursor: Cursor, codec: BlockCodec) -> Census:
    """What a tree holds, from the table of its root on; no leaf is unpacked."""
    topology = _read_topology(cursor, codec)
    return _counted(topology, _joined(topology.leaf_origins, (0, 3), np.dtype(np.int32)), codec)


def _counted(topology: _Topology, origins: NDArray[np.int32], codec: BlockCodec) -> Census:
    masks = np.frombuffer(b"".join(topology.leaf_masks), np.uint8).reshape(-1, _LEAF_MASK)
    return take_census(
        origins, masks, topology.tiles, np.dtype((codec.kind.dtype, codec.kind.shape))
    )


def read_tree(cursor: Cursor, codec: BlockCodec, progress: Progress | None) -> Tree:
    """Read a tree, from the table of its root on; the leaves' blocks some at a time."""
    topology = _read_topology(cursor, codec)
    kind = codec.kind
    origins = _joined(topology.leaf_origins, (0, 3), np.dtype(np.int32))
    count = len(origins)
    least = codec.fixed_leaf_bytes or _LEAF_MASK + 1
    cursor.need(count * least, f"{count} leaves")
    leaf_bytes = _LEAF_VOXELS * kind.dtype.itemsize * kind.components + _LEAF_MASK
    if count * (leaf_bytes + _MOST_BYTES_PER_LEAF) > memory_left():  # else it fits in any case
        reserve(_counted(topology, origins, codec).loading_bytes, f"its {count:,} leaves")
    masks = np.empty((count, _LEAF_MASK), np.uint8)
    values = np.empty((count, _LEAF_VOXELS, *kind.shape), kind.dtype)
    starts = range(0, count, _LEAVES_AT_ONCE)
    parts = [slice(start, min(start + _LEAVES_AT_ONCE, count)) for start in starts]

    def located() -> Iterator[tuple[slice, list[Block]]]:
        for part in parts:
            masks_at, blocks = _locate_leaves(cursor, codec, origins[part])
            masks[part] = codec.gather(np.array(masks_at), _LEAF_MASK)
            yield part, blocks

    def unpack(part_and_blocks: tuple[slice, list[Block]]) -> None:
        part, blocks = part_and_blocks
        codec.read(blocks, unpack_bits(masks[part]), values[part])

    def read_bits(part: slice) -> None:
        _read_bit_leaves(cursor, codec.fixed_leaf_bytes or 0, masks[part], values[part])

    if codec.fixed_leaf_bytes is not None:
        work: Iterable[None] = map(read_bits, parts)
    elif codec.gains_from_threads:
        work = in_threads(unpack, located())
    else:
        work = map(unpack, located())
    for part, _ in zip(parts, work, strict=True):
        if progress is not None:
            progress(part.stop, count)
    return Tree(
        background=codec.background,
        leaf_origins=origins,
        leaf_values=values.reshape(count, 8, 8, 8, *kind.shape),
        leaf_masks=masks,
        tile_origins=_joined(topology.tile_origins, (0, 3), np.dtype(np.int32)),
        tile_widths=_joined(topology.tile_widths, (0,), np.dtype(np.int32)),
        tile_values=_joined(topology.tile_values, (0, *kind.shape), kind.dtype),
        tile_active=_joined(topology.tile_active, (0,), np.dtype(np.bool_)),
    )


def _read_bit_leaves(
    cursor: Cursor, size: int, masks: NDArray[np.uint8], values: NDArray[Any]
) -> None:
    """Leaves of bool (mask, origin, bits) and of mask grids (mask, origin), never compressed."""
    count = len(masks)
    raw = np.frombuffer(cursor.take(size * count, f"{count} leaves"), np.uint8)
    raw = raw.reshape(count, size)
    masks[...] = raw[:, :_LEAF_MASK]
    bits = raw[:, -_LEAF_MASK:] if size > _LEAF_MASK + _ORIGIN.size else masks
    values[...] = unpack_bits(np.ascontiguousarray(bits))


def _joined(parts: list[NDArray[Any]], empty: tuple[int, ...], dtype: np.dtype[Any]) -> Any:
    return np.concatenate(parts) if parts else np.empty(empty, dtype)
