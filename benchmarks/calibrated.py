"""What `--target-error` keeps and what it buys, and whether `volcli tradeoff` says the same twice.

    python -m benchmarks.calibrated [VOLUME.vdb ...]

Each volume is framed and rendered exactly and calibrated, in turns; every pixel of the calibrated
picture is held to the exact one, and counted where it is farther off than was asked for (light: as
a share of the brightest). Then ``tradeoff`` is asked twice for the cheapest setting on the cloud of
the samples.
"""

from __future__ import annotations

import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common import CLOUD_THRESHOLD, make_cloud, summary, write_results
from volcli.bounds import brightest_light
from volcli.calibrate import Pilot
from volcli.config import load_job
from volcli.run import Loaded, Prepared, Rendered, load, prepare, render_loaded
from volcli.tradeoff.advice import cheapest
from volcli.tradeoff.session import Wanted, measure_job

ROOT = Path(__file__).parents[1]

TARGETS = (1e-2, 1 / 255, 1e-3)
ROUNDS = 5
ASKED = 2
"""Times that ``tradeoff`` measures the same."""

SIGMA_PER_VOXEL = 0.05


def compare(path: Path, settings: list[str]) -> dict[str, Any]:
    """Exact and calibrated pictures of a volume."""
    prepared = _prepared(path, settings)
    loaded = load(prepared)
    exact = render_loaded(prepared, loaded)  # compiles
    brightest = brightest_light(loaded.scene, prepared.plan.nearest)
    found: dict[str, Any] = {}
    for target in TARGETS:
        wanted = _prepared(path, [*settings, f"quadrature.target_error={target}"])
        render_loaded(wanted, loaded)
        seconds: list[float] = []
        ratios: list[float] = []
        whole: list[float] = []
        fast, _ = _timed(wanted, loaded)
        settled = replace(prepared, plan=_pilot(fast).settled(wanted.plan))
        for _ in range(ROUNDS):
            _, with_pilot = _timed(wanted, loaded)
            _, without = _timed(settled, loaded)
            _, slow = _timed(prepared, loaded)
            seconds.append(without)
            ratios.append(slow / without)
            whole.append(slow / with_pilot)
        off = _errors(fast, exact, brightest)
        found[f"{target:g}"] = {
            "rule": fast.rule,
            "pilot": _pilot(fast).as_data(),
            "pixels": off.size,
            "pixels_above": int(np.count_nonzero(off > target)),
            "largest_error": float(off.max()),
            "processor_seconds": summary(seconds),
            "times_faster": summary(ratios),
            "times_faster_with_pilot": summary(whole),
        }
    return found


def ask(path: Path, settings: list[str], folder: Path) -> dict[str, list[str]]:
    """The cheapest setting for each target, as ``tradeoff`` measures it again and again."""
    job = load_job(path, [], settings)
    answers: dict[str, list[str]] = {}
    for _ in range(ASKED):
        measured = measure_job(job, folder, Wanted()).found.measured
        for target in TARGETS:
            advised = cheapest(measured, target)
            named = advised.setting.name if advised else "none"
            answers.setdefault(f"{target:g}", []).append(named)
    return answers


def _timed(prepared: Prepared, loaded: Loaded) -> tuple[Rendered, float]:
    """A picture, and the seconds of all processors that it took: others may be at work as well."""
    begin = time.process_time()
    rendered = render_loaded(prepared, loaded)
    return rendered, time.process_time() - begin


def _pilot(rendered: Rendered) -> Pilot:
    assert rendered.pilot is not None, "it was asked for"
    return rendered.pilot


def _prepared(path: Path, settings: list[str]) -> Prepared:
    """For the layers of an EXR."""
    return prepare(load_job(path, [], settings), writes=False)


def _errors(fast: Rendered, exact: Rendered, brightest: float) -> Any:
    through, light = (
        np.abs(getattr(fast.result, name).astype(np.float64) - getattr(exact.result, name))
        for name in ("transmittance", "radiance")
    )
    return np.maximum(through, light.max(axis=-1) / brightest)


def main(arguments: list[str]) -> None:
    """Compare on the volumes named, on the cloud of the samples, and on one of 512^3 voxels."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        large = make_cloud(folder / "cloud_512.vdb", 512, CLOUD_THRESHOLD)
        volumes: list[tuple[Path, list[str]]] = [
            (ROOT / "samples" / "cloud.vdb", ["density.scale=16"]),
            (large, [f"density.scale={SIGMA_PER_VOXEL}"]),
            *((Path(argument), []) for argument in arguments),
        ]
        results = {}
        for path, settings in volumes:
            calibrated = compare(path, settings)
            for target, row in calibrated.items():
                print(
                    f"{path.stem} {target}: {row['rule']}; {row['pixels_above']} of "
                    f"{row['pixels']} pixels above; {row['times_faster']['median']:.2f} times "
                    f"faster, {row['times_faster_with_pilot']['median']:.2f} with the pilot"
                )
            results[path.stem] = calibrated
        answers = ask(*volumes[0], folder)
        print(f"tradeoff: {answers}")
        write_results("calibrated", {"volumes": results, "tradeoff": answers})


if __name__ == "__main__":
    main(sys.argv[1:])
