"""A grid along a ray: where one polynomial ends and the next begins, and its values between.

Between two lattice planes that the ray crosses, a grid's field is trilinear in one cell. All cells
of a ray are looked up at once, and evaluated at once. The structure of a `BrickGrid`, which is
searched here from the root down, is explained in `volcli.grids.brick`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from volcli.grids.brick import APRON, BACKGROUND, BRICK, LOWER, UPPER, BrickGrid

Floats = NDArray[np.float64]

BLOCK = BRICK * LOWER

_CORNERS = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)])


@dataclass(frozen=True)
class Line:
    """A ray in local voxels of a grid, o + t d, with t in world units from where counting begins.

    With nearest-voxel interpolation it is moved by half a voxel, so that voxel (i, j, k) fills the
    cell (i, j, k).
    """

    grid: BrickGrid
    nearest: bool
    o: Floats
    d: Floats

    @property
    def span(self) -> tuple[float, float]:
        """(near, far): where the ray is in the grid's support; near > far where it misses it."""
        box = self.grid.support("nearest" if self.nearest else "linear")
        lo, hi = box + (0.5 if self.nearest else 0.0)
        near, far = 0.0, np.inf
        for axis in range(3):
            if self.d[axis] == 0.0:
                if not lo[axis] <= self.o[axis] <= hi[axis]:
                    return 1.0, 0.0
                continue
            ends = sorted((edge[axis] - self.o[axis]) / self.d[axis] for edge in (lo, hi))
            near, far = max(near, ends[0]), min(far, ends[1])
        return float(near), float(far)

    def moved(self, t: float) -> Line:
        """The same line with t counted from there."""
        return Line(self.grid, self.nearest, self.o + t * self.d, self.d)


def make_line(grid: BrickGrid, nearest: bool, origin: Floats, direction: Floats) -> Line:
    """The `Line` of a ray in world units."""
    m = grid.local_from_world
    o = m[:, :3] @ origin + m[:, 3] + (0.5 if nearest else 0.0)
    return Line(grid, nearest, o, m[:, :3] @ direction)


def cuts(line: Line, t0: float, t1: float) -> Floats:
    """(n,): t0, t1 and, ascending, every t between at which the field's polynomial may change.

    A region of one constant is not cut inside, whatever its width.
    """
    arrays = line.grid.arrays
    found = np.array([t0, t1])
    planes = (arrays.planes_x, arrays.planes_y, arrays.planes_z)
    found = _with(found, [_crossings(line, a, planes[a], t0, t1) for a in range(3)])
    for width, level in ((BLOCK, "upper"), (BRICK, "lower"), (1, "atlas")):
        divided = entries(line, _middles(found), level) >= 0
        extra = [
            _crossings(line, axis, _multiples(line, axis, a, b, width), a, b)
            for a, b in zip(found[:-1][divided], found[1:][divided], strict=True)
            for axis in range(3)
        ]
        found = _with(found, extra)
    return found


def entries(line: Line, t: Floats, level: str = "atlas") -> NDArray[np.int64]:
    """(n,): what stands at distances t: a node of ``level`` (>= 0), or a constant (< 0).

    ``level`` is ``upper``, ``lower`` or ``atlas`` (bricks): a constant may stand higher up.
    """
    arrays = line.grid.arrays
    voxel = np.floor(line.o + t[:, None] * line.d).astype(np.int64)
    found = _root_entries(arrays, voxel)
    if level == "upper":
        return found
    found = _descend(found, arrays.upper, voxel // BLOCK % UPPER, UPPER)
    if level == "lower":
        return found
    return _descend(found, arrays.lower, voxel // BRICK % LOWER, LOWER)


@dataclass(frozen=True)
class Field:
    """A field along a line, cell by cell.

    Attributes
    ----------
    begin, end
        (n,): the intervals of the line, each within one cell.
    entry
        (n,): the brick or the constant of each.
    voxel
        (n, 3): the lowest local voxel of each cell.
    corners
        (n, 8) or (n, 8, 3): the values at its corners, z fastest; eight times the same for a
        constant and for nearest-voxel interpolation.
    inside
        (n,): whether the interval is within the grid's support.
    """

    line: Line
    begin: Floats
    end: Floats
    entry: NDArray[np.int64]
    voxel: NDArray[np.int64]
    corners: Floats
    inside: NDArray[np.bool_]

    def at(self, t: Floats) -> Floats:
        """(n, m) distances, a row for each interval, to (n, m) or (n, m, 3) values."""
        p = self.line.o + t[..., None] * self.line.d - self.voxel[:, None]
        sides = np.where(_CORNERS, p[..., None, :], 1 - p[..., None, :])
        weights = sides.prod(axis=-1)  # (n, m, 8)
        constant = (self.entry < 0) | self.line.nearest
        weights[constant] = np.eye(1, 8)
        return np.einsum("nmc,nc...->nm...", weights, self.corners)

    def rows(self, index: NDArray[np.int64], begin: Floats, end: Floats) -> Field:
        """The field on other intervals, each a part of the one that ``index`` names."""
        return Field(
            self.line,
            begin,
            end,
            self.entry[index],
            self.voxel[index],
            self.corners[index],
            self.inside[index],
        )


def field_along(line: Line, t: Floats) -> Field:
    """The field on the intervals between ascending t, each of which lies within one cell."""
    arrays = line.grid.arrays
    middle = _middles(t)
    voxel = np.floor(line.o + middle[:, None] * line.d).astype(np.int64)
    entry = entries(line, middle)
    atlas = arrays.atlas.reshape(len(arrays.atlas), APRON, APRON, APRON, *arrays.atlas.shape[2:])
    corners = np.empty((len(middle), 8, *arrays.atlas.shape[2:]))
    stored = entry >= 0
    at = voxel[stored] % BRICK
    for c, corner in enumerate(_CORNERS * (not line.nearest)):
        x, y, z = (at + corner).T
        corners[stored, c] = atlas[entry[stored], x, y, z]
    corners[~stored] = arrays.constants[-1 - entry[~stored]][:, None]
    near, far = line.span
    inside = (middle > near) & (middle < far)
    return Field(line, t[:-1], t[1:], entry, voxel, corners, inside)


def _root_entries(arrays: Any, voxel: NDArray[np.int64]) -> NDArray[np.int64]:
    planes = (arrays.planes_x, arrays.planes_y, arrays.planes_z)
    cell = [np.searchsorted(p, voxel[:, a], side="right") - 1 for a, p in enumerate(planes)]
    counts = [len(p) - 1 for p in planes]
    known = np.all([(c >= 0) & (c < n) for c, n in zip(cell, counts, strict=True)], axis=0)
    key = (cell[0] * counts[1] + cell[1]) * counts[2] + cell[2]
    at = np.minimum(np.searchsorted(arrays.root_keys, key), max(len(arrays.root_keys) - 1, 0))
    found = np.full(len(voxel), BACKGROUND, np.int64)
    if len(arrays.root_keys):
        known &= arrays.root_keys[at] == key
        found[known] = arrays.root_entries[at[known]]
    return found


def _descend(
    entry: NDArray[np.int64], table: NDArray[np.int32], child: NDArray[np.int64], width: int
) -> NDArray[np.int64]:
    """The entries one level down: of nodes their children's, of constants themselves."""
    found = entry.copy()
    node = entry >= 0
    x, y, z = child[node].T
    found[node] = table[entry[node], (x * width + y) * width + z]
    return found


def _crossings(line: Line, axis: int, planes: Floats, t0: float, t1: float) -> Floats:
    """Where the line crosses planes of one axis, strictly between t0 and t1."""
    if line.d[axis] == 0.0:
        return np.empty(0)
    t = (planes - line.o[axis]) / line.d[axis]
    return t[(t > t0) & (t < t1)]


def _multiples(line: Line, axis: int, t0: float, t1: float, width: int) -> Floats:
    """The multiples of a width between two points of the line, along one axis."""
    ends = sorted(line.o[axis] + t * line.d[axis] for t in (t0, t1))
    return np.arange(np.floor(ends[0] / width), np.ceil(ends[1] / width) + 1) * width


def _with(found: Floats, extra: list[Floats]) -> Floats:
    return np.unique(np.concatenate([found, *extra]))


def _middles(t: Floats) -> Floats:
    return (t[:-1] + t[1:]) / 2
