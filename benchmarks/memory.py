"""The memory that `volcli render --explain` says a picture will take, and what it then took.

    python -m benchmarks.memory [--max-voxels N]

Clouds of a thousand voxels to fifty million, written by OpenVDB, each rendered by a process of its
own with kernels that are compiled already. The estimate is made of a file's topology before any of
its values is read; the peak is the kernel's own count (VmHWM) at the end.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.common import make_cloud, write_results
from benchmarks.scaling import THRESHOLD
from benchmarks.startup import SCRIPT
from volcli.grids import open_volume

SIZES = {16: 1_000, 72: 100_000, 156: 1_000_000, 335: 10_000_000, 571: 50_000_000}
"""Edges of clouds, and about how many active voxels each has."""


def measure(path: Path, folder: Path, *options: str) -> dict[str, Any]:
    """What one render was said to take, and took."""
    command = [sys.executable, "-c", SCRIPT, "render", str(path), *options]
    command += ["-o", str(folder / "out.exr"), "--explain", "--json", "--quiet"]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)  # compiles
    printed = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
    found = json.loads(printed)
    width, height = found["size"]
    return {
        "active_voxels": open_volume(path).headers[0].active_voxels,
        "pixels": width * height,
        "estimate_bytes": found["memory_bytes"],
        "peak_bytes": found["peak_memory_bytes"],
        "peak_over_estimate": found["peak_memory_bytes"] / found["memory_bytes"],
    }


def main(arguments: list[str]) -> None:
    """Measure and write the results."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.memory")
    parser.add_argument("--max-voxels", type=int, default=50_000_000)
    asked = parser.parse_args(arguments)
    rows = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for size, about in SIZES.items():
            if about <= asked.max_voxels:
                path = make_cloud(folder / f"cloud_{size}.vdb", size, THRESHOLD)
                rows.append(measure(path, folder))
                path.unlink()
                row = rows[-1]
                print(
                    f"{row['active_voxels']:>12,} voxels: estimate "
                    f"{row['estimate_bytes'] / 1e6:.0f} MB, peak {row['peak_bytes'] / 1e6:.0f} MB"
                )
    write_results("memory", {"volumes": rows})


if __name__ == "__main__":
    main(sys.argv[1:])
