"""Writes small OpenVDB files for tests: any version from 220 on, most types, no cleverness.

What OpenVDB itself no longer writes (versions 220 and 221) can be had only so. Every value of every
node is stored, unless ``active_mask`` asks that the active ones are.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import blosc
import numpy as np

ZIP, ACTIVE_MASK, BLOSC = 1, 2, 4

STORED = {
    "float": ("<f4", ()),
    "double": ("<f8", ()),
    "half": ("<f2", ()),
    "bool": ("u1", ()),
    "mask": ("u1", ()),
    "int32": ("<i4", ()),
    "int64": ("<i8", ()),
    "vec3s": ("<f4", (3,)),
    "vec3d": ("<f8", (3,)),
    "vec3i": ("<i4", (3,)),
}


@dataclass
class Grid:
    """One grid to be written.

    ``leaves`` maps an origin to (values (8, 8, 8[, 3]), active (8, 8, 8) bool); ``tiles`` maps
    (origin, width) to (value, active).
    """

    name: str = "density"
    value_type: str = "float"
    background: Any = 0
    leaves: dict[tuple[int, int, int], tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)
    tiles: dict[tuple[tuple[int, int, int], int], tuple[Any, bool]] = field(default_factory=dict)
    type_name: str = ""
    parent: str = ""
    map_type: str = "UniformScaleMap"
    map_numbers: tuple[float, ...] = (0.5,) * 3 + (0.0,) * 12
    metadata: dict[str, tuple[str, bytes]] = field(default_factory=dict)
    half: bool = False
    compression: int = 0
    extra_buffers: int = 0  # before version 222 only


@dataclass
class Layout:
    """Where a grid came to lie: its compression word, its root's table, its leaves, its end."""

    begin: int
    root: int
    blocks: int
    end: int


def write_vdb(
    path: Path, grids: list[Grid], version: int = 224, offsets: bool = True, zipped: bool = False
) -> list[Layout]:
    """Write a file; ``zipped`` is the flag that files before version 222 have for all grids."""
    out = bytearray()
    out += struct.pack("<q3IB", 0x56444220, version, 10, 0, offsets)
    if version < 222:
        out += struct.pack("<B", zipped)
    out += b"01234567-89ab-cdef-0123-456789abcdef"
    out += struct.pack("<I", 0)
    out += struct.pack("<i", len(grids))
    layouts = []
    for grid in grids:
        type_name = grid.type_name or f"Tree_{grid.value_type}_5_4_3"
        out += _string(grid.name) + _string(type_name + "_HalfFloat" * grid.half)
        out += _string(grid.parent)
        positions_at = len(out)
        out += bytes(24)
        writer = _GridWriter(grid, version, ZIP * zipped if version < 222 else grid.compression)
        layout = writer.write(out)
        if offsets:
            struct.pack_into("<3q", out, positions_at, layout.begin, layout.blocks, layout.end)
        layouts.append(layout)
    path.write_bytes(out)
    return layouts


class _GridWriter:
    def __init__(self, grid: Grid, version: int, compression: int) -> None:
        self.grid = grid
        self.version = version
        self.compression = compression
        stored, self.shape = STORED.get(grid.value_type, ("<f4", ()))
        self.stored = np.dtype(stored)
        self.packed = np.dtype("<f2") if grid.half and self.stored.kind == "f" else self.stored

    def write(self, out: bytearray) -> Layout:
        grid = self.grid
        begin = len(out)
        if self.version >= 222:
            out += struct.pack("<I", self.compression)
        name = grid.name.partition("\x1e")[0]
        metadata = {"name": ("string", name.encode()), **grid.metadata}
        if grid.half:
            metadata["is_saved_as_half_float"] = ("bool", b"\1")
        out += struct.pack("<I", len(metadata))
        for key, (type_name, raw) in metadata.items():
            out += _string(key) + _string(type_name) + struct.pack("<I", len(raw)) + raw
        out += _string(grid.map_type)
        out += struct.pack(f"<{len(grid.map_numbers)}d", *grid.map_numbers)
        root = blocks = len(out)
        if not grid.parent:
            out += struct.pack("<I", 1) + self.value(grid.background)
            root = len(out)
            order = self.topology(out)
            blocks = len(out)
            for origin in order:
                self.leaf(out, origin)
        return Layout(begin, root, blocks, len(out))

    def value(self, value: Any) -> bytes:
        return np.broadcast_to(np.asarray(value, self.stored), self.shape).tobytes()

    def topology(self, out: bytearray) -> list[tuple[int, int, int]]:
        """Root, 32^3 and 16^3 nodes, leaf masks; return the leaves in the order of their blocks."""
        tiles = self.grid.tiles
        roots = {o: t for (o, width), t in tiles.items() if width == 4096}
        inner = [o for (o, width) in tiles if width < 4096] + list(self.grid.leaves)
        uppers = sorted({tuple(x & -4096 for x in o) for o in inner})
        out += struct.pack("<II", len(roots), len(uppers))
        for origin, (value, active) in sorted(roots.items()):
            out += struct.pack("<3i", *origin) + self.value(value) + bytes([active])
        order = []
        for upper in uppers:
            out += struct.pack("<3i", *upper)
            lowers = {tuple(x & -128 for x in o) for o in self.grid.leaves}
            lowers |= {tuple(x & -128 for x in o) for (o, width) in tiles if width == 8}
            for lower in self.node(out, upper, 32, 128, lowers):
                for leaf in self.node(out, lower, 16, 8, set(self.grid.leaves)):
                    out += _bits(self.grid.leaves[leaf][1])
                    order.append(leaf)
        return order

    def node(self, out: bytearray, origin: Any, side: int, width: int, children: Any) -> list[Any]:
        """One internal node; return its children in the order of the file."""
        values = np.zeros((side,) * 3 + self.shape, self.stored)
        values[...] = self.grid.background
        is_child = np.zeros((side,) * 3, bool)
        active = is_child.copy()
        found = {}
        for child in children:
            at = tuple((c - o) // width for c, o in zip(child, origin, strict=True))
            if all(0 <= x < side for x in at):
                is_child[at] = True
                values[at] = 0
                found[at] = child
        for (tile, tile_width), (value, on) in self.grid.tiles.items():
            at = tuple((t - o) // width for t, o in zip(tile, origin, strict=True))
            if tile_width == width and all(0 <= x < side for x in at):
                values[at], active[at] = value, on
        out += _bits(is_child) + _bits(active)
        if self.version < 222:
            out += self.data(values[~is_child])
        else:
            self.block(out, values, active)
        return [found[at] for at in sorted(found)]

    def leaf(self, out: bytearray, origin: tuple[int, int, int]) -> None:
        values, active = self.grid.leaves[origin]
        out += _bits(active)
        if self.grid.value_type in ("bool", "mask"):
            out += struct.pack("<3i", *origin)
            if self.grid.value_type == "bool":
                out += _bits(values.astype(bool))
            return
        if self.version < 222:
            out += struct.pack("<3iB", *origin, 1 + self.grid.extra_buffers)
            for _ in range(1 + self.grid.extra_buffers):
                out += self.data(np.asarray(values, self.stored))
        else:
            self.block(out, values, active)

    def block(self, out: bytearray, values: np.ndarray, active: np.ndarray) -> None:
        values = np.asarray(values, self.stored)
        if self.compression & ACTIVE_MASK:
            out += b"\0" + self.data(values[active])  # inactive values are the background
        else:
            out += b"\6" + self.data(values)

    def data(self, values: np.ndarray) -> bytes:
        raw = np.ascontiguousarray(values, self.packed).tobytes()
        if not raw and self.grid.half and self.stored.kind == "f":
            return b""  # as OpenVDB's reader expects it
        if not self.compression & (ZIP | BLOSC):
            return raw
        if self.compression & BLOSC:
            packed = blosc.compress(raw, typesize=self.packed.itemsize, cname="lz4") if raw else b""
        else:
            packed = zlib.compress(raw)
        if not raw or len(packed) >= len(raw):
            return struct.pack("<q", -len(raw)) + raw
        return struct.pack("<q", len(packed)) + packed


def _string(text: str) -> bytes:
    raw = text.encode()
    return struct.pack("<I", len(raw)) + raw


def _bits(mask: np.ndarray) -> bytes:
    return np.packbits(mask.reshape(-1), bitorder="little").tobytes()
