"""Time and memory to a renderable grid, against OpenVDB reading the same file into an array.

    python -m benchmarks.load [VOLUME.vdb ...]

Each run is a process of its own that times itself: for volcli, reading a tree and building its
bricks; for OpenVDB's Python module, reading the grid and copying its active box to a NumPy array;
imports are not counted for either. Each process does so three times and counts the fastest: what
the first touch of fresh memory costs is the machine's affair, and on a virtual one as much again.
Rounds are interleaved and ratios taken round by round.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.common import PEAK_BYTES, make_cloud, summary, write_results
from volcli.grids.pyopenvdb import find_interpreter

ROUNDS = 7

OURS = (
    PEAK_BYTES
    + """
import json, sys, time
from pathlib import Path
import numpy.ma
import volcli.grids.vdb
from volcli.grids import density_grid, load_density, open_volume
def load():
    begin = time.perf_counter()
    volume = open_volume(Path(sys.argv[1]))
    grid, _ = load_density(volume, density_grid(volume, None)[0], "error")
    return time.perf_counter() - begin, grid
seconds, grid = min((load() for _ in range(3)), key=lambda done: done[0])
print(json.dumps({"seconds": seconds, "peak": peak_bytes(), "held": grid.nbytes}))
"""
)

THEIRS = (
    PEAK_BYTES
    + """
import json, sys, time
import numpy as np
try:
    import openvdb as vdb
except ImportError:
    import pyopenvdb as vdb
def load():
    begin = time.perf_counter()
    grid = vdb.read(sys.argv[1], "density")
    low, high = grid.evalActiveVoxelBoundingBox()
    array = np.empty([h - l + 1 for l, h in zip(low, high)], np.float32)
    grid.copyToArray(array, ijk=low)
    return time.perf_counter() - begin, grid
seconds, grid = min((load() for _ in range(3)), key=lambda done: done[0])
voxels = int(grid.activeVoxelCount())
print(json.dumps({"seconds": seconds, "peak": peak_bytes(), "voxels": voxels}))
"""
)


def run(command: list[str], env: dict[str, str] | None = None) -> dict[str, Any]:
    """One process that prints one JSON object."""
    done = subprocess.run(command, check=True, capture_output=True, text=True, env=env)
    return json.loads(done.stdout)


def compare(path: Path) -> dict[str, Any]:
    """Both loaders on one file."""
    clean = {"PATH": os.environ.get("PATH", "")}
    ours, theirs = [], []
    for _ in range(ROUNDS):
        ours.append(run([sys.executable, "-c", OURS, str(path)]))
        theirs.append(run([find_interpreter(), "-I", "-c", THEIRS, str(path)], clean))
    ratios = [a["seconds"] / b["seconds"] for a, b in zip(ours, theirs, strict=True)]
    return {
        "voxels": theirs[0]["voxels"],
        "volcli": {
            "seconds": summary([r["seconds"] for r in ours]),
            "peak_bytes": max(r["peak"] for r in ours),
            "held_bytes": ours[0]["held"],
        },
        "openvdb": {
            "seconds": summary([r["seconds"] for r in theirs]),
            "peak_bytes": max(r["peak"] for r in theirs),
        },
        "volcli_over_openvdb": summary(ratios),
    }


def main(arguments: list[str]) -> None:
    """Compare on the files named, or on a cloud made for it."""
    results = {}
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(a) for a in arguments]
        if not paths:
            paths = [make_cloud(Path(folder) / "cloud_384.vdb", 384, 0.44)]
        for path in paths:
            row = results[path.name] = compare(path)
            ours, theirs = row["volcli"], row["openvdb"]
            print(
                f"{path.name}: {row['voxels']:,} voxels; volcli {ours['seconds']['median']:.3f} s, "
                f"openvdb {theirs['seconds']['median']:.3f} s, ratio "
                f"{row['volcli_over_openvdb']['median']:.2f}; peak memory "
                f"{ours['peak_bytes'] / 1e6:.0f} MB for {ours['held_bytes'] / 1e6:.0f} MB of bricks"
            )
    write_results("load", results)


if __name__ == "__main__":
    main(sys.argv[1:])
