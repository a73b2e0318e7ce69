"""Errors of the rules against the tests' float64 reference, on the sample volumes.

    python -m benchmarks.accuracy [JOB.toml ...]

For each job: rays through random pixels, the same rays through the slow reference renderer of
``tests/reference.py`` (which shares no code with volcli), and the largest errors of transmittance,
of radiance relative to its maximum, and of the hit distance relative to itself. The order of
convergence of midpoint is the slope of the mean error of transmittance over the steps.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common import write_results
from volcli.camera import make_camera
from volcli.config import load_job
from volcli.grids import BrickGrid
from volcli.plan import Plan
from volcli.render import Source, make_integrator
from volcli.run import load, prepare

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tests"))

import reference  # noqa: E402 - lies in tests

JOBS = tuple(
    ROOT / "configs" / f"{name}.toml" for name in ("cloud", "colored_smoke", "explosion", "rotated")
)
"""A job for each sample, of terms that the reference knows: a density and a colour as they are."""

RAYS = 400
STEPS = (1.0, 0.5, 0.25, 0.125, 0.0625)


def compare(path: Path, rays: int = RAYS, steps: Sequence[float] = STEPS) -> dict[str, Any]:
    """Errors of the exact rule, and of midpoint at some steps, on one job."""
    # Nothing is written here, and the folder that the job writes to need not exist.
    prepared = prepare(load_job(path, [("output.image", None)]), writes=False)
    job, plan, volumes = prepared.job, prepared.plan, prepared.volumes
    assert plan.density is not None, "what is compared is the optical depth"
    scene = load(prepared).scene
    lattice = lattice_of(volumes.density.read_tree(plan.density), scene.density)
    color_lattice = None
    if isinstance(scene.color, Source):
        assert plan.color is not None, "it was read"
        color_lattice = lattice_of(volumes.color.read_tree(plan.color), scene.color.grid)

    camera = make_camera(job.camera, scene.density.world_box())
    origins, directions = camera.rays(slice(None), slice(None))
    tau = make_integrator(scene, _variant(plan, None))(origins, directions)[0]
    hit = np.flatnonzero(tau > 1e-3)
    chosen = np.random.default_rng(1).choice(hit, min(rays, len(hit)), replace=False)
    origins, directions = origins[chosen], directions[chosen]
    truth = reference.trace_all(origins, directions, lattice, job.density.scale, color_lattice)

    found: dict[str, Any] = {"rays": len(chosen)}
    for step in (None, *steps):
        seen = make_integrator(scene, _variant(plan, step))(origins, directions)
        found["exact" if step is None else f"midpoint {step:g}"] = _errors(
            seen, truth, color_lattice is not None
        )
    if steps:
        means = [found[f"midpoint {step:g}"]["transmittance_mean"] for step in steps]
        found["observed_order"] = float(np.polyfit(np.log(steps), np.log(means), 1)[0])
    return found


def _variant(plan: Plan, step: float | None) -> Plan:
    """The plan with depth, to the end of every ray, by the rule that is asked for."""
    return replace(plan, depth=True, step_voxels=step, max_error=None)


def lattice_of(tree: Any, grid: BrickGrid) -> Any:
    """A grid as the reference renderer takes it."""
    return reference.Lattice(reference.of_tree(tree), grid.world_from_index, grid.active_box)


def _errors(seen: Any, truth: Any, colored: bool) -> dict[str, float | None]:
    tau, light, distance, _, _ = seen
    true_tau, true_light, true_distance = truth
    transmittance = np.abs(np.exp(-tau) - np.exp(-true_tau))
    errors = {
        "transmittance": float(transmittance.max()),
        "transmittance_mean": float(transmittance.mean()),
        "optical_depth_relative": float((np.abs(tau - true_tau) / true_tau).max()),
        "distance_relative": _largest(np.abs(distance - true_distance) / true_distance),
    }
    if colored:
        difference = np.abs(light - true_light).max()
        errors["radiance_relative_to_max"] = float(difference / np.abs(true_light).max())
    return errors


def _largest(errors: Any) -> float | None:
    """The largest, or None where a coarse step saw nothing to measure a distance to."""
    return float(errors.max()) if np.isfinite(errors).all() else None


def main(arguments: list[str]) -> None:
    """Compare on the jobs named, or on `JOBS`."""
    paths = [Path(a) for a in arguments] or JOBS
    results = {}
    for path in paths:
        results[path.stem] = compare(path)
        print(f"\n{path.stem}: {results[path.stem]['rays']} rays")
        for name, errors in results[path.stem].items():
            if isinstance(errors, dict):
                shown = "  ".join(f"{key} {value or 0:.1e}" for key, value in errors.items())
                print(f"  {name:16s} {shown}")
        print(f"  order of convergence of midpoint: {results[path.stem]['observed_order']:.2f}")
    write_results("accuracy", results)


if __name__ == "__main__":
    main(sys.argv[1:])
