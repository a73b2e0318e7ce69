"""From a job to its rays: the scene is read, and each ray walked and put through the rules."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from volcli.camera import Camera, make_camera
from volcli.errors import UsageError
from volcli.plan import Plan
from volcli.probe.report import report
from volcli.probe.rules import sample_count, seen_by, with_step
from volcli.probe.walk import Walk, walk
from volcli.render import MAX_STEPS, Scene
from volcli.run import UNKNOWN_BOX, OnStage, load, prepare
from volcli.scene import scene_box
from volcli.schema import Job

DEFAULT_STEP = 1.0
"""Voxels: the step of midpoint that is shown where neither job nor caller names one."""

Rays = list[tuple[tuple[int, int] | None, Any, Any, float]]
"""(pixel, origin, direction, depth per distance) of each ray."""


def probe_job(
    job: Job,
    pixels: Sequence[tuple[float, ...]],
    lines: Sequence[tuple[float, ...]],
    steps: Sequence[float] | None = None,
    on_stage: OnStage = lambda stage, done, total: None,
) -> tuple[list[dict[str, Any]], list[Walk | None], list[str]]:
    """Follow rays through the scene of a job.

    Parameters
    ----------
    pixels
        (x, y) of pixels, whose centre the ray goes through.
    lines
        (ox, oy, oz, dx, dy, dz), world units; the direction of any length.
    steps
        Steps of the midpoint rule, in voxels, that are shown beside the exact rule; None: the job's
        step, else `DEFAULT_STEP`.
    on_stage
        Told of the reading, as `run.load` tells.

    Returns
    -------
    The `report` of each ray, its walk, and warnings.

    Raises
    ------
    UsageError, VolumeError
        As `run.prepare` and `run.load`; also of a pixel outside the picture, and of a ray without
        a direction.
    """
    prepared = prepare(job.model_copy(update={"output": type(job.output)()}), writes=False)
    loaded = load(prepared, on_stage)
    plan, scene = prepared.plan, loaded.scene
    box = scene_box(scene)
    camera = make_camera(prepared.job.camera, UNKNOWN_BOX if box is None else box)
    rays = _through(camera, pixels) + _along(camera, lines)
    found, walks = [], []
    for pixel, origin, direction, depth in rays:
        walked = walk(scene, plan.nearest, origin, direction)
        rules = [
            rule
            for rule in _rules(plan, steps)
            if steps or rule.step_voxels is None or _short(scene, rule, origin, direction)
        ]
        seen = [seen_by(scene, rule, origin, direction) for rule in rules]
        walks.append(walked)
        found.append(report(walked, seen, origin, direction, pixel=pixel, depth_per_distance=depth))
    warnings = [*plan.warnings, *loaded.warnings]
    if pixels and len(camera.samples) > 1:
        warnings.append(
            f"a pixel is the mean of {len(camera.samples)} rays (camera.samples); followed is the "
            f"one through its middle"
        )
    return found, walks, warnings


def _rules(plan: Plan, steps: Sequence[float] | None) -> list[Plan]:
    """The exact rule, with values blended and not, the certified one if the job has it, and
    midpoint with each step.
    """
    if not steps:
        steps = [DEFAULT_STEP if plan.step_voxels is None else plan.step_voxels]
    exact = with_step(plan, None)
    other = replace(exact, nearest=not plan.nearest)
    certified = [] if plan.max_error is None else [plan]
    return [exact, *certified, *(with_step(plan, step) for step in steps), other]


def _short(scene: Scene, rule: Plan, origin: Any, direction: Any) -> bool:
    """Whether midpoint, for which nobody asked, can be shown on this ray at all."""
    return sample_count(scene, rule, origin, direction) <= MAX_STEPS


def _through(camera: Camera, pixels: Sequence[tuple[float, ...]]) -> Rays:
    width, height = camera.resolution
    rays: Rays = []
    for x, y in ((int(x), int(y)) for x, y in pixels):
        if not (x < width and y < height):
            raise UsageError(
                f"--pixel {x},{y}: the picture is {width}x{height}; give a column up to "
                f"{width - 1} and a row up to {height - 1}, or another --size"
            )
        origins, directions = camera.rays(slice(y, y + 1), slice(x, x + 1))
        depth = float(camera.depth_per_distance(directions)[0])
        rays.append(((x, y), origins[0], directions[0], depth))
    return rays


def _along(camera: Camera, lines: Sequence[tuple[float, ...]]) -> Rays:
    rays: Rays = []
    for line in lines:
        origin, direction = np.array(line[:3]), np.array(line[3:])
        largest = np.abs(direction).max()
        if largest == 0:
            raise UsageError("--ray: has no direction; the last three numbers are all 0")
        direction /= largest  # first, or squares of tiny numbers would be 0
        direction /= np.linalg.norm(direction)
        depth = float(camera.depth_per_distance(direction[None])[0])
        rays.append((None, origin, direction, depth))
    return rays
