"""Reads OpenVDB files, versions 220 to 225: headers first, then the tree of the grid asked for.

The layout, little-endian throughout; what follows the background is `vdb_tree`'s:

    file       magic, version, library, has-offsets, [zip flag < 222], uuid, metadata, grid count
    grid       name, type, instance parent, int64 begin, blocks, end    (0 in a stream)
    at begin   [compression >= 222], metadata, transform; unless an instance: 1, background, tree

The format has no checksum. Lengths, counts and offsets are checked against the bytes that are left
before anything is allocated, and what metadata say of a grid decides nothing. A grid is read from
the bytes between its own offsets, and those of no two grids overlap. What turns a `Tree` into
something to render lives in ``brick``.
"""

from __future__ import annotations

import mmap
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from struct import Struct
from typing import Any

import numpy as np

from volcli.errors import VolumeError
from volcli.grids.census import Census
from volcli.grids.tree import GridHeader, Progress, Tree, unique_labels
from volcli.grids.vdb_codec import (
    HAS_BLOCK_MODE,
    VALUE_TYPES,
    BlockCodec,
    Compression,
    Cursor,
    Damage,
    ValueType,
)
from volcli.grids.vdb_transform import is_known, read_transform
from volcli.grids.vdb_tree import count_tree, read_tree, skip_tree
from volcli.memory import no_room

MAGIC = 0x56444220
VERSIONS = range(220, 226)

_FILE = Struct("<q3IB")  # magic, version, library major and minor, has offsets
_POSITIONS = Struct("<3q")
_COUNT = Struct("<i")
_UUID_BYTES = 36
_HALF_SUFFIX = "_HalfFloat"
_DUPLICATE = "\x1e"  # before the number that sets apart grids of one name
_TYPE = re.compile(r"Tree_(\w+?)_(\d+(?:_\d+)*)")
_CONFIGURATION = "5_4_3"

_METADATA_LAYOUTS = {
    name: Struct("<" + code)
    for name, code in (
        *(("bool", "?"), ("int32", "i"), ("int64", "q"), ("float", "f"), ("double", "d")),
        *((f"vec{n}{t}", f"{n}{c}") for n in (2, 3, 4) for t, c in ("ii", "sf", "dd")),
        *((f"mat{n}{t}", f"{n * n}{c}") for n in (3, 4) for t, c in ("sf", "dd")),
    )
}


@dataclass(frozen=True)
class _Descriptor:
    """A grid as the file lists it; ``unique_name`` still has the suffix of a duplicate."""

    unique_name: str
    type_name: str
    parent: str
    end: int

    @property
    def name(self) -> str:
        return self.unique_name.partition(_DUPLICATE)[0]


@dataclass(frozen=True)
class _Grid:
    """A header with what reading the tree takes: the codec, and where the root's table starts."""

    header: GridHeader
    descriptor: _Descriptor
    codec: BlockCodec | None
    root_at: int


def open_vdb(path: str | Path) -> VdbFile:
    """Open an OpenVDB file: read its headers, and none of its voxels.

    Raises
    ------
    VolumeError
        If the file cannot be opened, is no OpenVDB file or is damaged.
    """
    return VdbFile(Path(path))


class VdbFile:
    """An OpenVDB file, satisfying `volcli.grids.tree.Volume`.

    Attributes
    ----------
    path, headers
        As in `Volume`; headers are in the order of the file.
    version
        The version of the file format.
    library_version
        (major, minor) of the library that wrote the file.
    uuid
        The file's identifier.
    metadata
        The metadata of the file; each grid's are in its header.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._data = _map_file(path)
        with self._located():
            cursor = Cursor(self._data)
            self._read_file_header(cursor)
            grids = list(self._read_grids(cursor))
        self._grids = _resolve_instances(_labelled(grids))
        self.headers: tuple[GridHeader, ...] = tuple(grid.header for grid in self._grids)

    def read_tree(self, header: GridHeader, progress: Progress | None = None) -> Tree:
        """Read the leaves and tiles of one grid, and no byte of any other.

        Values that the file stores as half floats come in the grid's own type, as OpenVDB reads
        them; a grid whose own type is half comes as float32.

        Raises
        ------
        VolumeError
            If the grid is refused (``header.refusal``) or the file is damaged.
        """
        with self._located(header.label):
            return read_tree(*self._tree_of(header), progress)

    def census(self, header: GridHeader) -> Census:
        """How much a grid holds, from its nodes and masks; no value of a leaf is read.

        Raises
        ------
        VolumeError
            As `read_tree`.
        """
        with self._located(header.label):
            cursor, codec = self._tree_of(header)
            begin = cursor.at
            return replace(count_tree(cursor, codec), mapped_bytes=cursor.end - begin)

    def _tree_of(self, header: GridHeader) -> tuple[Cursor, BlockCodec]:
        """Where the tree of a grid begins, and what reads it."""
        grid = next((grid for grid in self._grids if grid.header.label == header.label), None)
        if grid is None:
            raise VolumeError(f"{self.path}: no grid '{header.label}'")
        if grid.header.refusal is not None or grid.codec is None:
            raise VolumeError(
                f"{self.path}: grid '{header.label}': not supported: {grid.header.refusal}"
            )
        return Cursor(grid.codec.data, grid.root_at), grid.codec

    @contextmanager
    def _located(self, label: str | None = None) -> Iterator[None]:
        """Turn what goes wrong inside into a VolumeError that says in which file and grid."""
        where = str(self.path) + (f": grid '{label}'" if label is not None else "")
        try:
            yield
        except Damage as damage:
            raise VolumeError(f"{where}: at byte {damage.at}: {damage.what}") from damage
        except MemoryError as error:
            raise no_room(where, error) from error

    def _read_file_header(self, cursor: Cursor) -> None:
        if bytes(self._data[:7]) == b"NanoVDB":
            raise Damage(0, "a NanoVDB file, which is another format than OpenVDB")
        if len(self._data) < 8 or int.from_bytes(self._data[:8], "little") != MAGIC:
            raise Damage(0, "not an OpenVDB file")
        _, self.version, major, minor, offsets = cursor.unpack(_FILE, "the header")
        self.library_version: tuple[int, int] = (major, minor)
        if self.version not in VERSIONS:
            known = f"{VERSIONS[0]} to {VERSIONS[-1]} can be read"
            raise Damage(8, f"OpenVDB file version {self.version}, of which {known}")
        self._has_offsets = bool(offsets)
        self._file_compression = Compression(0)
        if self.version < HAS_BLOCK_MODE and cursor.take(1, "the header")[0]:
            self._file_compression = Compression.ZIP
        self.uuid: str = bytes(cursor.take(_UUID_BYTES, "the header")).decode("ascii", "replace")
        self.metadata: Mapping[str, Any] = _read_metadata(cursor)

    def _read_grids(self, cursor: Cursor) -> Iterator[_Grid]:
        count_at = cursor.at
        (count,) = cursor.unpack(_COUNT, "the number of grids")
        if not 0 <= count <= (cursor.end - cursor.at) // (_POSITIONS.size + 12):
            raise Damage(count_at, f"{count} grids in {cursor.end - cursor.at} bytes")
        for behind in reversed(range(count)):
            descriptor = self._read_descriptor(cursor)
            with self._located(descriptor.name):
                end = descriptor.end if self._has_offsets else cursor.end
                grid = self._read_grid_header(Cursor(self._data[:end], cursor.at), descriptor)
                cursor.at = descriptor.end if self._has_offsets else grid.root_at
                if behind and not self._has_offsets:
                    if not _can_skip(grid):
                        yield _end_of_stream(grid, behind)
                        return
                    if grid.codec is not None:
                        skip_tree(cursor, grid.codec)
            yield grid

    def _read_descriptor(self, cursor: Cursor) -> _Descriptor:
        name, type_name, parent = (cursor.string("the name of a grid") for _ in range(3))
        begin, blocks, end = cursor.unpack(_POSITIONS, "the position of a grid")
        if self._has_offsets:
            # An instance has no leaves, and OpenVDB writes any number for where they are.
            leaves_at = begin if parent else blocks
            if not cursor.at <= begin <= leaves_at <= end <= cursor.end:
                raise Damage(
                    cursor.at - _POSITIONS.size,
                    f"grid '{name[:60]}' from byte {begin} to {end}, with leaves from {blocks}; "
                    f"there is room from {cursor.at} to {cursor.end}",
                )
            cursor.at = begin
        return _Descriptor(name, type_name, parent, end)

    def _read_grid_header(self, cursor: Cursor, descriptor: _Descriptor) -> _Grid:
        """Read up to the table of the root, where ``cursor`` is left if the tree can be walked."""
        begin = cursor.at
        compression = self._file_compression
        if self.version >= HAS_BLOCK_MODE:
            word = cursor.uint32("the compression of a grid")
            if word > 7:
                raise Damage(cursor.at - 4, f"unknown compression {word:#x}")
            compression = Compression(word)
        metadata = _read_metadata(cursor)
        map_type, world_from_index, refusal = read_transform(cursor, self.version)
        half = bool(metadata.get("is_saved_as_half_float", False))
        value_type, kind, type_refusal = _value_type(descriptor.type_name)
        codec = background = None
        if kind is not None and not descriptor.parent and is_known(map_type):
            cursor.take(4, "the number of buffers")
            background = cursor.values(kind, 1, "the background")[0]
            codec = BlockCodec(
                cursor.data, self.version, compression, kind, half, np.asarray(background)
            )
            background = codec.background
        header = GridHeader(
            name=descriptor.name,
            label="",
            value_type=value_type,
            grid_class=str(metadata.get("class", "unknown")),
            map_type=map_type,
            world_from_index=world_from_index,
            background=background,
            active_voxels=declared_count(metadata),
            active_box=declared_box(metadata),
            stored=_describe_storage(compression, half),
            file_bytes=descriptor.end - begin if self._has_offsets else None,
            metadata=metadata,
            refusal=type_refusal or refusal,
        )
        return _Grid(header, descriptor, codec, cursor.at)


def _map_file(path: Path) -> memoryview:
    try:
        if path.exists() and not path.is_file():
            raise VolumeError(f"{path}: not a file")
        with path.open("rb") as file:
            if not path.stat().st_size:
                raise VolumeError(f"{path}: the file is empty")
            return memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
    except (OSError, ValueError) as error:
        raise VolumeError(f"{path}: {getattr(error, 'strerror', None) or error}") from error


def _read_metadata(cursor: Cursor) -> dict[str, Any]:
    count = cursor.uint32("the number of metadata")
    cursor.need(12 * count, f"{count} metadata")
    found = {}
    for _ in range(count):
        key = cursor.string("the name of a metadatum")
        type_name = cursor.string("the type of a metadatum")
        found[key] = _decode_metadatum(type_name, cursor.take(cursor.uint32(key), key))
    return found


def _decode_metadatum(type_name: str, raw: memoryview) -> Any:
    """A Python value: a scalar, a str, a tuple, a tuple of rows; bytes where the type is new."""
    if type_name == "string":
        return bytes(raw).decode("utf-8", "replace")
    layout = _METADATA_LAYOUTS.get(type_name)
    if layout is None or layout.size != len(raw):
        return bytes(raw)
    values = layout.unpack(raw)
    if type_name.startswith("mat"):
        rows = int(type_name[3])
        return tuple(values[i : i + rows] for i in range(0, len(values), rows))
    return values if type_name.startswith("vec") else values[0]


def _value_type(type_name: str) -> tuple[str, ValueType | None, str | None]:
    """Return the name of the type of a value, the type, and a refusal where it is not known."""
    match = _TYPE.fullmatch(type_name.removesuffix(_HALF_SUFFIX))
    if match is None:
        return type_name, None, f"grid of type {type_name[:60]!r}"
    name, configuration = match.groups()
    if name.startswith("pt"):
        return name, None, f"points grid ({name})"
    if name not in VALUE_TYPES:
        return name, None, f"values of type {name}"
    if configuration != _CONFIGURATION:
        return name, None, f"tree of configuration {configuration}"
    return name, VALUE_TYPES[name], None


def declared_count(metadata: Mapping[str, Any]) -> int | None:
    """The number of active voxels that a grid's metadata declare, true or not."""
    count = metadata.get("file_voxel_count")
    return count if isinstance(count, int) and count >= 0 else None


def declared_box(
    metadata: Mapping[str, Any],
) -> tuple[tuple[int, int, int], tuple[int, int, int]] | None:
    """The box of active voxels that a grid's metadata declare, true or not."""
    low, high = metadata.get("file_bbox_min"), metadata.get("file_bbox_max")
    if not (isinstance(low, tuple) and isinstance(high, tuple) and len(low) == len(high) == 3):
        return None
    if any(a > b for a, b in zip(low, high, strict=True)):
        return None  # how an empty grid is declared
    return low, high


def _describe_storage(compression: Compression, half: bool) -> str:
    names = {Compression.BLOSC: "blosc", Compression.ZIP: "zip"}
    names[Compression.ACTIVE_MASK] = "active mask"
    packing = " + ".join(name for bit, name in names.items() if compression & bit)
    return ("half, " if half else "") + (packing or "uncompressed")


def _can_skip(grid: _Grid) -> bool:
    """Whether the end of a grid can be found without offsets."""
    return grid.codec is not None or bool(grid.descriptor.parent and is_known(grid.header.map_type))


def _end_of_stream(grid: _Grid, behind: int) -> _Grid:
    """Say of a grid that cannot be walked in a file without offsets what it hides."""
    lost = f"{grid.header.refusal}; {behind} grids behind it cannot be found without offsets"
    return replace(grid, header=replace(grid.header, refusal=lost))


def _labelled(grids: list[_Grid]) -> list[_Grid]:
    labels = unique_labels([grid.header.name for grid in grids])
    return [
        replace(grid, header=replace(grid.header, label=label))
        for grid, label in zip(grids, labels, strict=True)
    ]


def _resolve_instances(grids: list[_Grid]) -> list[_Grid]:
    """Give each instance the tree of its parent, under the instance's own transform."""
    by_name = {grid.descriptor.unique_name: grid for grid in reversed(grids)}
    resolved = []
    for grid in grids:
        parent_name = grid.descriptor.parent
        if parent_name:
            parent = by_name.get(parent_name)
            if parent is None or parent.codec is None:
                reason = f"instance of {parent_name[:60]!r}, which has no tree to share"
                grid = replace(grid, header=replace(grid.header, refusal=reason))
            else:
                shared = replace(
                    grid.header,
                    value_type=parent.header.value_type,
                    background=parent.header.background,
                    stored=parent.header.stored,
                    file_bytes=parent.header.file_bytes,
                )
                grid = replace(grid, header=shared, codec=parent.codec, root_at=parent.root_at)
        resolved.append(grid)
    return resolved
