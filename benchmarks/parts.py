"""Parts of a picture, each alone: a slower one shows here before it shows in the whole.

``test_parts.py`` times them, on a sample of 150,000 voxels and a picture of 800 x 600. The walk and
the cell's mathematics are inlined wherever they are used, so they have loops of their own here.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from volcli import images
from volcli.grids import density_grid, load_density, open_volume
from volcli.grids.build import build
from volcli.kernels.cell import cubic, integral, load
from volcli.kernels.compiler import kernel
from volcli.kernels.integrator import make_integrator
from volcli.kernels.rays import Density, move
from volcli.kernels.traversal import (
    clip,
    enter,
    inside,
    make_ray,
    root_cell,
    root_exit,
    root_next,
    root_segments,
    segment_buffer,
)

SAMPLE = Path(__file__).parents[1] / "samples" / "explosion.vdb"
RAYS = 10_000


@kernel
def count_segments(grid, support, eyes, d, buffer):
    """How many segments rays from ``eyes`` (n, 3) in direction ``d`` meet, in local voxels."""
    lo = (support[0, 0], support[0, 1], support[0, 2])
    hi = (support[1, 0], support[1, 1], support[1, 2])
    count = 0
    for n in range(len(eyes)):
        eye = (eyes[n, 0], eyes[n, 1], eyes[n, 2])
        t_near, t_far = clip(lo, hi, eye, d)
        ray = make_ray(move(eye, d, t_near, 0.0), d)
        t, t_far = 0.0, t_far - t_near
        at = enter(grid, ray.o, ray.d)
        while t < t_far and inside(grid, at):
            t_exit, axis = root_exit(grid, ray, at)
            t_exit = min(t_exit, t_far)
            buffer.used[0] = 0
            if t_exit > t:
                entry, corner = root_cell(grid, at)
                root_segments(grid, True, entry, corner, ray, t, t_exit, buffer)
                count += buffer.used[0]
                t = t_exit
            at = root_next(ray, at, axis)
    return count


@kernel
def integrate_cells(atlas, length):
    """The sum over all cells of all bricks of what a ray along x meets in the middle of each."""
    total = 0.0
    for brick in range(len(atlas)):
        for i in range(8):
            for j in range(8):
                for k in range(8):
                    v = load(atlas, brick, i, j, k)
                    total += integral(cubic(v, 0.5, 0.5, 0.5, 1.0, 0.0, 0.0), length)
    return total


def parts(folder: Path) -> dict[str, Callable[[], Any]]:
    """The parts by name, ready to be called again and again; pictures go into ``folder``."""
    volume = open_volume(SAMPLE)
    header, _ = density_grid(volume, None)
    tree = volume.read_tree(header)
    grid, _ = load_density(volume, header, "error")
    arrays, support = grid.arrays, grid.support("linear")
    rng = np.random.default_rng(1)
    eyes = rng.uniform(support[0], support[1], (RAYS, 3))
    eyes[:, 2] = support[0, 2] - 10
    direction = (0.1, 0.2, 0.97)
    buffer = segment_buffer()
    density = Density(arrays, grid.local_from_world, support, 1.0, True)
    loops = {
        packets: make_integrator(
            density, step_voxels=None, nearest=False, depth=True, packets=packets
        )
        for packets in (True, False)
    }
    local = np.vstack([grid.local_from_world, [0, 0, 0, 1]])
    rays = np.linalg.solve(local, np.vstack([eyes.T, np.ones(RAYS)]))[:3].T.copy()
    along = np.linalg.solve(local[:3, :3], direction)
    towards = np.tile(along / np.linalg.norm(along), (RAYS, 1))
    y, x = np.indices((600, 800), np.float32)
    channels = {name: np.sin(0.01 * x + n) * np.cos(0.01 * y) for n, name in enumerate("RGBAZ")}
    return {
        "read": lambda: volume.read_tree(header),
        "build": lambda: build(tree, header),
        "traversal": lambda: count_segments(arrays, support, eyes, direction, buffer),
        "cell integral": lambda: integrate_cells(arrays.atlas, 1.0),
        "rays in packets": lambda: loops[True](rays, towards),
        "rays one by one": lambda: loops[False](rays, towards),
        "encode EXR": lambda: images.write_exr(folder / "part.exr", channels, {}),
    }
