"""The truth that images are compared with: a slow renderer in NumPy. It imports nothing of volcli.

A field is a function from lattice points to values. Along a ray, every crossing with a plane
between lattice points is listed and sorted; between two of them the field is one polynomial, which
Gauss-Legendre rules of high order integrate to rounding. There is no walk, no brick and no float32.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

CORNERS = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)])
OUTER = np.polynomial.legendre.leggauss(8)
INNER = np.polynomial.legendre.leggauss(4)  # exact for the integral of a cubic

MAX_TAU = 0.25
"""Intervals are split until each has a smaller optical depth; 8 nodes then leave 1e-16."""

Lookup = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Lattice:
    """A field: its values at (n, 3) lattice points, where they lie, and where they end.

    ``box`` (2, 3) holds the smallest and the largest lattice point in use: nothing is integrated
    more than one voxel (nearest: half a voxel) beyond. Colour is looked up without end.
    """

    at: Lookup
    world_from_index: np.ndarray
    box: np.ndarray
    nearest: bool = False


@dataclass(frozen=True)
class Traced:
    """What a ray sees; ``distance`` is that of a hit on average, inf where nothing is hit."""

    tau: float
    radiance: np.ndarray
    distance: float


def of_array(values, origin=(0, 0, 0), background=0.0) -> Lookup:
    """The lookup of a dense array whose first value is at ``origin``."""
    values = np.asarray(values, np.float32).astype(np.float64)
    origin = np.asarray(origin)
    last = np.array(values.shape[:3]) - 1

    def at(points):
        local = points - origin
        inside = ((local >= 0) & (local <= last)).all(axis=-1)
        found = values[tuple(np.clip(local, 0, last).T)]
        outside = np.asarray(background, np.float64)
        return np.where(inside.reshape(-1, *[1] * (found.ndim - 1)), found, outside)

    return at


def of_tree(tree) -> Lookup:
    """The lookup of leaves and tiles: dictionaries by the origin of each."""
    leaves = {tuple(o): n for n, o in enumerate(tree.leaf_origins.tolist())}
    tiles = {}
    for n, (origin, width) in enumerate(
        zip(tree.tile_origins.tolist(), tree.tile_widths.tolist(), strict=True)
    ):
        tiles.setdefault(width, {})[tuple(origin)] = n
    leaf_values = np.asarray(tree.leaf_values, np.float32).astype(np.float64)
    tile_values = np.asarray(tree.tile_values, np.float32).astype(np.float64)
    background = np.asarray(tree.background, np.float32).astype(np.float64)

    def slots(points, width, table):
        """The number in ``table`` of the node around each point, or -1."""
        node = points // width
        low = node.min(axis=0)
        extent = node.max(axis=0) - low + 1
        key = np.ravel_multi_index(tuple((node - low).T), tuple(extent))
        _, first, which = np.unique(key, return_index=True, return_inverse=True)
        found = [table.get(tuple(o), -1) for o in (node[first] * width).tolist()]
        return np.array(found, int)[which.reshape(-1)]

    def at(points):
        points = np.asarray(points, np.int64)
        values = np.empty((len(points), *background.shape))
        values[...] = background
        for width, table in sorted(tiles.items(), reverse=True):
            slot = slots(points, width, table)
            values[slot >= 0] = tile_values[slot[slot >= 0]]
        slot = slots(points, 8, leaves)
        inside = slot >= 0
        values[inside] = leaf_values[(slot[inside], *(points[inside] % 8).T)]
        return values

    return at


def pinhole(eye, target, up, fov_degrees, resolution):
    """Origins and unit directions (h, w, 3) of a camera with a vertical field of view."""
    x, y, right, upward, forward = _frame(eye, target, up, resolution)
    half = np.tan(np.radians(fov_degrees) / 2)
    through = forward + half * (x[..., None] * right + y[..., None] * upward)
    directions = through / np.linalg.norm(through, axis=-1, keepdims=True)
    return np.broadcast_to(np.asarray(eye, float), directions.shape), directions


def orthographic(eye, target, up, width, resolution):
    """Origins and unit directions (h, w, 3) of a camera whose picture is ``width`` wide."""
    x, y, right, upward, forward = _frame(eye, target, up, resolution)
    half = width * resolution[1] / resolution[0] / 2
    origins = np.asarray(eye, float) + half * (x[..., None] * right + y[..., None] * upward)
    return origins, np.broadcast_to(forward, origins.shape)


def _frame(eye, target, up, resolution):
    """Pixel centres in half heights, and the unit vectors of a camera's frame."""
    width, height = resolution
    rows, columns = np.mgrid[0:height, 0:width]
    x = (2 * (columns + 0.5) - width) / height
    y = (height - 2 * (rows + 0.5)) / height
    forward = np.subtract(target, eye, dtype=float)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    return x, y, right, np.cross(right, forward), forward


def trace(origin, direction, density: Lattice, scale=1.0, colour: Lattice | None = None) -> Traced:
    """Integrate one ray."""
    o, d = _to_index(density, origin, direction)
    reach = 0.5 if density.nearest else 1.0
    near, far = _overlap(o, d, density.box[0] - reach, density.box[1] + reach)
    if not near < far:
        return Traced(0.0, np.zeros(3), np.inf)
    # Distances count from where the ray enters, so that a far camera costs no digits.
    length = far - near
    o = o + near * d
    cuts = [[0.0, length], _crossings(o, d, length, density.nearest)]
    if colour is not None:
        co, cd = _to_index(colour, origin, direction)
        co = co + near * cd
        cuts.append(_crossings(co, cd, length, colour.nearest))
    cuts = np.unique(np.concatenate(cuts))
    begin, end = cuts[:-1], cuts[1:]
    sigma = _sampler(density, o, d, begin, end)
    thickness = scale * _integrate(sigma, begin, end, OUTER)
    total = float(thickness.sum())
    if total == 0.0:
        return Traced(0.0, np.zeros(3), np.inf)

    # Halve what is thick, until nothing is; what lies behind an optical depth of 100 is below 1e-43
    # of the light.
    of = np.arange(len(begin))
    while True:
        sigma_of = sigma.take(of)
        tau = scale * _integrate(sigma_of, begin, end, OUTER)
        before = np.concatenate([[0.0], np.cumsum(tau)[:-1]])
        middle = (begin + end) / 2
        thick = (tau > MAX_TAU) & (before < 100.0) & (middle > begin) & (middle < end)
        if not thick.any():
            break
        twice = 1 + thick
        second = np.cumsum(twice) - 1
        of, begin, end = np.repeat(of, twice), np.repeat(begin, twice), np.repeat(end, twice)
        begin[second[thick]] = middle[thick]
        end[second[thick] - 1] = middle[thick]
    step = end - begin

    t = begin[:, None] + step[:, None] * (OUTER[0] + 1) / 2
    inner = begin[:, None, None] + (t - begin[:, None])[..., None] * (INNER[0] + 1) / 2
    tau_to = scale * (sigma_of(inner) * INNER[1]).sum(axis=-1) * (t - begin[:, None]) / 2
    hit = scale * sigma_of(t) * np.exp(-(before[:, None] + tau_to)) * OUTER[1] * step[:, None] / 2
    radiance = np.zeros(3)
    if colour is not None:
        seen_colour = _sampler(colour, co, cd, begin, end)(t)
        radiance = (hit[..., None] * seen_colour).sum(axis=(0, 1))
    distance = near + (hit * t).sum() / -np.expm1(-total)
    return Traced(total, radiance, float(distance))


def trace_all(origins, directions, density, scale=1.0, colour=None):
    """(tau, radiance, distance) of rays (..., 3), in arrays of their shape."""
    shape = np.shape(origins)[:-1]
    rays = zip(np.reshape(origins, (-1, 3)), np.reshape(directions, (-1, 3)), strict=True)
    traced = [trace(o, d, density, scale, colour) for o, d in rays]
    tau = np.array([r.tau for r in traced]).reshape(shape)
    radiance = np.array([r.radiance for r in traced]).reshape(*shape, 3)
    return tau, radiance, np.array([r.distance for r in traced]).reshape(shape)


def sample(points, lattice: Lattice):
    """The field at world points (n, 3)."""
    index_from_world = np.linalg.inv(lattice.world_from_index)
    p = points @ index_from_world[:3, :3].T + index_from_world[:3, 3]
    if lattice.nearest:
        return lattice.at(np.floor(p + 0.5).astype(np.int64))
    cell = np.floor(p).astype(np.int64)
    corners = lattice.at((cell[:, None] + CORNERS).reshape(-1, 3)).reshape(len(p), 8, -1)
    found = (_corner_weights(p - cell)[..., None] * corners).sum(axis=1)
    return found[:, 0] if found.shape[1] == 1 else found


def span(origin, direction, lattice: Lattice):
    """(near, far): the distances between which the ray is in the lattice's box and its rim."""
    o, d = _to_index(lattice, origin, direction)
    reach = 0.5 if lattice.nearest else 1.0
    return _overlap(o, d, lattice.box[0] - reach, lattice.box[1] + reach)


def _to_index(lattice, origin, direction):
    index_from_world = np.linalg.inv(lattice.world_from_index)
    linear = index_from_world[:3, :3]
    return linear @ origin + index_from_world[:3, 3], linear @ direction


def _overlap(o, d, low, high):
    near, far = 0.0, np.inf
    for axis in range(3):
        if d[axis] == 0.0:
            if not low[axis] <= o[axis] <= high[axis]:
                return 1.0, 0.0
            continue
        ends = np.sort([(low[axis] - o[axis]) / d[axis], (high[axis] - o[axis]) / d[axis]])
        near, far = max(near, ends[0]), min(far, ends[1])
    return near, far


def _crossings(o, d, length, nearest):
    """Where the ray crosses the planes at which the field's polynomial changes."""
    found = [np.empty(0)]
    shift = 0.5 if nearest else 0.0
    for axis in range(3):
        if d[axis] != 0.0:
            ends = np.sort([o[axis], o[axis] + length * d[axis]])
            planes = np.arange(np.floor(ends[0]) - 1, np.ceil(ends[1]) + 2) + shift
            found.append((planes - o[axis]) / d[axis])
    crossings = np.concatenate(found)
    return crossings[(crossings > 0) & (crossings < length)]


class _Sampler:
    """The field of one lattice at distances (m, ...) along a ray, each row in its own cell."""

    def __init__(self, offset, d, corners):
        self.offset, self.d, self.corners = offset, d, corners

    def __call__(self, t):
        if self.corners.ndim == 2 and self.corners.shape[1] == 1:  # nearest, one channel
            return np.broadcast_to(self.corners.reshape(-1, *[1] * (t.ndim - 1)), t.shape)
        if self.corners.shape[1] == 1:
            return np.broadcast_to(self.corners, (*t.shape, self.corners.shape[-1]))
        offset = self.offset.reshape(len(t), *[1] * (t.ndim - 1), 3)
        weights = _corner_weights(offset + t[..., None] * self.d)
        if self.corners.ndim == 2:
            return np.einsum("m...c,mc->m...", weights, self.corners)
        return np.einsum("m...c,mck->m...k", weights, self.corners)

    def take(self, rows):
        return _Sampler(self.offset[rows], self.d, self.corners[rows])


def _sampler(lattice, o, d, begin, end):
    middle = o + 0.5 * (begin + end)[:, None] * d
    if lattice.nearest:
        cell = np.floor(middle + 0.5).astype(np.int64)
        values = lattice.at(cell)
        return _Sampler(o - cell, d, values[:, None])
    cell = np.floor(middle).astype(np.int64)
    values = lattice.at((cell[:, None] + CORNERS).reshape(-1, 3))
    return _Sampler(o - cell, d, values.reshape(len(cell), 8, *values.shape[1:]))


def _corner_weights(p):
    """(..., 8): the part of each corner in the value at p (..., 3) of a cell."""
    sides = np.where(CORNERS, p[..., None, :], 1 - p[..., None, :])
    return sides.prod(axis=-1)


def _integrate(f, begin, end, rule):
    t = begin[:, None] + (end - begin)[:, None] * (rule[0] + 1) / 2
    return (f(t) * rule[1]).sum(axis=-1) * (end - begin) / 2
