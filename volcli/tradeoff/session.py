"""The order of things: a job's scene is read, its picture measured, and files are written.

It prints nothing; progress and results go to the caller.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from volcli.calibrate import calibrate
from volcli.camera import Camera, make_camera
from volcli.config import job_as_toml
from volcli.errors import OutputError, VolcliError
from volcli.files import write_file
from volcli.images import check_output
from volcli.plan import Plan
from volcli.render import Scene, available_threads
from volcli.run import UNKNOWN_BOX, OnStage, load, prepare, resolved
from volcli.scene import scene_box
from volcli.schema import Job, Quadrature
from volcli.tradeoff.advice import advise
from volcli.tradeoff.measure import Measured, measure, with_bounds
from volcli.tradeoff.plot import write_plot
from volcli.tradeoff.report import Tradeoff, as_csv, as_data
from volcli.tradeoff.settings import settings
from volcli.tradeoff.truth import true_picture

ROUNDS = 5
"""In which each setting is timed."""

QUICK = 160
"""Pixels along the longer side of a picture that is measured quickly."""


@dataclass(frozen=True)
class Wanted:
    """What the user wants to know.

    Attributes
    ----------
    target_error, time_budget
        What the advised setting is to meet: every pixel's error, and seconds of the whole picture.
    quick
        Whether a small picture is measured, and the times of the whole one taken from it.
    """

    target_error: float | None = None
    time_budget: float | None = None
    quick: bool = False

    @property
    def advice(self) -> bool:
        """Whether a setting is to be named."""
        return self.target_error is not None or self.time_budget is not None


@dataclass(frozen=True)
class Outcome:
    """What came of it.

    Attributes
    ----------
    job
        The user's job with the advised rule and all that was chosen for it; None without advice.
    """

    found: Tradeoff
    advised: Measured | None
    job: Job | None


def measure_job(
    job: Job,
    folder: Path,
    wanted: Wanted,
    *,
    rounds: int = ROUNDS,
    threads: int | None = None,
    on_stage: OnStage = lambda stage, done, total: None,
) -> Outcome:
    """Measure the picture of a job.

    Parameters
    ----------
    job
        What it asks for of the rule of integration is the user's own setting, if it asks at all.
    folder
        Where files will be written.
    on_stage
        As of `run.load`; also ``truth``, in rows, and ``measuring``, in pictures.

    Raises
    ------
    UsageError, VolumeError
        As `run.prepare` and `run.load`.
    """
    prepared = prepare(_for_the_plan(job, folder), writes=False)
    loaded = load(replace(prepared, files={}), on_stage, threads=threads)
    scene, plan = loaded.scene, prepared.plan
    box = scene_box(scene)
    full = make_camera(prepared.job.camera, UNKNOWN_BOX if box is None else box)
    camera = _smaller(full) if wanted.quick else full
    own = job.quadrature if job.quadrature.model_fields_set else None
    mine = None if own is None else _settled(own, scene, plan, full, threads)
    scene, setup_seconds = with_bounds(scene, plan, threads)
    truth = true_picture(
        scene,
        plan,
        camera,
        threads,
        lambda done, total: on_stage("truth", done, total),
    )
    rows = measure(
        scene,
        plan,
        camera,
        truth,
        settings(mine),
        rounds,
        setup_seconds,
        threads,
        lambda done, total: on_stage("measuring", done, total),
    )
    factor = _pixels(full) / _pixels(camera)
    found = Tradeoff(
        source=str(job.density.file),
        size=full.resolution,
        measured_size=camera.resolution,
        samples=len(camera.samples),
        rounds=rounds,
        threads=threads or available_threads(),
        truth_error=truth.error_bound,
        rows=tuple(row.scaled(factor) if isinstance(row, Measured) else row for row in rows),
        warnings=(*plan.warnings, *loaded.warnings),
    )
    advised = None
    if wanted.advice:
        advised = advise(found.measured, wanted.target_error, wanted.time_budget)
    chosen = None if advised is None else _with_rule(resolved(job, full), advised)
    return Outcome(found, advised, chosen)


def _for_the_plan(job: Job, folder: Path) -> Job:
    """The job as it is planned here: for the kind of picture that it asks for, wherever that is to
    be, and without the map that only one rule has.
    """
    output = job.output
    image = None if output.image is None else folder / output.image.name
    maps = tuple(name for name in output.maps if name != "error_bound")
    return job.model_copy(
        update={
            "quadrature": Quadrature(),
            "output": output.model_copy(update={"image": image, "maps": maps}),
        }
    )


def _smaller(camera: Camera) -> Camera:
    """A camera that sees the same in fewer pixels."""
    width, height = camera.resolution
    factor = min(1.0, QUICK / max(width, height))
    size = max(1, round(width * factor)), max(1, round(height * factor))
    across, down = size[0] / width, size[1] / height
    return replace(
        camera,
        resolution=size,
        pixel=(camera.pixel[0] / across, camera.pixel[1] / down),
        principal=(camera.principal[0] * across, camera.principal[1] * down),
    )


def _pixels(camera: Camera) -> int:
    return camera.resolution[0] * camera.resolution[1]


def _settled(
    own: Quadrature, scene: Scene, plan: Plan, camera: Camera, threads: int | None
) -> Quadrature:
    """The user's rule, with the step that a pilot chooses where that is what they ask for."""
    if not own.target_error:
        return own
    step = calibrate(
        scene, replace(plan, target_error=own.target_error), camera, threads
    ).step_voxels
    return Quadrature() if step is None else Quadrature(rule="midpoint", step=step)


def _with_rule(job: Job, advised: Measured) -> Job:
    """The job with the advised rule, and without a map that only another one has."""
    rule = advised.setting.quadrature
    maps = tuple(name for name in job.output.maps if name != "error_bound" or rule.max_error)
    output = job.output.model_copy(update={"maps": maps})
    return job.model_copy(update={"quadrature": rule, "output": output})


def check_files(folder: Path, *, overwrite: bool) -> None:
    """Make the folder, and see that what is to be written there can be.

    Raises
    ------
    UsageError, OutputError
        It cannot.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be made: {error.strerror or error}") from error
    for name in ("tradeoff.csv", "tradeoff.json", "tradeoff.png"):
        check_output(folder / name, overwrite=overwrite, kinds=(Path(name).suffix,))


def report(outcome: Outcome, wanted: Wanted) -> dict[str, Any]:
    """All that was found, with the advice or null, of the kinds that JSON has."""
    advised = outcome.advised
    advice = None
    if advised is not None:
        advice = {
            "target_error": wanted.target_error,
            "time_budget": wanted.time_budget,
            "rule": advised.setting.name,
            "seconds": advised.median,
            "largest_error": advised.errors.largest,
        }
    return {**as_data(outcome.found), "quick": wanted.quick, "advice": advice}


def missed(outcome: Outcome, wanted: Wanted) -> VolcliError:
    """What to raise where no setting is as good as was wanted."""
    measured, budget = outcome.found.measured, wanted.time_budget
    fastest = min(measured, key=lambda m: m.median)
    if budget is not None and fastest.median > budget:
        return VolcliError(
            f"no setting takes {budget:.3g} s or less; the fastest, {fastest.setting.name}, takes "
            f"{fastest.median:.3g} s"
        )
    finest = advise(measured, None, budget)
    assert finest is not None, "the fastest is within the budget"
    within = "" if budget is None else f" within {budget:.3g} s"
    return VolcliError(
        f"no setting{within} stays below {wanted.target_error:.3g}; {finest.setting.name} comes "
        f"nearest, {finest.errors.largest:.3g}"
    )


def write_files(folder: Path, outcome: Outcome, wanted: Wanted, *, overwrite: bool) -> list[Path]:
    """Write what was found as ``tradeoff.csv``, ``.json`` and ``.png``; returns their paths.

    Raises
    ------
    OutputError
        One cannot be written.
    """
    table, data, plot = (folder / f"tradeoff.{kind}" for kind in ("csv", "json", "png"))
    write_file(table, as_csv(outcome.found), overwrite=overwrite)
    text = json.dumps(report(outcome, wanted), allow_nan=False, indent=1)
    write_file(data, text.encode(), overwrite=overwrite)
    write_plot(
        plot,
        outcome.found,
        target_error=wanted.target_error,
        time_budget=wanted.time_budget,
        advised=outcome.advised,
        overwrite=overwrite,
    )
    return [table, data, plot]


def write_job(path: Path, job: Job, *, overwrite: bool) -> None:
    """Write a job file.

    Raises
    ------
    OutputError
        It cannot be written.
    """
    write_file(path, job_as_toml(job).encode(), overwrite=overwrite)
