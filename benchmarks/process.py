"""The whole process, from the command to the written EXR, beside vdb_render's.

    python -m benchmarks.process VOLUME.vdb ...

A picture of 1920 x 1080 by the exact rule, against ``vdb_render -step 1``: the same view,
extinction and number of threads, rounds taking turns. volcli is warm: its kernels are compiled. Its
EXR holds transmittance, optical depth and depth too.
"""

from __future__ import annotations

import math
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common import summary, view_of, write_results
from benchmarks.render import FOV, SIGMA_PER_VOXEL, vdb_render
from benchmarks.startup import SCRIPT
from volcli.grids import density_grid, load_density, open_volume

SIZE = (1920, 1080)
ROUNDS = 5


def compare(path: Path, folder: Path) -> dict[str, Any]:
    """Seconds of both, and how many times faster volcli is, round by round."""
    volume = open_volume(path)
    header, _ = density_grid(volume, None)
    grid, _ = load_density(volume, header, "error")
    voxel = float(np.linalg.norm(grid.world_from_index[:3, 0]))
    eye, target = view_of(grid.world_box(), FOV)
    across = 2 * math.degrees(math.atan(math.tan(math.radians(FOV / 2)) * SIZE[0] / SIZE[1]))

    command = [sys.executable, "-c", SCRIPT, "render", str(path)]
    command += ["-o", str(folder / "out.exr"), "--overwrite", "--quiet", "--fov", str(FOV)]
    command += ["--size", "{}x{}".format(*SIZE), "--density-scale", str(SIGMA_PER_VOXEL / voxel)]
    command += [f"--eye={','.join(map(str, eye))}", f"--target={','.join(map(str, target))}"]

    def volcli() -> float:
        begin = time.perf_counter()
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        return time.perf_counter() - begin

    volcli()  # compiles
    ours, theirs = [], []
    for _ in range(ROUNDS):
        ours.append(volcli())
        theirs.append(vdb_render(path, eye, target, size=SIZE, fov=across).whole_seconds)
    return {
        "volcli": summary(ours),
        "vdb_render -step 1": summary(theirs),
        "times_faster": summary([b / a for a, b in zip(ours, theirs, strict=True)]),
    }


def main(arguments: list[str]) -> None:
    """Compare on the files named."""
    results = {}
    with tempfile.TemporaryDirectory() as folder:
        for path in map(Path, arguments):
            results[path.name] = row = compare(path, Path(folder))
            print(
                f"{path.name}: volcli {row['volcli']['median']:.2f} s, vdb_render "
                f"{row['vdb_render -step 1']['median']:.2f} s: "
                f"{row['times_faster']['median']:.1f} times faster"
            )
    write_results("process", results)


if __name__ == "__main__":
    main(sys.argv[1:])
