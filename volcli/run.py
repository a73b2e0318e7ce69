"""A job from files to files: open, plan, read, render, write. The one way a picture is made.

`volcli render` calls it once. It prints nothing; progress and results go to the caller.
"""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from volcli import __version__, images
from volcli.camera import Camera, make_camera
from volcli.config import job_as_toml
from volcli.errors import UsageError
from volcli.grids import BrickGrid, Volume, load_color, load_density, open_volume
from volcli.plan import Plan, make_plan
from volcli.render import RenderResult, Scene, over, render
from volcli.schema import Job

OnStage = Callable[[str, int, int], None]
"""Called as ``on_stage(stage, done, total)``; stages are reading, compiling, rendering, writing."""


@dataclass(frozen=True)
class Prepared:
    """A job with its volume opened and its plan made: all that can fail early has not failed.

    Attributes
    ----------
    files
        What will be written: the picture under ``picture``, maps under their names.
    """

    job: Job
    volume: Volume
    plan: Plan
    files: dict[str, Path]
    background: Any


@dataclass(frozen=True)
class Report:
    """What a job did, as ``render --json`` prints it.

    Attributes
    ----------
    image, maps
        Files written; for a map of a PNG also the values that black and white stand for.
    camera
        Eye, target, up, and fov or width: as asked for or as chosen.
    seconds
        ``load``, ``compile``, ``render``, ``write``.
    transmittance
        ``min``, ``mean``, ``max`` over the pixels.
    grids
        Bytes held by each grid that was read.
    """

    image: str | None
    maps: dict[str, dict[str, Any]]
    size: tuple[int, int]
    rule: str
    rays: int
    cells: int
    seconds: dict[str, float]
    transmittance: dict[str, float]
    camera: dict[str, Any]
    grids: dict[str, int]
    peak_memory_bytes: int
    warnings: list[str]


def prepare(job: Job, *, overwrite: bool = True) -> Prepared:
    """Open and check all that a job names, before any work: volume, grids, outputs, background.

    Raises
    ------
    UsageError, VolumeError, OutputError
        Whatever is wrong first.
    """
    files = _outputs(job)
    for path in files.values():
        images.check_output(path, overwrite=overwrite)
    if job.density.file is None:
        raise UsageError("no volume: the job has no density.file; give one")
    volume = open_volume(job.density.file, job.density.reader)
    layers = set(files)
    if "picture" in files and files["picture"].suffix.lower() == ".exr":
        layers |= {"transmittance", "optical_depth", "depth"}
    plan = make_plan(job, volume, frozenset(layers))
    background = None
    if job.background.color is not None:
        background = np.array([*job.background.color, 1.0], np.float32)
    elif job.background.image is not None:
        background = images.read_background(job.background.image, job.camera.resolution)
    return Prepared(job, volume, plan, files, background)


def run(
    prepared: Prepared,
    *,
    threads: int | None = None,
    overwrite: bool = True,
    on_stage: OnStage = lambda stage, done, total: None,
) -> Report:
    """Read, render and write a prepared job.

    Raises
    ------
    VolumeError, OutputError, NonFiniteError, UsageError
        A file is damaged; a result cannot be written; a pixel is NaN or Inf; the camera the job
        asks for has no frame.
    """
    job, plan, volume = prepared.job, prepared.plan, prepared.volume
    warnings = list(plan.warnings)
    begin = time.perf_counter()
    density, notes = load_density(
        volume, plan.density, job.density.nonfinite, lambda d, n: on_stage("reading", d, n)
    )
    warnings += notes
    grids = {plan.density.label: density.nbytes}
    color: BrickGrid | tuple[float, float, float] = job.color.value
    if plan.color is not None:
        color, notes = load_color(
            volume, plan.color, job.density.nonfinite, lambda d, n: on_stage("reading", d, n)
        )
        warnings += notes
        grids[plan.color.label] = color.nbytes
    loaded = time.perf_counter()

    box = np.array([[-1.0] * 3, [1.0] * 3]) if density.is_empty else density.world_box()
    camera = make_camera(job.camera, box)
    on_stage("compiling", 0, 1)
    result = render(
        Scene(density, job.density.scale, color),
        plan,
        camera,
        threads=threads,
        on_compiled=lambda: on_stage("compiling", 1, 1),
        progress=lambda d, n: on_stage("rendering", d, n),
    )
    seconds = {
        "load": loaded - begin,
        "compile": result.compile_seconds,
        "render": result.render_seconds,
    }
    resolved = _resolved(job, camera)
    writing = time.perf_counter()
    maps, notes = _write(prepared, result, resolved, seconds, overwrite, on_stage)
    seconds["write"] = time.perf_counter() - writing
    picture = prepared.files.get("picture")
    return Report(
        image=None if picture is None else str(picture),
        maps=maps,
        size=camera.resolution,
        rule=plan.rule,
        rays=camera.resolution[0] * camera.resolution[1],
        cells=result.evaluations,
        seconds={name: round(value, 4) for name, value in seconds.items()},
        transmittance={
            "min": float(result.transmittance.min()),
            "mean": float(result.transmittance.mean(dtype=np.float64)),
            "max": float(result.transmittance.max()),
        },
        camera=resolved.camera.model_dump(mode="json", exclude_none=True),
        grids=grids,
        peak_memory_bytes=peak_memory_bytes(),
        warnings=warnings + notes,
    )


def peak_memory_bytes() -> int:
    """The most memory that this process has held."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def _outputs(job: Job) -> dict[str, Path]:
    """What the job writes: the picture and, beside it, ``<stem>.<map>.<ext>``."""
    picture = job.output.image
    if picture is None:
        raise UsageError("nothing to write: give -o OUT.exr (or output.image in the job)")
    files = {"picture": picture}
    for name in job.output.maps:
        files[name] = picture.with_name(f"{picture.stem}.{name}{picture.suffix}")
    return files


def _resolved(job: Job, camera: Camera) -> Job:
    """The job with what was chosen for it filled in, so that it makes the same picture again."""
    chosen: dict[str, Any] = {
        "eye": tuple(camera.eye.tolist()),
        "target": tuple(camera.target.tolist()),
    }
    if not camera.perspective:
        width, height = camera.resolution
        chosen["width"] = 2 * camera.half_height * width / height
    return job.model_copy(update={"camera": job.camera.model_copy(update=chosen)})


def _write(
    prepared: Prepared,
    result: RenderResult,
    resolved: Job,
    seconds: dict[str, float],
    overwrite: bool,
    on_stage: OnStage,
) -> tuple[dict[str, dict[str, Any]], list[str]]:
    """Write the picture and the maps; returns what was written of maps, and warnings."""
    header: dict[str, str | int | float] = {
        "Software": f"volcli {__version__}",
        "volcli:version": __version__,
        "volcli:rule": prepared.plan.rule,
        "volcli:job": job_as_toml(resolved),
        **{f"volcli:seconds_{name}": float(value) for name, value in seconds.items()},
    }
    layers = {
        "transmittance": result.transmittance,
        "opacity": result.opacity,
        "optical_depth": result.optical_depth,
        "depth": result.depth,
    }
    warnings: list[str] = []
    maps: dict[str, dict[str, Any]] = {}
    for done, (name, path) in enumerate(prepared.files.items()):
        on_stage("writing", done, len(prepared.files))
        if name != "picture":
            values = layers[name]
            assert values is not None, "the plan evaluates what is written"
            low, high = images.write_map(path, values, header, name=name, overwrite=overwrite)
            maps[name] = {"file": str(path), "black": low, "white": high}
            continue
        picture = over(result, prepared.background)
        if path.suffix.lower() == ".png":
            warnings += images.write_png(
                path, picture, header, bits=resolved.output.bits, overwrite=overwrite
            )
            continue
        channels = {c: picture[..., i] for i, c in enumerate("RGBA")}
        assert result.depth is not None, "the plan evaluates depth for an EXR"
        channels |= {
            "Z": result.depth,
            "transmittance.Y": result.transmittance,
            "optical_depth.Y": result.optical_depth,
        }
        images.write_exr(path, channels, header, overwrite=overwrite)
    on_stage("writing", len(prepared.files), len(prepared.files))
    return maps, warnings
