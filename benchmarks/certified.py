"""The certified rule on the samples, and on volumes that are not ours: error, certificate, work.

    python -m benchmarks.certified [--volumes FOLDER]

For each scene and each allowed error: how far transmittance and radiance are at most from the
truth, what was certified at most, in how many pixels the certificate was broken, and what it took
beside the exact rule: evaluations, and processor seconds, interleaved. The truth of transmittance
is the exact rule in float64 (which the accuracy benchmark holds to a reference); that of radiance,
where it varies, the certified rule at `TINY`. Scenes of other folders are grey, and thick enough
for an optical depth of `DEPTH`, or of ten times that.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common import summary, write_results
from volcli.bounds import scene_bounds
from volcli.camera import Camera, make_camera
from volcli.config import load_job
from volcli.grids import density_grid, load_density, open_volume
from volcli.plan import Plan, make_plan
from volcli.render import PIXEL_ERROR, Scene, make_integrator
from volcli.run import load, prepare
from volcli.scene import scene_box
from volcli.schema import Camera as Asked
from volcli.schema import Job

ERRORS = (1e-1, 1e-2, 1 / 255, 1e-3, 1e-4, 1e-5)
TINY = 1e-9 + 2 * PIXEL_ERROR
"""An error that leaves float64 alone 1e-9: pixels, which are float32, have their part of any."""
ROUNDS = 5
RESOLUTION = (480, 270)
DEPTH = 5.0

CONFIGS = ("cloud", "explosion", "fire", "colored_smoke", "rotated")
ELSEWHERE = {"smoke.vdb": (1, 10), "wdas_cloud_sixteenth.vdb": (1, 10)}
"""Files, and how many times `DEPTH` they are thick."""


def main() -> None:
    """Measure and write the results."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--volumes", type=Path, help="a folder with the files of ELSEWHERE")
    asked = parser.parse_args()
    root = Path(__file__).parents[1]
    results: dict[str, Any] = {}
    scenes = [(name, *of_job(root / "configs" / f"{name}.toml")) for name in CONFIGS]
    for file, depths in ELSEWHERE.items() if asked.volumes else ():
        scenes += [
            (f"{Path(file).stem}, {t * DEPTH:g}", *of_file(asked.volumes / file, t * DEPTH))
            for t in depths
        ]
    for name, scene, plan, camera in scenes:
        results[name] = measure(scene, plan, camera)
        print(f"{name}: {results[name]['exact']}")
        for error, row in results[name]["certified"].items():
            print(f"  {error:>8s} {row}")
    write_results("certified", results)


def of_job(path: Path) -> tuple[Scene, Plan, Camera]:
    """The scene of a job file, small."""
    prepared = prepare(load_job(path, [("output.image", None)]), writes=False)
    scene = load(prepared).scene
    view = prepared.job.camera.model_copy(update={"resolution": RESOLUTION})
    return scene, replace(prepared.plan, depth=False), make_camera(view, scene_box(scene))


def of_file(path: Path, depth: float) -> tuple[Scene, Plan, Camera]:
    """A volume of one colour, scaled to an optical depth at its thickest."""
    volume = open_volume(path)
    grid, _ = load_density(volume, density_grid(volume, None)[0], "error")
    plan = make_plan(Job(), volume, frozenset({"picture"}))
    camera = make_camera(Asked(resolution=RESOLUTION), grid.world_box())
    scene = Scene(grid, 1.0, (1.0, 1.0, 1.0))
    tau = make_integrator(scene, plan)(*camera.rays(slice(None), slice(None))).tau
    return replace(scene, scale=depth / float(tau.max())), plan, camera


def measure(scene: Scene, plan: Plan, camera: Camera) -> dict[str, Any]:
    """All errors on one scene."""
    scene = replace(scene, bounds=scene_bounds(scene, plan.nearest))
    assert scene.bounds is not None, "made above"
    rays = camera.rays(slice(None), slice(None))
    exact = make_integrator(scene, plan)
    rules = {f"{e:.3g}": make_integrator(scene, replace(plan, max_error=e)) for e in ERRORS}
    seen = {name: rule(*rays) for name, rule in rules.items()}  # compiles
    full, seconds = exact(*rays), {name: [] for name in ["exact", *rules]}
    varies = bool(np.any(full.radiance))
    light = full.radiance
    if varies:
        light = make_integrator(scene, replace(plan, max_error=TINY))(*rays).radiance
    for _ in range(ROUNDS):
        for name, rule in [("exact", exact), *rules.items()]:
            begin = time.thread_time()
            rule(*rays)
            seconds[name].append(time.thread_time() - begin)
    tints = (1.0,) if scene.tint is None else scene.tint
    rows = {}
    for name, found in seen.items():
        assert found.error is not None, "an error was allowed"
        off = np.max(
            [np.abs(np.exp(-k * found.tau) - np.exp(-k * full.tau)) for k in tints], axis=0
        )
        if varies:
            lit = np.abs(found.radiance - light).max(axis=1) / scene.bounds.brightest
            off = np.maximum(off, lit)
        ratios = [a / b for a, b in zip(seconds[name], seconds["exact"], strict=True)]
        rows[name] = {
            "error": float(off.max()),
            "certificate": float(found.error.max()),
            "violations": int((off > found.error + 2.0**-24).sum()),
            "evaluations_of_exact": found.evaluated / full.evaluated,
            "seconds_of_exact": summary(ratios),
        }
    return {
        "pixels": len(full.tau),
        "colour_varies": varies,
        "exact": {"evaluations": full.evaluated, "seconds": summary(seconds["exact"])},
        "certified": rows,
    }


if __name__ == "__main__":
    main()
