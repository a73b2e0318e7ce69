"""Time and memory against voxels, pixels and threads.

    python -m benchmarks.scaling [--max-voxels N] [--max-pixels N] [--rounds N]

Each volume is a cloud nearly all of whose ball is active; each is rendered by a process of its own,
whose peak memory is read, with each number of threads in turn. Two lines are fitted by least
squares of relative errors: seconds of rendering to cells visited, over both kinds of runs, and
bytes to active voxels; ``worst`` is how far, relatively, a measurement lies from its line.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common import PEAK_BYTES, make_cloud, summary, write_results
from benchmarks.plots import draw
from volcli.render import available_threads

SIZES = {72: 100_000, 104: 300_000, 156: 1_000_000, 225: 3_000_000, 335: 10_000_000}
SIZES |= {485: 30_000_000, 720: 100_000_000}
"""Edges of clouds, and about how many active voxels each has."""

EDGES = (100, 316, 1000, 1732, 3162, 5477)
"""Edges of pictures: 1e4 to 3e7 pixels."""

THRESHOLD = 0.2
VOXELS_EDGE = 512
"""The picture's edge while voxels vary."""

PIXELS_SIZE = 156
"""The cloud's edge while pixels vary."""

ONE = (
    PEAK_BYTES
    + """
import json, sys, time
from pathlib import Path
from volcli import schema
from volcli.camera import make_camera
from volcli.grids import density_grid, load_density, open_volume
from volcli.plan import make_plan
from volcli.render import Scene, render

path, edge, rounds, *threads = sys.argv[1:]
begin = time.perf_counter()
volume = open_volume(Path(path))
header, _ = density_grid(volume, None)
grid, _ = load_density(volume, header, "error")
load = time.perf_counter() - begin
after_load = peak_bytes()
plan = make_plan(schema.Job(), volume, frozenset({"picture", "transmittance", "optical_depth"}))
camera = make_camera(schema.Camera(fov=30.0, resolution=(int(edge),) * 2), grid.world_box())
scene = Scene(grid, 0.02, (1.0, 1.0, 1.0))
small = make_camera(schema.Camera(fov=30.0, resolution=(16, 16)), grid.world_box())
render(scene, plan, small)
seconds = {n: [] for n in threads}
for _ in range(int(rounds)):
    for n in threads:
        done = render(scene, plan, camera, threads=int(n))
        seconds[n].append(done.render_seconds)
        cells = done.evaluations
        del done
print(json.dumps({
    "active_voxels": header.active_voxels, "bricks": len(grid.arrays.atlas), "cells": cells,
    "load_seconds": load, "seconds": seconds, "held_bytes": grid.nbytes,
    "load_peak_bytes": after_load, "peak_bytes": peak_bytes(),
}))
"""
)


def measure(path: Path, edge: int, rounds: int, threads: Sequence[int]) -> list[dict[str, Any]]:
    """One volume and one size of picture: a row for each number of threads."""
    command = [sys.executable, "-c", ONE, str(path), str(edge), str(rounds), *map(str, threads)]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    found = json.loads(done.stdout)
    seconds = found.pop("seconds")
    rows = []
    for n in threads:
        row = {"threads": n, "pixels": edge**2, **found, "seconds": summary(seconds[str(n)])}
        rows.append(row)
        print(
            f"{row['active_voxels']:>12,} voxels {row['pixels']:>12,} pixels {n} threads: "
            f"load {row['load_seconds']:.2f} s, render {row['seconds']['median']:.3f} s, "
            f"{row['cells'] / row['seconds']['median'] / 1e6:.0f} M cells/s, bricks "
            f"{row['held_bytes'] / 1e6:.0f} MB, peak {row['peak_bytes'] / 1e6:.0f} MB"
        )
    return rows


def fit(x: Sequence[float], y: Sequence[float]) -> dict[str, float]:
    """The line through (x, y) with the least squares of relative errors, neither part negative."""
    of, to = np.array(x, np.float64), np.array(y, np.float64)
    columns = np.stack([1 / to, of / to], axis=1)
    (at_zero, slope), *_ = np.linalg.lstsq(columns, np.ones(len(to)), rcond=None)
    if at_zero < 0:
        at_zero, slope = 0.0, float((of / to).sum() / ((of / to) ** 2).sum())
    worst = np.abs((at_zero + slope * of) / to - 1).max()
    return {"at_zero": float(at_zero), "slope": float(slope), "worst": float(worst)}


def fits(voxels: list[dict[str, Any]], pixels: list[dict[str, Any]]) -> dict[str, Any]:
    """Lines through the measurements."""
    of_cells = {}
    for threads in sorted({row["threads"] for row in voxels}):
        rows = [row for row in (*voxels, *pixels) if row["threads"] == threads]
        of_cells[str(threads)] = fit(
            [row["cells"] for row in rows], [row["seconds"]["median"] for row in rows]
        )
    alone = [row for row in voxels if row["threads"] == voxels[0]["threads"]]
    active = [row["active_voxels"] for row in alone]
    many = [row for row in pixels if row["threads"] == pixels[0]["threads"]]
    return {
        "seconds_of_cells": of_cells,
        "held_bytes_of_voxels": fit(active, [row["held_bytes"] for row in alone]),
        "peak_bytes_of_voxels": fit(active, [row["peak_bytes"] for row in alone]),
        "peak_bytes_of_pixels": fit(
            [row["pixels"] for row in many], [row["peak_bytes"] for row in many]
        ),
    }


def main(arguments: list[str]) -> None:
    """Measure, fit, and write the results and their plot."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.scaling")
    parser.add_argument("--max-voxels", type=int, default=30_000_000, help="up to 100000000")
    parser.add_argument("--max-pixels", type=int, default=30_000_000)
    parser.add_argument("--rounds", type=int, default=3)
    asked = parser.parse_args(arguments)
    threads = sorted({1, min(2, available_threads()), available_threads()})
    voxels: list[dict[str, Any]] = []
    pixels: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        for size, about in SIZES.items():
            if about <= asked.max_voxels:
                path = make_cloud(Path(folder) / f"ball_{size}.vdb", size, THRESHOLD)
                voxels += measure(path, VOXELS_EDGE, asked.rounds, threads)
                path.unlink()
        path = make_cloud(Path(folder) / "ball.vdb", PIXELS_SIZE, THRESHOLD)
        for edge in EDGES:
            if edge**2 <= asked.max_pixels:
                rounds = asked.rounds if edge <= 2000 else 1
                pixels += measure(path, edge, rounds, threads)
    found = fits(voxels, pixels)
    for n, line in found["seconds_of_cells"].items():
        print(
            f"{n} threads: {1e-6 / line['slope']:.0f} M cells/s after {line['at_zero']:.4f} s; "
            f"off by at most {100 * line['worst']:.0f} %"
        )
    for key in ("held", "peak"):
        line = found[f"{key}_bytes_of_voxels"]
        print(f"{key}: {line['at_zero'] / 1e6:.0f} MB + {line['slope']:.1f} bytes a voxel")
    write_results("scaling", {"voxels": voxels, "pixels": pixels, "fits": found})
    draw("scaling")


if __name__ == "__main__":
    main(sys.argv[1:])
