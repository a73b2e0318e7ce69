"""What every reader returns: headers of grids, and trees of leaves and tiles.

A reader (``vdb``, ``pyopenvdb``, ``dense``) turns a file into these; ``brick`` turns a `Tree` into
the form that the kernels walk. Nothing here knows a file format.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from volcli.grids.census import Census

Progress = Callable[[int, int], None]
"""Called as ``progress(done, total)`` while long work goes on."""

LEAF_WIDTH = 8
"""Voxels along an edge of a leaf."""

_LONGEST = 200  # characters of a name that are shown


@dataclass(frozen=True)
class GridHeader:
    """What a file says of one grid before any voxel is read.

    Attributes
    ----------
    name
        The grid's name in the file; may be empty, and need not be unique.
    label
        The name a user asks for it by, unique in the file: ``density``, ``density[1]``; a grid
        with no name is ``[0]``, ``[1]``, ...
    value_type
        OpenVDB's name of the type of a value: ``float``, ``double``, ``bool``, ``mask``, ``int32``,
        ``int64``, ``vec3s``, ``vec3d``, ``vec3i``; others are refused when read.
    grid_class
        ``fog volume``, ``level set``, ``staggered`` or ``unknown``.
    map_type
        OpenVDB's name of the transform: ``UniformScaleMap``, ..., ``NonlinearFrustumMap``.
    world_from_index
        (4, 4) float64, acting on column vectors (x, y, z, 1); None if the map is not linear.
    background
        The value outside all that is stored; None where the reader cannot know it.
    active_voxels, active_box
        As declared by the file's metadata, not checked: a count, and ((x, y, z), (x, y, z)) with
        both ends included. None where the file does not say.
    stored
        How the values lie in the file, for people: ``half, blosc + active mask``.
    file_bytes
        What the file holds of the grid, from its header to its last leaf; None where only reading
        it would tell.
    refusal
        Why volcli cannot read this grid ("points grid", ...); None when it can.
    """

    name: str
    label: str
    value_type: str
    grid_class: str
    map_type: str
    world_from_index: NDArray[np.float64] | None
    background: Any = None
    active_voxels: int | None = None
    active_box: tuple[tuple[int, int, int], tuple[int, int, int]] | None = None
    stored: str = ""
    file_bytes: int | None = None
    metadata: Mapping[str, Any] = field(default_factory=dict)
    refusal: str | None = None

    @property
    def is_vector(self) -> bool:
        """Whether a value has three components."""
        return self.value_type.startswith("vec3")


@dataclass(frozen=True)
class Tree:
    """The values of one grid as they lie in a tree: 8x8x8 leaves, and tiles of one value each.

    Every lattice point that no leaf and no tile covers has the value ``background``.

    Attributes
    ----------
    background
        () or (3,), in the grid's own dtype.
    leaf_origins
        (n, 3) int32, multiples of 8: the smallest lattice point of each leaf.
    leaf_values
        (n, 8, 8, 8) or (n, 8, 8, 8, 3), indexed x, y, z, in the grid's own dtype; bool and mask
        grids are uint8 (0 or 1).
    leaf_masks
        (n, 64) uint8: the active voxels, one bit each, in x-major order (bit ``(x*8 + y)*8 + z``,
        least significant first within a byte).
    tile_origins, tile_widths, tile_values, tile_active
        (m, 3) int32, (m,) int32 (8, 128 or 4096), (m,) or (m, 3), (m,) bool. Tiles that are
        inactive and hold the background are left out.
    """

    background: NDArray[Any]
    leaf_origins: NDArray[np.int32]
    leaf_values: NDArray[Any]
    leaf_masks: NDArray[np.uint8]
    tile_origins: NDArray[np.int32]
    tile_widths: NDArray[np.int32]
    tile_values: NDArray[Any]
    tile_active: NDArray[np.bool_]


def unique_labels(names: Sequence[str]) -> list[str]:
    """Label grids: a unique name as it is, others with their number among those of one name."""
    shown = [_shown(name) for name in names]
    taken = {name for name, uses in Counter(shown).items() if name and uses == 1}
    number: Counter[str] = Counter()
    labels = []
    for name in shown:
        label = name
        if name not in taken:
            while (label := f"{name}[{number[name]}]") in taken:
                number[name] += 1
            number[name] += 1
        labels.append(label)
    return labels


def _shown(name: str) -> str:
    """A name fit for a terminal and for one line: nothing that a terminal would obey."""
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in name[:_LONGEST])


class Volume(Protocol):
    """An opened file: its headers are read, its voxels are not."""

    @property
    def path(self) -> Path:
        """The file."""
        ...

    @property
    def headers(self) -> tuple[GridHeader, ...]:
        """One for each grid, in the order of the file."""
        ...

    def census(self, header: GridHeader) -> Census:
        """How much memory a grid will take, without reading its values.

        Raises
        ------
        VolumeError
            As `read_tree`.
        """
        ...

    def read_tree(self, header: GridHeader, progress: Progress | None = None) -> Tree:
        """Read the voxels of one grid.

        Raises
        ------
        VolumeError
            If the grid is refused (``header.refusal``) or the file is damaged.
        """
        ...
