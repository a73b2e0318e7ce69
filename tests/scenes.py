"""Volumes and views for the tests of images: made here, rendered by volcli and by the reference."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import reference

from volcli.bounds import scene_bounds
from volcli.camera import make_camera
from volcli.grids.build import build
from volcli.grids.tree import GridHeader, Tree
from volcli.plan import make_plan
from volcli.render import Scene, Source, render
from volcli.schema import Camera, Job

EVERYTHING = frozenset({"picture", "transmittance", "opacity", "optical_depth", "depth"})
IDENTITY = np.eye(4)


def tree_of(values, origin=(0, 0, 0), background=0.0, active=None, tiles=()):
    """A tree that holds an array at any lattice point.

    ``active`` is a mask of the array's points, by default all of them; ``tiles`` are
    (origin, width, value, active).
    """
    values = np.asarray(values, np.float32)
    channels = values.shape[3:]
    active = np.ones(values.shape[:3], bool) if active is None else active
    origin = np.asarray(origin, np.int64)
    first = origin // 8
    last = (origin + values.shape[:3] - 1) // 8 if values.size else first - 1
    counts = last - first + 1
    padded = np.empty((*(counts * 8), *channels), np.float32)
    padded[...] = background
    mask = np.zeros(counts * 8, bool)
    at = origin - first * 8
    inner = tuple(slice(a, a + n) for a, n in zip(at, values.shape[:3], strict=True))
    padded[inner], mask[inner] = values, active
    where = list(np.ndindex(*counts.tolist()))
    cut = [tuple(slice(8 * i, 8 * i + 8) for i in w) for w in where]
    leaves = np.array([padded[c] for c in cut], np.float32).reshape(-1, 8, 8, 8, *channels)
    masks = [np.packbits(mask[c].reshape(-1), bitorder="little") for c in cut]
    tile_values = np.array([t[2] for t in tiles], np.float32).reshape(-1, *channels)
    return Tree(
        background=np.broadcast_to(np.float32(background), channels).copy(),
        leaf_origins=((np.array(where, np.int64).reshape(-1, 3) + first) * 8).astype(np.int32),
        leaf_values=leaves,
        leaf_masks=np.array(masks, np.uint8).reshape(-1, 64),
        tile_origins=np.array([t[0] for t in tiles], np.int32).reshape(-1, 3),
        tile_widths=np.array([t[1] for t in tiles], np.int32),
        tile_values=tile_values,
        tile_active=np.array([t[3] for t in tiles], bool),
    )


def joined(*trees):
    """One tree out of several with one background that do not overlap."""
    names = [n for n in Tree.__dataclass_fields__ if n != "background"]
    parts = {n: np.concatenate([getattr(t, n) for t in trees]) for n in names}
    return Tree(background=trees[0].background, **parts)


def header(world_from_index, label="density", value_type="float"):
    return GridHeader(
        name=label,
        label=label,
        value_type=value_type,
        grid_class="fog volume",
        map_type="AffineMap",
        world_from_index=np.asarray(world_from_index, np.float64),
        background=0.0,
    )


@dataclass
class Medium:
    """A tree under a transform, for both renderers."""

    tree: Tree
    world_from_index: np.ndarray = field(default_factory=lambda: IDENTITY)
    box: np.ndarray | None = None

    @cached_property
    def grid(self):
        return build(self.tree, header(self.world_from_index))

    def lattice(self, nearest=False):
        box = self.box
        if box is None:  # of leaves and tiles: encloses all, of use where the background is 0
            origins = np.concatenate([self.tree.leaf_origins, self.tree.tile_origins])
            widths = np.concatenate(
                [np.full(len(self.tree.leaf_origins), 8), self.tree.tile_widths]
            )
            origins = origins.astype(np.int64)
            box = np.array([origins.min(axis=0), (origins + widths[:, None] - 1).max(axis=0)])
        return reference.Lattice(reference.of_tree(self.tree), self.world_from_index, box, nearest)

    def world(self, index_point):
        m = np.asarray(self.world_from_index)
        return m[:3, :3] @ np.asarray(index_point, float) + m[:3, 3]


def medium(values, origin=(0, 0, 0), world_from_index=IDENTITY, background=0.0):
    """A medium whose every array point is active."""
    origin = np.asarray(origin, np.int64)
    box = np.array([origin, origin + np.shape(values)[:3] - 1])
    return Medium(tree_of(values, origin, background), np.asarray(world_from_index, float), box)


@dataclass(frozen=True)
class View:
    """A camera, as volcli's and as the reference's; ``width`` makes it orthographic."""

    eye: tuple
    target: tuple
    up: tuple = (0.0, 1.0, 0.0)
    fov: float = 40.0
    width: float | None = None
    resolution: tuple = (8, 6)

    @property
    def camera(self):
        asked = {n: tuple(float(x) for x in getattr(self, n)) for n in ("eye", "target", "up")}
        if self.width is None:
            job = Camera(fov=self.fov, resolution=self.resolution, **asked)
        else:
            job = Camera(type="orthographic", width=self.width, resolution=self.resolution, **asked)
        return make_camera(job, np.array([[-1.0] * 3, [1.0] * 3]))

    @property
    def rays(self):
        if self.width is None:
            return reference.pinhole(self.eye, self.target, self.up, self.fov, self.resolution)
        return reference.orthographic(self.eye, self.target, self.up, self.width, self.resolution)


class _Memory:
    """A volume that is a list of headers: all that a plan looks at."""

    path = Path("memory.vdb")

    def __init__(self, *headers):
        self.headers = headers


def plan_for(layers=EVERYTHING, step=None, nearest=False, max_error=None):
    """The plan that volcli makes for a scene; its grids are given to `shoot`."""
    rule = {"max_error": max_error} if step is None else {"rule": "midpoint", "step": step}
    job = Job(
        density={"interpolation": "nearest" if nearest else "linear"},
        quadrature=rule,
    )
    return make_plan(job, _Memory(header(IDENTITY)), frozenset(layers))


def shoot(density, view, scale=1.0, colour=(1.0, 1.0, 1.0), threads=1, **plan):
    """Render a medium with volcli."""
    color = Source(colour.grid) if isinstance(colour, Medium) else colour
    scene, made = bounded(Scene(density.grid, scale, color), plan_for(**plan))
    camera = view.camera if isinstance(view, View) else view
    return render(scene, made, camera, threads=threads)


def bounded(scene, plan):
    """(scene, plan), the scene with its bounds where the plan allows an error."""
    if plan.max_error is None:
        return scene, plan
    return replace(scene, bounds=scene_bounds(scene, plan.nearest, 1)), plan


def truth(density, view, scale=1.0, colour=None, nearest=False):
    """(tau, radiance, distance) of a medium by the reference, (h, w[, 3]) float64."""
    origins, directions = view.rays
    source = None if colour is None else colour.lattice(nearest)
    return reference.trace_all(origins, directions, density.lattice(nearest), scale, source)


def rotation(axis, degrees):
    """(3, 3): a turn about an axis (Rodrigues)."""
    x, y, z = np.asarray(axis, float) / np.linalg.norm(axis)
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    a = np.radians(degrees)
    return np.eye(3) + np.sin(a) * k + (1 - np.cos(a)) * k @ k


def affine(linear, offset=(0.0, 0.0, 0.0)):
    m = np.eye(4)
    m[:3, :3] = linear
    m[:3, 3] = offset
    return m


SHEAR = np.array([[1.0, 0.3, -0.2], [0.0, 1.0, 0.4], [0.0, 0.0, 1.0]])

TRANSFORMS = {
    "uniform": affine(0.5 * np.eye(3)),
    "non-uniform": affine(np.diag([0.4, 1.0, 1.7])),
    "mirrored": affine(np.diag([-0.5, 0.5, 0.5])),
    "offset": affine(0.1 * np.eye(3), (13.7, -4.2, 0.33)),
    "rotated": affine(0.5 * rotation((1, 2, 3), 37.0)),
    "sheared": affine(0.5 * SHEAR),
    "all at once": affine(
        rotation((3, -1, 2), 111.0) @ SHEAR @ np.diag([0.2, -0.7, 1.1]), (5.0, -8.0, 2.5)
    ),
}


def random_values(seed, shape, zeros=0.3):
    """A field with nothing smooth about it, part of it empty."""
    rng = np.random.default_rng(seed)
    values = rng.random(shape).astype(np.float32)
    values[rng.random(shape) < zeros] = 0
    return values


def random_colours(seed, shape):
    return np.random.default_rng(seed).random((*shape, 3)).astype(np.float32)


def smooth_values(shape, peak=1.0):
    """A blob that fades out to the edges of the array."""
    axes = [np.linspace(-1, 1, n) for n in shape]
    x, y, z = np.meshgrid(*axes, indexing="ij")
    blob = np.clip(1 - x * x - y * y - z * z, 0, None) ** 2 * (1 + 0.5 * np.sin(5 * x + 3 * y))
    return (peak * blob).astype(np.float32)
