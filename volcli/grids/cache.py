"""A folder of bricks that were built before: the second load of a grid is a memory map.

One file a grid:

    header     one line, padded to 64 bytes: CRC, JSON (places of arrays, their sum, warnings, ...)
    arrays     as they lie in memory, each from a multiple of 64 bytes

Its name is the hash of what the bricks come from: the file, the grid, how values were settled, and
`brick.FORMAT`. The file counts with its size, its time of change in ns, and its first and last MiB
(an OpenVDB file begins with an identifier, new whenever it is written), not with where it lies. To
hash all of it would take far longer than a second load; so a change to the middle of a file that
keeps size and time is not noticed.

An entry is written under another name, then moved into place. A damaged one is built anew: its
bytes are added up first, at memory's speed, for a wrong table would lead a kernel out of its
arrays. Nothing here is ever deleted but what a killed writer left; the folder may be.
"""

from __future__ import annotations

import hashlib
import json
import mmap
import os
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from volcli.errors import VolumeError
from volcli.grids.brick import FORMAT, BrickArrays, BrickGrid
from volcli.leftovers import temporary_name

Loaded = tuple[BrickGrid, list[str]]

_ALIGNED, _ENDS, _MAX_HEADER = 64, 1 << 20, 1 << 20


def through_cache(
    folder: Path, source: Path, label: str, settings: tuple[str, ...], load: Callable[[], Loaded]
) -> Loaded:
    """Bricks and warnings out of the cache, or of ``load``, which then go into the cache.

    Parameters
    ----------
    folder
        Made if it is not there. That it cannot be read or written is a warning, no error.
    source, label, settings
        The file and the grid that the bricks come from, and what else they depend on.
    """
    where, notes = f"{source}: grid '{label}': ", []
    name = _name(source, label, *settings)
    entry = folder / f"{name}.bricks"
    try:
        grid, warnings = _read(entry)
        return grid, [where + warning for warning in warnings]
    except (FileNotFoundError, NotADirectoryError):
        pass  # the latter is said when it is written
    except (OSError, ValueError, KeyError, TypeError) as error:
        reason = getattr(error, "strerror", None) or f"damaged ({error})"
        notes.append(f"{entry}: cannot be used: {reason}; building the bricks anew")
    grid, warnings = load()
    if _name(source, label, *settings) == name:  # else it was changed while it was read
        try:
            folder.mkdir(parents=True, exist_ok=True)
            _write(entry, grid, [warning.removeprefix(where) for warning in warnings])
        except OSError as error:
            notes.append(f"{folder}: the cache cannot be written: {error.strerror or error}")
    return grid, warnings + notes


def _name(source: Path, *settings: str) -> str:
    """The name of an entry: see the top of this file."""
    try:
        with source.open("rb") as file:
            status = os.fstat(file.fileno())
            start = file.read(_ENDS)
            file.seek(max(status.st_size - _ENDS, 0))
            ends = hashlib.sha256(start + file.read(_ENDS)).hexdigest()
    except OSError as error:
        raise VolumeError(f"{source}: cannot be read: {error.strerror or error}") from error
    parts = [FORMAT, status.st_size, status.st_mtime_ns, ends, *settings]
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:32]


def _write(entry: Path, grid: BrickGrid, warnings: list[str]) -> None:
    """Write an entry, whole or not at all."""
    at, places = 0, {}
    for name, array in grid.arrays._asdict().items():
        places[name] = (array.dtype.str, array.shape, at)
        at += array.nbytes + -array.nbytes % _ALIGNED
    data = [np.ascontiguousarray(array).reshape(-1).view(np.uint8) for array in grid.arrays]
    described = {
        "arrays": places,
        "bytes": at,
        "sum": sum(map(_sum, data)) % 2**64,
        "origin": grid.origin.tolist(),
        "world_from_index": grid.world_from_index.tolist(),
        "active_box": grid.active_box.tolist(),
        "active_range": grid.active_range,
        "warnings": warnings,
    }
    header = json.dumps(described).encode()
    text = b"%08x %s" % (zlib.crc32(header), header)
    temporary = temporary_name(entry)
    try:
        with temporary.open("xb") as file:
            file.write(text + b"\n".rjust(_ALIGNED - len(text) % _ALIGNED))
            for part in data:
                file.write(part)
                file.write(bytes(-len(part) % _ALIGNED))
        temporary.replace(entry)
    finally:
        temporary.unlink(missing_ok=True)


def _read(entry: Path) -> Loaded:
    """Map an entry; an error (see `through_cache`) where it is not what was written."""
    with entry.open("rb") as file:
        text = file.readline(_MAX_HEADER)
        if int(text[:8], 16) != zlib.crc32(text[9:].rstrip()):
            raise ValueError("its header has changed")
        # A private copy that may be written to: read-only arrays are another type to the kernels,
        # which would be compiled once more for them.
        mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY)
    described = json.loads(text[9:])
    if len(mapped) != len(text) + described["bytes"]:
        raise ValueError("its size has changed")
    if _sum(np.frombuffer(mapped, np.uint8, offset=len(text))) != described["sum"]:
        raise ValueError("its values have changed")
    arrays: dict[str, NDArray[Any]] = {
        name: np.ndarray(shape, dtype, mapped, len(text) + at)
        for name, (dtype, shape, at) in described["arrays"].items()
    }
    grid = BrickGrid(
        BrickArrays(**arrays),
        np.array(described["origin"], np.int64),
        np.array(described["world_from_index"], np.float64),
        np.array(described["active_box"], np.int64),
        None if described["active_range"] is None else tuple(described["active_range"]),
    )
    return grid, described["warnings"]


def _sum(data: NDArray[np.uint8]) -> int:
    """The sum of bytes as words of eight, modulo 2^64; zeros behind them do not count."""
    words, rest = data[: len(data) & ~7], data[len(data) & ~7 :]
    return (int(words.view(np.uint64).sum()) + int.from_bytes(rest.tobytes(), "little")) % 2**64
