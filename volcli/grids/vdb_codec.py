"""Primitives of the OpenVDB file format: a cursor that believes no length, and blocks of values.

A *block* is how the format stores the values of one node (8^3, 16^3 or 32^3 of them):

    int8   mode                 0 to 6, see `Mode`; absent before version 222
    value  inactive x 0, 1, 2   in the grid's full type, even where the rest is half
    bits   selection            which of two inactive values, one bit each; modes 3, 4 and 5
    int64  length               absent without zip and blosc; n <= 0: -n bytes follow as they are
    bytes  data                 all values, or with the active-mask bit only the active ones

Nothing here knows a tree, a header or the name of a file.
"""

from __future__ import annotations

import itertools
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from struct import Struct
from typing import Any

import numpy as np
from blosc.blosc_extension import decompress_ptr
from numpy.typing import NDArray

HAS_BLOCK_MODE = 222
"""First file version with a mode byte in blocks and a compression word for each grid."""

_INT64 = Struct("<q")
_UINT32 = Struct("<I")
_BLOSC_SIZES = Struct("<4x3i")  # of a blosc header: bytes unpacked, of a block, packed
_BLOSC_HEADER = 16
_LEAF_MASK = 64  # bytes


class Damage(Exception):
    """The bytes at ``at`` cannot be right. Whoever knows the file and the grid adds their names."""

    def __init__(self, at: int, what: str) -> None:
        super().__init__(what)
        self.at = at
        self.what = what


class Compression(IntFlag):
    """The compression word of a grid."""

    ZIP = 1
    ACTIVE_MASK = 2
    BLOSC = 4


class Mode(IntEnum):
    """What stands for the inactive values of a block."""

    BACKGROUND = 0
    NEGATED = 1
    ONE_VALUE = 2
    SELECT_BACKGROUND = 3  # the bit picks the background, else its negative
    SELECT_ONE_VALUE = 4  # the bit picks the background, else the value
    SELECT_TWO_VALUES = 5  # the bit picks the second value, else the first
    ALL_STORED = 6


_VALUES_OF_MODE = (0, 0, 1, 0, 1, 2, 0)
_SELECTION_OF_MODE = (0, 0, 0, 1, 1, 1, 0)


@dataclass(frozen=True)
class ValueType:
    """A type of value: ``stored`` in a file, and ``dtype`` in memory (they differ for half)."""

    name: str
    stored: np.dtype[Any]
    dtype: np.dtype[Any]
    shape: tuple[int, ...] = ()

    @property
    def components(self) -> int:
        return self.shape[0] if self.shape else 1

    @property
    def stored_bytes(self) -> int:
        return self.stored.itemsize * self.components


VALUE_TYPES = {
    name: ValueType(name, np.dtype(stored), np.dtype(dtype), shape)
    for name, stored, dtype, shape in (
        ("float", "<f4", "<f4", ()),
        ("double", "<f8", "<f8", ()),
        ("half", "<f2", "<f4", ()),
        ("bool", "u1", "u1", ()),
        ("mask", "u1", "u1", ()),
        ("int32", "<i4", "<i4", ()),
        ("int64", "<i8", "<i8", ()),
        ("vec3s", "<f4", "<f4", (3,)),
        ("vec3d", "<f8", "<f8", (3,)),
        ("vec3i", "<i4", "<i4", (3,)),
    )
}
"""The types of value that can be read, by OpenVDB's name."""


class Cursor:
    """A place in the bytes of a file. Every step is checked against what is left of them."""

    def __init__(self, data: memoryview, at: int = 0) -> None:
        self.data = data
        self.end = len(data)
        self.at = at
        if not 0 <= at <= self.end:
            raise Damage(at, f"a position outside the file's {self.end} bytes")

    def need(self, size: int, what: str) -> None:
        """Refuse to go on unless ``size`` bytes are left."""
        left = self.end - self.at
        if size > left:
            raise Damage(self.at, f"{what}: {size} bytes needed, {left} left; is the file cut off?")

    def take(self, size: int, what: str) -> memoryview:
        """Return the next ``size`` bytes, without copying them."""
        self.need(size, what)
        start = self.at
        self.at = start + size
        return self.data[start : self.at]

    def unpack(self, layout: Struct, what: str) -> tuple[Any, ...]:
        return layout.unpack(self.take(layout.size, what))

    def uint32(self, what: str) -> int:
        return self.unpack(_UINT32, what)[0]

    def string(self, what: str) -> str:
        """A uint32 length and so many bytes of UTF-8."""
        return bytes(self.take(self.uint32(what), what)).decode("utf-8", "replace")

    def values(self, kind: ValueType, count: int, what: str) -> NDArray[Any]:
        """Values in their full type, uncompressed: (count, ...) in the type of the file."""
        raw = np.frombuffer(self.take(kind.stored_bytes * count, what), kind.stored)
        return raw.reshape(count, *kind.shape)


def unpack_bits(packed: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Masks of (n, size / 8) bytes as (n, size) bool; the first bit is the least significant."""
    return np.unpackbits(packed, axis=1, bitorder="little").view(np.bool_)


Block = tuple[int, int, int, int, int]
"""Where a block lies: mode, position of what follows the mode byte, count of values stored,
position of the data, and length as in the file (<= 0: so many bytes, uncompressed)."""


class BlockCodec:
    """Finds and unpacks the blocks of one grid.

    Parameters
    ----------
    data
        The bytes of the file.
    version
        The version of the file.
    compression
        The compression word of the grid.
    kind
        The type of its values.
    half
        Whether its blocks hold half floats.
    background
        The grid's background, () or (3,), in the type of the file.
    """

    def __init__(
        self,
        data: memoryview,
        version: int,
        compression: Compression,
        kind: ValueType,
        half: bool,
        background: NDArray[Any],
    ) -> None:
        self.data = data
        self.end = len(data)
        self.kind = kind
        self.version = version
        self.background = np.asarray(self.to_memory(background))
        self.has_mode = version >= HAS_BLOCK_MODE
        self.masked = self.has_mode and bool(compression & Compression.ACTIVE_MASK)
        self.blosc = bool(compression & Compression.BLOSC)
        self.has_length = bool(compression & (Compression.BLOSC | Compression.ZIP))
        self.half = half and kind.stored.kind == "f"
        self.packed_dtype = np.dtype("<f2") if self.half else kind.stored
        self.packed_bytes = self.packed_dtype.itemsize * kind.components
        # Blosc undoes the 2 kB of a leaf in a microsecond: threads cost each other more than that.
        self.gains_from_threads = bool(compression & Compression.ZIP) and not self.blosc
        self.fixed_leaf_bytes = {"bool": 140, "mask": 76}.get(kind.name)

    def locate(self, at: int, size: int, active: int) -> Block:
        """Find the parts of the block of ``size`` values at ``at``, ``active`` of them active."""
        mode = 6
        if self.has_mode:
            if at >= self.end:
                raise Damage(at, "the file ends before the values of a node")
            mode = self.data[at]
            at += 1
            if mode > 6:
                raise Damage(at - 1, f"{mode} is no way to store inactive values (0 to 6)")
        extra_at = at
        if mode:
            at += _VALUES_OF_MODE[mode] * self.kind.stored_bytes
            at += _SELECTION_OF_MODE[mode] * (size >> 3)
        count = active if self.masked and mode != 6 else size
        length = -count * self.packed_bytes
        # OpenVDB's reader of half floats expects no length where there are no values.
        if self.has_length and (count or not self.half):
            if at + 8 > self.end:
                raise Damage(at, "the file ends before the values of a node")
            raw, length = length, _INT64.unpack_from(self.data, at)[0]
            if length <= 0 and length != raw:
                raise Damage(at, f"{-length} bytes of values where the node has {-raw}")
            at += 8
        if at + abs(length) > self.end:
            raise Damage(at, f"{abs(length)} bytes of values, {max(self.end - at, 0)} left")
        return mode, extra_at, count, at, length

    def locate_leaves(self, at: int, count: int) -> tuple[list[int], list[Block], int] | None:
        """Find masks and blocks of the leaves at ``at``, and where they end; None: ask `locate`.

        Steps from length to length and checks them afterwards, all at once. None where blocks have
        no length, or something is wrong, so that `locate` says what and where.
        """
        if not (self.has_mode and self.has_length):
            return None
        data, value_at = self.data, _INT64.unpack_from
        extra = [
            values * self.kind.stored_bytes + selection * _LEAF_MASK
            for values, selection in zip(_VALUES_OF_MODE, _SELECTION_OF_MODE, strict=True)
        ]
        may_lack_length, inactive = self.half and self.masked, bytes(_LEAF_MASK)
        masks_at, modes, data_at, lengths = [], [], [], []
        try:
            for _ in range(count):
                masks_at.append(at)
                mode_at = at + _LEAF_MASK
                mode = data[mode_at]
                at = mode_at + 1 + extra[mode]
                length = 0
                if (
                    not may_lack_length
                    or mode == 6
                    or data[mode_at - _LEAF_MASK : mode_at] != inactive
                ):
                    length = value_at(data, at)[0]
                    at += 8
                modes.append(mode)
                data_at.append(at)
                lengths.append(length)
                at += abs(length)
        except (IndexError, struct.error):
            return None
        if at > self.end:
            return None
        stored = np.full(count, 8 * _LEAF_MASK)
        if self.masked:
            masks = self.gather(np.array(masks_at), _LEAF_MASK).view(np.uint64)
            active = np.bitwise_count(masks).sum(axis=1, dtype=np.int64)
            stored = np.where(np.array(modes) == Mode.ALL_STORED, stored, active)
        found = np.array(lengths)
        if ((found <= 0) & (found != -stored * self.packed_bytes)).any():
            return None
        extra_at = [mask_at + _LEAF_MASK + 1 for mask_at in masks_at]
        blocks = zip(modes, extra_at, stored.tolist(), data_at, lengths, strict=True)
        return masks_at, list(blocks), at

    def read(self, blocks: Sequence[Block], active: NDArray[np.bool_], out: NDArray[Any]) -> None:
        """Unpack blocks of one size into ``out``, (n, size) or (n, size, 3).

        ``active`` is (n, size). Blocks that store all values, in their own type, are unpacked in
        place; what the others store goes side by side into a scratch array first.
        """
        counts = np.array([block[2] for block in blocks])
        whole = counts == active.shape[1]
        if whole.any() and self.packed_dtype == out.dtype and out.flags.c_contiguous:
            row_bytes = out.nbytes // len(out)
            self._unpack(_chosen(blocks, whole), out, np.flatnonzero(whole) * row_bytes)
            rest = np.flatnonzero(~whole)
            if len(rest):
                values = np.empty_like(out, shape=(len(rest), *out.shape[1:]))
                self.read(_chosen(blocks, ~whole), active[rest], values)
                out[rest] = values
            return
        packed = np.empty((counts.sum(), *self.kind.shape), self.packed_dtype)
        self._unpack(blocks, packed, (np.cumsum(counts) - counts) * self.packed_bytes)
        if whole.all():
            out[...] = packed.reshape(out.shape)
            return
        modes = np.array([block[0] for block in blocks])
        self._fill_inactive(blocks, modes, out)
        out[active | (modes == Mode.ALL_STORED)[:, None]] = packed

    def _unpack(
        self, blocks: Sequence[Block], packed: NDArray[Any], places: NDArray[np.int64]
    ) -> None:
        """Decompress the data of blocks into ``packed``, each from the byte at its place on."""
        data, item = self.data, self.packed_bytes
        target = packed.reshape(-1).view(np.uint8)
        address = target.ctypes.data
        view = memoryview(target)
        for (_, _, count, at, length), done in zip(blocks, places.tolist(), strict=True):
            size = count * item
            if length <= 0:
                view[done : done + size] = data[at : at + size]
            elif self.blosc:
                _blosc_into(data, at, length, address + done, size)
            else:
                view[done : done + size] = _unzip(data[at : at + length], size, at)

    def _fill_inactive(
        self, blocks: Sequence[Block], modes: NDArray[Any], out: NDArray[Any]
    ) -> None:
        """Give every value of ``out`` what it is if it turns out to be inactive."""
        if not modes.any():
            out[...] = self.background
            return
        kind = self.kind
        extra_at = np.array([block[1] for block in blocks])
        first = np.broadcast_to(self.background, (len(blocks), *kind.shape)).copy()
        second = first.copy()
        negated = (modes == Mode.NEGATED) | (modes == Mode.SELECT_BACKGROUND)
        first[negated] = self._negative_background()
        two = modes == Mode.SELECT_TWO_VALUES
        given = two | (modes == Mode.ONE_VALUE) | (modes == Mode.SELECT_ONE_VALUE)
        first[given] = self._values_at(extra_at[given])
        second[two] = self._values_at(extra_at[two] + kind.stored_bytes)
        per_value = (slice(None), None)
        out[...] = first[per_value]
        rows = np.flatnonzero(np.take(_SELECTION_OF_MODE, modes))
        if rows.size:
            values_before = np.take(_VALUES_OF_MODE, modes[rows])
            bits_at = extra_at[rows] + values_before * kind.stored_bytes
            bits = unpack_bits(self.gather(bits_at, out.shape[1] >> 3))
            bits = bits.reshape(*bits.shape, *(1,) * len(kind.shape))
            out[rows] = np.where(bits, second[rows][per_value], first[rows][per_value])

    def gather(self, at: NDArray[np.int64], size: int) -> NDArray[np.uint8]:
        """The ``size`` bytes at each of n positions: (n, size)."""
        windows = np.lib.stride_tricks.sliding_window_view(np.frombuffer(self.data, np.uint8), size)
        return windows[at]

    def _values_at(self, at: NDArray[np.int64]) -> NDArray[Any]:
        raw = self.gather(at, self.kind.stored_bytes).view(self.kind.stored)
        return self.to_memory(raw.reshape(len(at), *self.kind.shape))

    def to_memory(self, values: NDArray[Any]) -> NDArray[Any]:
        """Values of the file's type in the type that they have in memory."""
        return (values != 0).view(np.uint8) if self.is_bool else values.astype(self.kind.dtype)

    @property
    def is_bool(self) -> bool:
        return self.kind.dtype == np.uint8

    def _negative_background(self) -> NDArray[Any]:
        return 1 - self.background if self.is_bool else -np.atleast_1d(self.background)


def _chosen(blocks: Sequence[Block], which: NDArray[np.bool_]) -> list[Block]:
    return list(itertools.compress(blocks, which.tolist()))


def _blosc_into(data: memoryview, at: int, length: int, address: int, size: int) -> None:
    """Decompress the blosc chunk at ``at`` to ``address``, where there is room for ``size``."""
    if length < _BLOSC_HEADER:
        raise Damage(at, f"a blosc chunk of {length} bytes")
    unpacked, _, packed = _BLOSC_SIZES.unpack_from(data, at)
    if unpacked != size or packed > length:
        raise Damage(at, f"a blosc chunk of {unpacked} bytes where the node has {size}")
    try:
        written = decompress_ptr(data[at : at + packed], address)
    except Exception as error:  # the type is not public
        raise Damage(at, "a blosc chunk that cannot be decompressed") from error
    if written != size:
        raise Damage(at, f"a blosc chunk of {written} bytes where the node has {size}")


def _unzip(chunk: memoryview, size: int, at: int) -> bytes:
    """Inflate one zlib stream that must hold ``size`` bytes, never making more than one more."""
    stream = zlib.decompressobj()
    try:
        values = stream.decompress(chunk, size + 1)
    except zlib.error as error:
        raise Damage(at, "a zip stream that cannot be decompressed") from error
    if len(values) != size or not stream.eof:
        raise Damage(at, f"a zip stream of another size than the node's {size} bytes")
    return values
