"""`BrickGrid`: the sparse form of a grid that the kernels walk; ``build`` makes it of a `Tree`.

The field of a grid is trilinear between lattice points, so the unit of work is a **cell**: the cube
between eight lattice points. A **brick** is 8x8x8 cells with all 9x9x9 values at their corners, so
that a cell never needs a neighbour's data. A leaf's values reach one voxel further than the leaf:
the cells just below it, its *skirt*, blend from the outside to the leaf's first layer, and lie in
the bricks below. Leaving them out is the classic error.

Three levels of tables lead to a brick, as in the file: cells of 4096 voxels at the root, 32^3
blocks of 128 voxels in each, 16^3 bricks in each of those. An entry is a child (>= 0) or a constant
(``-1 - k``, the value ``constants[k]``); constant 0 is the background. A region that is constant
is one entry at the highest level that can hold it, so a tile is never voxelised inside. Between
blocks and bricks, ``occupied`` tells which macro cells of 32 voxels hold anything but background.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

FORMAT = 2
"""Goes up with every change of what `build` makes of a tree: bricks kept in a cache then do too."""

BRICK = 8
APRON = BRICK + 1
LOWER = 16
UPPER = 32
ROOT_WIDTH = BRICK * LOWER * UPPER

CORNERS = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)])
"""The eight corners of a cell; a signature lists its entries in this order."""

BACKGROUND = -1
"""The entry of the constant 0."""


class BrickArrays(NamedTuple):
    """The arrays of a `BrickGrid` as the kernels take them; local voxels count from ``origin``.

    Attributes
    ----------
    atlas
        (n, 729) or (n, 729, 3) float32: the values of each brick, index ``(x*9 + y)*9 + z``.
    constants
        (k,) or (k, 3) float32.
    lower
        (l, 4096) int32: entries of bricks, index ``(x*16 + y)*16 + z``.
    occupied
        (l,) int64: which of the 4^3 macro cells (4^3 bricks each) of a lower node hold anything but
        background: bit ``(x*4 + y)*4 + z``.
    upper
        (u, 32768) int32: entries of lower nodes, index ``(x*32 + y)*32 + z``.
    root_keys, root_entries
        (r,) int64 sorted, (r,) int32: the root cells that are not background; a key is
        ``(i*ny + j)*nz + k`` over the intervals between the planes.
    planes_x, planes_y, planes_z
        float64: where root cells begin and end, in local voxels. Gaps between far parts of a
        volume are one interval each, whatever their width.
    """

    atlas: NDArray[np.float32]
    constants: NDArray[np.float32]
    lower: NDArray[np.int32]
    occupied: NDArray[np.int64]
    upper: NDArray[np.int32]
    root_keys: NDArray[np.int64]
    root_entries: NDArray[np.int32]
    planes_x: NDArray[np.float64]
    planes_y: NDArray[np.float64]
    planes_z: NDArray[np.float64]


@dataclass(frozen=True)
class BrickGrid:
    """A grid, ready to be walked.

    Attributes
    ----------
    arrays
        What the kernels take.
    origin
        (3,) int64, index space: the lattice point that local voxels count from.
    world_from_index
        (4, 4) float64.
    active_box
        (2, 3) int64, index space: the smallest and largest lattice point that is active or differs
        from the background; ``lo > hi`` when there is none.
    active_range
        Smallest and largest value of what is active; None where nobody asked.
    """

    arrays: BrickArrays
    origin: NDArray[np.int64]
    world_from_index: NDArray[np.float64]
    active_box: NDArray[np.int64]
    active_range: tuple[float, float] | None = None

    @property
    def is_empty(self) -> bool:
        """Whether nothing differs from the background."""
        return bool((self.active_box[0] > self.active_box[1]).any())

    @property
    def background(self) -> NDArray[np.float32]:
        """() or (3,): the value outside all that is stored."""
        return self.arrays.constants[0]

    @property
    def nbytes(self) -> int:
        """Bytes held."""
        return sum(array.nbytes for array in self.arrays)

    @cached_property
    def field_range(self) -> tuple[float, float]:
        """Smallest and largest value of the field, of any channel, the background included."""
        parts = (self.arrays.atlas, self.arrays.constants)
        used = [part for part in parts if part.size]
        return min(float(part.min()) for part in used), max(float(part.max()) for part in used)

    @property
    def brightest(self) -> float:
        """The largest magnitude of any value."""
        low, high = self.field_range
        return max(-low, high)

    @property
    def local_from_world(self) -> NDArray[np.float64]:
        """(3, 4): from world units to local voxels."""
        m = np.linalg.inv(self.world_from_index)[:3].astype(np.float64)
        m[:, 3] -= self.origin
        return m

    def support(self, interpolation: str) -> NDArray[np.float64]:
        """(2, 3): the box, in local voxels, beyond which the field is the background.

        A lattice point reaches one voxel to each side when values are blended (``linear``), half a
        voxel when they are not (``nearest``).
        """
        reach = 1.0 if interpolation == "linear" else 0.5
        box = (self.active_box - self.origin).astype(np.float64)
        return box + np.array([[-reach], [reach]])

    def world_box(self) -> NDArray[np.float64]:
        """(2, 3): the axis-aligned box in world units around the active lattice points."""
        return to_world(self.active_box, self.world_from_index)


def to_world(box: NDArray[Any], world_from_index: NDArray[np.float64]) -> NDArray[np.float64]:
    """(2, 3): the axis-aligned box in world units around a box (2, 3) of index space."""
    corners = np.where(CORNERS, box[1], box[0]).astype(np.float64)
    world = corners @ world_from_index[:3, :3].T + world_from_index[:3, 3]
    return np.array([world.min(axis=0), world.max(axis=0)])
