"""What the benchmarks share: volumes, the machine's description, medians, and where results go."""

from __future__ import annotations

import json
import os
import platform
import statistics
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from volcli import __version__
from volcli.grids.pyopenvdb import find_interpreter

RESULTS = Path(__file__).parent / "results"

MAKE_CLOUD = """
import sys
import numpy as np
try:
    import openvdb as vdb
except ImportError:
    import pyopenvdb as vdb

# A cloud of value noise: four octaves, thresholded, thinner towards the edge of a sphere.
path, n, threshold = sys.argv[1], int(sys.argv[2]), float(sys.argv[3])
rng = np.random.default_rng(1)
field = np.zeros((n, n, n), np.float32)
for cells, amplitude in ((8, 1.0), (16, 0.5), (32, 0.25), (64, 0.125)):
    x = np.linspace(0, cells, n, endpoint=False)
    i, f = x.astype(int), (x - x.astype(int)).astype(np.float32)
    noise = rng.random((cells + 1,) * 3).astype(np.float32)
    noise = noise[i] * (1 - f)[:, None, None] + noise[i + 1] * f[:, None, None]
    noise = noise[:, i] * (1 - f)[:, None] + noise[:, i + 1] * f[:, None]
    field += amplitude / 1.875 * (noise[..., i] * (1 - f) + noise[..., i + 1] * f)
g = np.linspace(-1, 1, n, dtype=np.float32)
r = np.sqrt(g[:, None, None] ** 2 + g[:, None] ** 2 + g**2)
field = np.where(r < 0.8, np.maximum(field - threshold - 0.25 * r, 0) * 6, 0).astype(np.float32)
grid = vdb.FloatGrid()
grid.copyFromArray(np.ascontiguousarray(field))
grid.name = "density"
grid.gridClass = "fog volume"
grid.prune()
vdb.write(path, [grid])
"""
"""Run by an interpreter that has OpenVDB, since the files are to be OpenVDB's own."""

MAKE_DENSE = """
import json, sys
import numpy as np
try:
    import openvdb as vdb
except ImportError:
    import pyopenvdb as vdb

grid = vdb.read(sys.argv[1], "density")
low, high = grid.evalActiveVoxelBoundingBox()
low, high = [v - 1 for v in low], [v + 1 for v in high]
array = np.empty([h - l + 1 for l, h in zip(low, high)], np.float32)
grid.copyToArray(array, ijk=low)
np.save(sys.argv[2], np.ascontiguousarray(array.transpose(2, 1, 0)))
print(json.dumps(low))
"""
"""The active box and a voxel around it as an array in the order (z, y, x)."""

PEAK_BYTES = """
def peak_bytes():
    with open("/proc/self/status") as file:
        return next(int(line.split()[1]) for line in file if line.startswith("VmHWM:")) * 1024
"""
"""The peak memory of this very program: ru_maxrss would count what the one that started it held."""


CLOUD_THRESHOLD = 0.465
"""Leaves 4.8 million of 512^3 voxels: 3.6 %, as a cloud of a film may have."""


def make_cloud(path: Path, size: int, threshold: float) -> Path:
    """A cloud of ``size``^3 voxels in a .vdb file, written by OpenVDB itself."""
    _openvdb(MAKE_CLOUD, path, size, threshold)
    return path


def make_dense(path: Path, out: Path) -> tuple[int, int, int]:
    """The density of a .vdb file as a (z, y, x) array in ``out``; the lattice point of its first.

    A voxel of background lies around it, so that linear interpolation ends as it does in a grid.
    """
    x, y, z = json.loads(_openvdb(MAKE_DENSE, path, out))
    return x, y, z


def _openvdb(program: str, *arguments: object) -> str:
    command = [find_interpreter(), "-I", "-c", program, *map(str, arguments)]
    clean = {"PATH": os.environ.get("PATH", "")}
    return subprocess.run(command, check=True, env=clean, stdout=subprocess.PIPE, text=True).stdout


def view_of(box: Any, fov: float) -> tuple[Any, Any]:
    """Eye and target from which a world box fills most of a square picture."""
    center, radius = box.mean(axis=0), np.linalg.norm(box[1] - box[0]) / 2
    eye = center + np.array([0.55, 0.4, 0.73]) * radius / np.tan(np.radians(fov / 2)) * 1.05
    return eye, center


def summary(seconds: Sequence[float]) -> dict[str, float]:
    """Median, least and most of some timings."""
    return {
        "median": statistics.median(seconds),
        "min": min(seconds),
        "max": max(seconds),
        "rounds": len(seconds),
    }


def machine() -> dict[str, Any]:
    """What ran this, without anything that names the machine."""
    model = "unknown processor"
    if Path("/proc/cpuinfo").exists():
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        named = (line.split(":")[1].strip() for line in lines if line.startswith("model name"))
        model = next(named, model)
    return {
        "volcli": __version__,
        "processor": model,
        "threads": len(os.sched_getaffinity(0)),
        "python": platform.python_version(),
    }


def write_results(name: str, results: dict[str, Any]) -> None:
    """Write ``results/<name>.json``."""
    RESULTS.mkdir(exist_ok=True)
    path = RESULTS / f"{name}.json"
    path.write_text(json.dumps({"machine": machine(), **results}, indent=2, allow_nan=False) + "\n")
    print(f"wrote {path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path}")
