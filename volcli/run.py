"""A job from files to files: `prepare` opens and plans, `load` reads, `run` renders and writes.

The one way a picture is made; `volcli render` calls each once. It prints nothing; progress and
results go to the caller.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import volcli
from volcli import images
from volcli.calibrate import Pilot, calibrate
from volcli.camera import Camera, make_camera
from volcli.config import job_as_toml
from volcli.errors import UsageError
from volcli.estimate import check_memory
from volcli.grids import Cache, GridHeader, Progress
from volcli.grids.threads import threads_limited_to
from volcli.memory import memory_limited_to, peak_memory_bytes
from volcli.outputs import outputs, write_outputs
from volcli.plan import Plan, make_plan
from volcli.render import RenderResult, Scene, Window, make_integrator, render
from volcli.reproduce import naming_the_ray
from volcli.scene import Volumes, make_scene, open_volumes, read_grids, scene_box
from volcli.schema import DEFAULT_FOV, Job, Quadrature
from volcli.tables import ColorTable, check_maps
from volcli.transforms import each_camera
from volcli.warmup import StandIn, WarmUp

UNKNOWN_BOX = np.array([[-1.0] * 3, [1.0] * 3])
"""(2, 3) world units: what is framed where there is no volume to frame."""

OnStage = Callable[[str, int, int], None]
"""Called as ``on_stage(stage, done, total)``; a stage is one of ``reading GRID``, ``compiling`` (if
there is something to compile), ``calibrating`` (if a step is to be chosen), ``rendering``,
``writing``.
"""


@dataclass(frozen=True)
class Prepared:
    """A job with its volumes opened and its plan made: all that can fail early has not failed.

    Attributes
    ----------
    files
        What will be written: the picture under ``picture``, maps under their names.
    """

    job: Job
    volumes: Volumes
    plan: Plan
    files: dict[str, Path]
    background: Any


@dataclass(frozen=True)
class Loaded:
    """The grids that a job needs, in memory; those of one of its pictures are those of each.

    Attributes
    ----------
    scene
        The grids with what the job makes of their values.
    warnings
        What was changed in the values on the way.
    seconds
        How long reading took.
    kernels
        What will render them, being made ready; None where nothing is to be rendered.
    """

    scene: Scene
    warnings: tuple[str, ...]
    seconds: float
    kernels: WarmUp | None


@dataclass(frozen=True)
class Rendered:
    """A picture before it is written.

    Attributes
    ----------
    job
        The job with what was chosen for it filled in, so that it makes the same picture again.
    rule
        How it was rendered, for people.
    pilot
        What chose the step, or None where the job says how to render.
    result
        The arrays; its times, with that of loading, are in ``seconds``.
    warnings
        What the user should know of the choices made and of the values read.
    """

    job: Job
    rule: str
    pilot: Pilot | None
    result: RenderResult
    seconds: dict[str, float]
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class Report:
    """What a job did.

    Attributes
    ----------
    image, maps
        Files written; for a map of a PNG also the values that black and white stand for.
    camera
        Eye, target, up, and fov or width: as asked for or as chosen.
    pilot
        What chose the step, as plain data (see `calibrate.Pilot`); None where none was to choose.
    seconds
        ``load``, ``compile``, ``render``, ``write``; ``pilot`` where there was one.
    transmittance
        ``min``, ``mean``, ``max`` over the pixels.
    error_bound
        The largest of all pixels' certified errors; None where none was allowed.
    error_estimate
        The largest of all pixels' estimated errors; None where nobody asked.
    """

    image: str | None
    maps: dict[str, dict[str, Any]]
    size: tuple[int, int]
    rule: str
    rays: int
    cells: int
    seconds: dict[str, float]
    transmittance: dict[str, float]
    error_bound: float | None
    error_estimate: float | None
    pilot: dict[str, Any] | None
    camera: dict[str, Any]
    peak_memory_bytes: int
    warnings: list[str]


def prepare(job: Job, *, overwrite: bool = True, writes: bool = True) -> Prepared:
    """`prepare_each` of a job that asks for one picture.

    Raises
    ------
    UsageError
        Also if it asks for several.
    """
    pictures = prepare_each(job, overwrite=overwrite, writes=writes)
    if len(pictures) > 1:
        raise UsageError(
            f'camera.frame = "all": {len(pictures)} pictures where one is wanted; give a number'
        )
    return pictures[0]


def prepare_each(job: Job, *, overwrite: bool = True, writes: bool = True) -> tuple[Prepared, ...]:
    """Open and check all that a job names, before any work: volume, grids, outputs, background.

    A job asks for one picture, or for one from each of the cameras of ``camera.transforms``. They
    have their volume, their plan and what `load` reads in common.

    Parameters
    ----------
    writes
        Whether there must be an output; else a job without one is planned as if for an EXR.

    Raises
    ------
    UsageError, VolumeError, OutputError
        Whatever is wrong first.
    """
    jobs = each_camera(job)
    files = [outputs(one) for one in jobs]
    if writes and not files[0]:
        raise UsageError("nothing to write: give -o OUT.exr (or output.image in the job)")
    for path in (path for of_one in files for path in of_one.values()):
        images.check_output(path, overwrite=overwrite)
    if job.density.file is None:
        raise UsageError("no volume: the job has no density.file; give one")
    for camera in (one.camera for one in jobs):
        if camera.eye is not None and camera.target is not None:
            make_camera(camera, UNKNOWN_BOX)  # raises now what needs no volume to be known
    check_maps(job)
    volumes = open_volumes(job)
    layers = {"picture", *job.output.maps}
    if not files[0] or files[0]["picture"].suffix.lower() == ".exr":
        layers |= {"transmittance", "optical_depth", "depth"}
    plan = make_plan(job, volumes.density, frozenset(layers), volumes.color, volumes.emission)
    behind = {size: _background(job, size) for size in {one.camera.size for one in jobs}}
    return tuple(
        Prepared(one, volumes, plan, of_one, behind[one.camera.size])
        for one, of_one in zip(jobs, files, strict=True)
    )


def _background(job: Job, size: tuple[int, int]) -> Any:
    """What is behind the volume in a picture of that size: (4,), (h, w, 4), or None."""
    if job.background.color is not None:
        return np.array([*job.background.color, 1.0], np.float32)
    if job.background.image is not None:
        return images.read_background(job.background.image, size)
    return None


def load(
    prepared: Prepared,
    on_stage: OnStage = lambda stage, done, total: None,
    cache: Cache | None = None,
    threads: int | None = None,
    memory: int | None = None,
) -> Loaded:
    """Read the grids that the plan names, and meanwhile begin to make the kernels ready.

    Parameters
    ----------
    cache
        What keeps bricks from one load to the next.
    threads
        Default: the processors that this process may use.
    memory
        Bytes that this process may take in all. Default: `memory.SHARE` of what is free.

    Raises
    ------
    VolumeError
        A file is damaged, holds NaN or Inf where the job does not accept them, or does not fit
        into memory.
    UsageError
        The picture does not.
    """

    def progress(header: GridHeader) -> Progress:
        return lambda done, total: on_stage(f"reading {header.label}", done, total)

    job, plan, volumes = prepared.job, prepared.plan, prepared.volumes
    begin = time.perf_counter()
    with memory_limited_to(memory):
        check_memory(job, plan, volumes)
    kernels = WarmUp(lambda: _use_kernels(prepared)) if prepared.files else None
    with threads_limited_to(threads), memory_limited_to(memory):
        grids, warnings = read_grids(job, plan, volumes, progress, cache)
    scene, notes = make_scene(job, plan, volumes, grids, threads=threads)
    return Loaded(scene, (*warnings, *notes), time.perf_counter() - begin, kernels)


def run(
    prepared: Prepared,
    loaded: Loaded,
    *,
    threads: int | None = None,
    overwrite: bool = True,
    on_stage: OnStage = lambda stage, done, total: None,
) -> Report:
    """Render and write a job.

    Raises
    ------
    OutputError, NonFiniteError, UsageError
        A result cannot be written; a pixel is NaN or Inf; the camera the job asks for has no
        frame.
    """
    rendered = render_loaded(prepared, loaded, threads=threads, on_stage=on_stage)
    return write(prepared, rendered, overwrite=overwrite, on_stage=on_stage)


def render_loaded(
    prepared: Prepared,
    loaded: Loaded,
    *,
    threads: int | None = None,
    window: Window | None = None,
    on_stage: OnStage = lambda stage, done, total: None,
) -> Rendered:
    """The first half of `run`: the arrays of a picture, or of a part of it."""
    plan, box = prepared.plan, scene_box(loaded.scene)
    box = UNKNOWN_BOX if box is None else box
    job = resolved(prepared.job, make_camera(prepared.job.camera, box))
    # Made anew from what was chosen, so that the job in the header gives the same rays to the bit.
    camera = make_camera(job.camera, box)
    waiting = time.perf_counter()
    if loaded.kernels is not None:
        loaded.kernels.wait(lambda done, total: on_stage("compiling", done, total))
    waited = time.perf_counter() - waiting
    from volcli.kernels.compiler import notes

    pilot, seconds = None, {"load": loaded.seconds}
    if plan.target_error is not None:
        begin = time.perf_counter()
        with naming_the_ray(job):
            pilot = calibrate(
                loaded.scene,
                plan,
                camera,
                threads=threads,
                progress=lambda d, n: on_stage("calibrating", d, n),
            )
        plan, job = pilot.settled(plan), _settled(job, pilot)
        seconds["pilot"] = time.perf_counter() - begin
    with naming_the_ray(job):
        result = render(
            loaded.scene,
            plan,
            camera,
            threads=threads,
            window=window,
            progress=lambda d, n: on_stage("rendering", d, n),
        )
    seconds |= {
        "compile": waited + result.compile_seconds,
        "render": result.render_seconds,
    }
    rule = plan.rule if pilot is None else f"{prepared.plan.rule}: {plan.rule}"
    density = loaded.scene.density
    far = [] if density.is_empty else camera.warnings(density.local_from_world)
    warnings = (*plan.warnings, *loaded.warnings, *notes, *far)
    return Rendered(job, rule, pilot, result, seconds, warnings)


def _use_kernels(prepared: Prepared) -> None:
    """Have no rays integrated through a stand-in for the volumes, as the picture's will be."""
    job, plan = prepared.job, prepared.plan
    density, color, emission = (
        StandIn(volume.path, volume.headers)
        for volume in (
            prepared.volumes.density,
            prepared.volumes.color,
            prepared.volumes.emission,
        )
    )
    volumes = Volumes(density, color, emission)
    grids, _ = read_grids(job, plan, volumes)
    # Its values are no temperatures: any table will do.
    ramp = ColorTable(np.array([0.0, 1.0]), np.zeros((2, 3)))
    scene, _ = make_scene(job, plan, volumes, grids, table=lambda *_: ramp)
    nothing = np.empty((0, 3))
    make_integrator(scene, plan, estimate=plan.estimate)(nothing, nothing)
    if plan.target_error is not None:
        make_integrator(scene, replace(plan, step_voxels=1.0))(nothing, nothing)


def write(
    prepared: Prepared,
    rendered: Rendered,
    *,
    overwrite: bool = True,
    on_stage: OnStage = lambda stage, done, total: None,
) -> Report:
    """The second half of `run`: arrays to files."""
    job, result, seconds = rendered.job, rendered.result, dict(rendered.seconds)
    writing = time.perf_counter()
    header: dict[str, str | int | float] = {
        "Software": f"volcli {volcli.__version__}",
        "volcli:version": volcli.__version__,
        "volcli:rule": rendered.rule,
        "volcli:job": job_as_toml(job),
        **{f"volcli:seconds_{name}": float(value) for name, value in seconds.items()},
    }
    if result.error_bound is not None:
        header["volcli:error_bound"] = float(result.error_bound.max())
    if result.error_estimate is not None:
        header["volcli:error_estimate"] = float(result.error_estimate.max())
    if rendered.pilot is not None:
        header["volcli:target_error"] = rendered.pilot.target_error
        header["volcli:pilot"] = f"an estimate: {rendered.pilot.said}"
    maps, notes = write_outputs(
        prepared.files,
        result,
        prepared.background,
        header,
        bits=job.output.bits,
        overwrite=overwrite,
        on_stage=on_stage,
    )
    seconds["write"] = time.perf_counter() - writing
    picture = prepared.files.get("picture")
    width, height = job.camera.size
    return Report(
        image=None if picture is None else str(picture),
        maps=maps,
        size=(width, height),
        rule=rendered.rule,
        rays=width * height * job.camera.samples,
        cells=result.evaluations,
        seconds={name: round(value, 4) for name, value in seconds.items()},
        transmittance={
            "min": float(result.transmittance.min()),
            "mean": float(result.transmittance.mean(dtype=np.float64)),
            "max": float(result.transmittance.max()),
        },
        error_bound=_largest(result.error_bound),
        error_estimate=_largest(result.error_estimate),
        pilot=None if rendered.pilot is None else rendered.pilot.as_data(),
        camera=job.camera.model_dump(mode="json", exclude_none=True),
        peak_memory_bytes=peak_memory_bytes(),
        warnings=[*rendered.warnings, *notes],
    )


def _settled(job: Job, pilot: Pilot) -> Job:
    """The job with the rule that a pilot chose, so that it needs none again."""
    step = pilot.step_voxels
    chosen = Quadrature() if step is None else Quadrature(rule="midpoint", step=step)
    return job.model_copy(update={"quadrature": chosen})


def resolved(job: Job, camera: Camera) -> Job:
    """The job with what was chosen for it filled in, so that it makes the same picture anywhere."""
    chosen: dict[str, Any] = {
        "eye": tuple(camera.eye.tolist()),
        "target": tuple(camera.target.tolist()),
        "resolution": camera.resolution,
    }
    if camera.type == "orthographic" and job.camera.width is None:
        chosen["width"] = camera.pixel[0] * camera.resolution[0]
    if camera.type == "perspective" and job.camera.focal is None and job.camera.fov is None:
        chosen["fov"] = DEFAULT_FOV
    parts: dict[str, Any] = {"camera": job.camera.model_copy(update=chosen)}
    named = ("density.file", "color.file", "emission.file", "background.image", "output.image")
    for part, name in (key.split(".") for key in named):
        table = getattr(job, part)
        path = getattr(table, name)
        if path is not None:
            parts[part] = table.model_copy(update={name: path.absolute()})
    return job.model_copy(update=parts)


def _largest(layer: Any) -> float | None:
    """The largest value of a layer, None if there is none."""
    return None if layer is None else float(layer.max())
