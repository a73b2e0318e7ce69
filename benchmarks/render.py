"""Kernel time against OpenVDB's ``vdb_render -step 1``: same file, camera, size and threads.

    python -m benchmarks.render [VOLUME.vdb ...]

Rounds are interleaved, so that a change of the machine's speed meets both; ratios are taken round
by round. What is timed is the ray tracing alone, as ``vdb_render -v`` reports it, and for volcli
everything from rays to finished arrays. Opacity errors are against the exact rule in float64, whose
own error the tests bound. Without ``vdb_render`` (Debian: libopenvdb-tools) volcli is timed alone.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common import CLOUD_THRESHOLD, make_cloud, summary, view_of, write_results
from volcli import images, schema
from volcli.camera import make_camera
from volcli.grids import density_grid, load_density, open_volume
from volcli.plan import make_plan
from volcli.render import Scene, available_threads, render

SIZE = 512
FOV = 30.0
ROUNDS = 5
SIGMA_PER_VOXEL = 0.05

LAYERS = {
    "opacity": frozenset({"picture", "transmittance", "optical_depth"}),
    "opacity and depth": frozenset({"picture", "transmittance", "optical_depth", "depth"}),
}
VARIANTS = [("exact", None), ("midpoint 1", 1.0), ("midpoint 0.25", 0.25)]


def compare(path: Path) -> dict[str, Any]:
    """Time volcli's rules and vdb_render on one file."""
    volume = open_volume(path)
    header, _ = density_grid(volume, None)
    grid, _ = load_density(volume, header, "error")
    voxel = float(np.linalg.norm(grid.world_from_index[:3, 0]))
    box = grid.world_box()
    eye, center = view_of(box, FOV)
    scene = Scene(grid, SIGMA_PER_VOXEL / voxel, (1.0, 1.0, 1.0))
    camera = make_camera(
        schema.Camera(eye=tuple(eye), target=tuple(center), fov=FOV, resolution=(SIZE, SIZE)),
        box,
    )

    runs: dict[str, Any] = {}
    for rule, step in VARIANTS:
        for layers, names in LAYERS.items():
            quadrature = schema.Quadrature(rule="midpoint" if step else "exact", step=step)
            plan = make_plan(schema.Job(quadrature=quadrature), volume, names)
            runs[f"volcli {rule}, {layers}"] = plan
    times: dict[str, list[float]] = {name: [] for name in runs}
    opacity: dict[str, Any] = {}
    tool = shutil.which("vdb_render")
    if tool:
        times["vdb_render -step 1"] = []
    for name, plan in runs.items():
        opacity[name] = render(scene, plan, camera).opacity  # compiles, and warms the caches
    for _ in range(ROUNDS):
        for name, plan in runs.items():
            times[name].append(render(scene, plan, camera).render_seconds)
        if tool:
            ran = vdb_render(path, eye, center)
            times["vdb_render -step 1"].append(ran.seconds)
            opacity["vdb_render -step 1"] = ran.opacity

    truth = opacity["volcli exact, opacity"]
    rows = {}
    for name, seconds in times.items():
        difference = np.abs(opacity[name].astype(np.float64) - truth)
        rows[name] = {
            "seconds": summary(seconds),
            "opacity_error": {"max": float(difference.max()), "mean": float(difference.mean())},
        }
        if tool and name.startswith("volcli"):
            ratios = [b / a for a, b in zip(seconds, times["vdb_render -step 1"], strict=True)]
            rows[name]["times_faster_than_vdb_render"] = summary(ratios)
    return {"voxels": header.active_voxels, "bricks": len(grid.arrays.atlas), "runs": rows}


@dataclass(frozen=True)
class VdbRender:
    """One run of vdb_render: its own ray-tracing time, the whole, peak memory, and its alpha."""

    seconds: float
    whole_seconds: float
    peak_bytes: int
    opacity: Any


def vdb_render(
    path: Path,
    eye: Any,
    center: Any,
    *,
    step: float = 1.0,
    cutoff: float | None = None,
    size: tuple[int, int] = (SIZE, SIZE),
    fov: float = FOV,
    threads: int | None = None,
) -> VdbRender:
    """Run vdb_render; a ``cutoff`` of None is its own default, and its ``fov`` is horizontal."""
    with tempfile.TemporaryDirectory() as folder:
        out, log = Path(folder) / "out.exr", Path(folder) / "log.txt"
        absorb = ",".join([str(SIGMA_PER_VOXEL)] * 3)
        command = ["vdb_render", str(path), str(out), "-v", "-res", "{}x{}".format(*size)]
        command += ["-fov", str(fov), "-translate", ",".join(map(str, eye))]
        command += ["-lookat", ",".join(map(str, center)), "-absorb", absorb, "-scatter", "0,0,0"]
        command += ["-step", str(step), "-name", "density", "-compression", "none"]
        command += ["-cpus", str(threads or available_threads())]
        if cutoff is not None:
            command += ["-cutoff", str(cutoff)]
        begin = time.perf_counter()
        with log.open("w") as file:
            process = subprocess.Popen(command, stdout=file, stderr=subprocess.STDOUT)
        peak = 0
        status = Path(f"/proc/{process.pid}/status")
        while process.poll() is None:
            if status.exists():
                found = re.search(r"VmHWM:\s+(\d+)", status.read_text())
                peak = int(found[1]) * 1024 if found else peak
            time.sleep(0.005)
        whole = time.perf_counter() - begin
        said = log.read_text()
        assert process.returncode == 0, said
        found = re.search(r"ray-tracing.*?completed in ([\d.]+) (ms|sec|min)", said, re.S)
        assert found, f"vdb_render -v printed no time: {said}"
        unit = {"sec": 1.0, "ms": 1e-3, "min": 60.0}[found[2]]
        channels, _ = images.read_exr(out)
        return VdbRender(float(found[1]) * unit, whole, peak, channels["A"])


def main(arguments: list[str]) -> None:
    """Compare on the files named, or on a cloud made for it."""
    results = {}
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(a) for a in arguments]
        if not paths:
            paths = [make_cloud(Path(folder) / "cloud_512.vdb", 512, CLOUD_THRESHOLD)]
        for path in paths:
            results[path.name] = compare(path)
            print(f"\n{path.name}: {results[path.name]['voxels']:,} voxels, {SIZE}x{SIZE} rays")
            for name, row in results[path.name]["runs"].items():
                faster = row.get("times_faster_than_vdb_render")
                print(
                    f"  {name:36s} {row['seconds']['median'] * 1e3:8.0f} ms   opacity error max "
                    f"{row['opacity_error']['max']:.1e} mean {row['opacity_error']['mean']:.1e}"
                    + (f"   {faster['median']:.1f} times faster" if faster else "")
                )
    write_results("render", results)


if __name__ == "__main__":
    main(sys.argv[1:])
