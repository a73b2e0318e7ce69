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
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common import make_cloud, summary, write_results
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
    center, radius = box.mean(axis=0), np.linalg.norm(box[1] - box[0]) / 2
    eye = center + np.array([0.55, 0.4, 0.73]) * radius / np.tan(np.radians(FOV / 2)) * 1.05
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
            seconds, seen = _vdb_render(tool, path, eye, center)
            times["vdb_render -step 1"].append(seconds)
            opacity["vdb_render -step 1"] = seen

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


def _vdb_render(tool: str, path: Path, eye: Any, center: Any) -> tuple[float, Any]:
    """One run of vdb_render: its own ray-tracing time, and the alpha it wrote."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out.exr"
        absorb = ",".join([str(SIGMA_PER_VOXEL)] * 3)
        command = [tool, str(path), str(out), "-v", "-res", f"{SIZE}x{SIZE}", "-fov", str(FOV)]
        command += ["-translate", ",".join(map(str, eye)), "-lookat", ",".join(map(str, center))]
        command += ["-absorb", absorb, "-scatter", "0,0,0", "-step", "1", "-name", "density"]
        command += ["-cpus", str(available_threads()), "-compression", "none"]
        done = subprocess.run(command, check=True, capture_output=True, text=True)
        found = re.search(
            r"ray-tracing.*?completed in ([\d.]+) (\w+)", done.stderr + done.stdout, re.S
        )
        assert found, f"vdb_render -v printed no time: {done.stdout}{done.stderr}"
        unit = {"sec": 1.0, "ms": 1e-3, "min": 60.0}[
            found[2].rstrip("s") if found[2] != "ms" else "ms"
        ]
        channels, _ = images.read_exr(out)
        return float(found[1]) * unit, channels["A"]


def main(arguments: list[str]) -> None:
    """Compare on the files named, or on a cloud made for it."""
    results = {}
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(a) for a in arguments]
        if not paths:
            paths = [make_cloud(Path(folder) / "cloud_512.vdb", 512, 0.53)]
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
