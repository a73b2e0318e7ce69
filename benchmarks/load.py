"""Time and memory to a renderable grid, against OpenVDB reading the same file into an array.

    python -m benchmarks.load [--large | VOLUME.vdb ...]

``--large`` is a ball of noise of 98 million voxels (341 MB, made in the temporary folder).
Each run is a process of its own that times itself: for volcli, reading a tree and building its
bricks; for OpenVDB's Python module, reading the grid and copying its active box to a NumPy array;
imports are not counted for either. Each process does so three times and counts the fastest: what
the first touch of fresh memory costs is the machine's affair, and on a virtual one as much again.
Rounds are interleaved and ratios taken round by round. A second load out of volcli's cache is timed
beside.
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

MAKE_BALL = """
import sys
import numpy as np
try:
    import openvdb as vdb
except ImportError:
    import pyopenvdb as vdb

# Value noise in a sphere, 16 layers at a time: all of its voxels are active, and no two alike.
path, n, cells = sys.argv[1], int(sys.argv[2]), 48
noise = np.random.default_rng(1).random((cells + 1,) * 3).astype(np.float32)
g = np.linspace(-1, 1, n, dtype=np.float32)
x = np.linspace(0, cells, n, endpoint=False)
i, f = x.astype(int), (x - x.astype(int)).astype(np.float32)
grid = vdb.FloatGrid()
for first in range(0, n, 16):
    a, b = i[first : first + 16], f[first : first + 16, None, None]
    part = noise[a] * (1 - b) + noise[a + 1] * b
    part = part[:, i] * (1 - f)[:, None] + part[:, i + 1] * f[:, None]
    part = part[..., i] * (1 - f) + part[..., i + 1] * f
    r = np.sqrt(g[first : first + 16, None, None] ** 2 + g[:, None] ** 2 + g**2)
    part = np.where(r < 0.97, 0.1 + part, 0).astype(np.float32)
    grid.copyFromArray(np.ascontiguousarray(part), ijk=(first, 0, 0))
grid.name = "density"
grid.gridClass = "fog volume"
grid.prune()
vdb.write(path, [grid])
print("null")
"""

OURS = (
    PEAK_BYTES
    + """
import json, sys, tempfile, time
from pathlib import Path
import numpy.ma
import volcli.grids.cache
import volcli.grids.vdb
from volcli.grids import density_grid, load_density, open_volume
def load(cache=None):
    begin = time.perf_counter()
    volume = open_volume(Path(sys.argv[1]))
    grid, _ = load_density(volume, density_grid(volume, None)[0], "error", None, cache)
    return time.perf_counter() - begin, grid
seconds, grid = min((load() for _ in range(3)), key=lambda done: done[0])
result = {"seconds": seconds, "peak": peak_bytes(), "held": grid.nbytes}
del grid
if sys.argv[2:]:
    with tempfile.TemporaryDirectory() as folder:
        load(Path(folder))
        result["cached"] = min(load(Path(folder))[0] for _ in range(3))
print(json.dumps(result))
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
    cached = run([sys.executable, "-c", OURS, str(path), "cached"])["cached"]
    ratios = [a["seconds"] / b["seconds"] for a, b in zip(ours, theirs, strict=True)]
    return {
        "voxels": theirs[0]["voxels"],
        "volcli": {
            "seconds": summary([r["seconds"] for r in ours]),
            "peak_bytes": max(r["peak"] for r in ours),
            "held_bytes": ours[0]["held"],
            "cached_seconds": cached,
        },
        "openvdb": {
            "seconds": summary([r["seconds"] for r in theirs]),
            "peak_bytes": max(r["peak"] for r in theirs),
        },
        "volcli_over_openvdb": summary(ratios),
    }


def main(arguments: list[str]) -> None:
    """Compare on the files named, or on a cloud or a ball made for it."""
    results = {}
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(a) for a in arguments]
        if arguments == ["--large"]:
            paths = [Path(folder) / "ball_592.vdb"]
            command = [find_interpreter(), "-I", "-c", MAKE_BALL, str(paths[0]), "592"]
            run(command, {"PATH": os.environ.get("PATH", "")})
        elif not paths:
            paths = [make_cloud(Path(folder) / "cloud_384.vdb", 384, 0.44)]
        for path in paths:
            row = results[path.name] = compare(path)
            ours, theirs = row["volcli"], row["openvdb"]
            print(
                f"{path.name}: {row['voxels']:,} voxels; volcli {ours['seconds']['median']:.3f} s, "
                f"openvdb {theirs['seconds']['median']:.3f} s, ratio "
                f"{row['volcli_over_openvdb']['median']:.2f}; from the cache "
                f"{ours['cached_seconds']:.3f} s; peak memory "
                f"{ours['peak_bytes'] / 1e6:.0f} MB for {ours['held_bytes'] / 1e6:.0f} MB of bricks"
            )
    write_results("load_large" if arguments == ["--large"] else "load", results)


if __name__ == "__main__":
    main(sys.argv[1:])
