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


def make_cloud(path: Path, size: int, threshold: float) -> Path:
    """A cloud of ``size``^3 voxels in a .vdb file, written by OpenVDB itself."""
    command = [find_interpreter(), "-I", "-c", MAKE_CLOUD, str(path), str(size), str(threshold)]
    subprocess.run(command, check=True, env={"PATH": os.environ.get("PATH", "")})
    return path


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
