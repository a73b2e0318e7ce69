"""One ray by volcli's own rules: what each makes of it, and where midpoint takes its samples."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from volcli.errors import UsageError
from volcli.plan import Plan
from volcli.probe.field import Floats
from volcli.probe.walk import span
from volcli.render import MAX_STEPS, PIXEL_ERROR, Scene, Source, make_integrator


@dataclass(frozen=True)
class Seen:
    """What a rule makes of a ray.

    Attributes
    ----------
    rule
        ``exact``, ``midpoint 0.5``, ``certified 0.01``, with ``, nearest`` where values are not
        blended.
    tau
        Optical depth.
    radiance
        (3,): the light of the volume alone.
    evaluations
        Cells or samples, or parts taken as a whole.
    error_bound
        What transmittance, and radiance as a share of the brightest, is certified to be off by at
        most; None of a rule that certifies nothing.
    samples
        (m,): distances from the origin of the samples of the midpoint rule; empty for others.
    """

    rule: str
    tau: float
    radiance: Floats
    evaluations: int
    error_bound: float | None
    samples: Floats


def seen_by(scene: Scene, plan: Plan, origin: Floats, direction: Floats) -> Seen:
    """What the rule of a plan makes of a ray, by the compiled kernels, in float64.

    Raises
    ------
    UsageError
        The step is so short that the ray would take more than `render.MAX_STEPS`.
    """
    samples = np.empty(0)
    if plan.step_voxels is not None:
        samples = sample_distances(scene, plan, origin, direction)
    tau, light, _, error, evaluations = make_integrator(scene, plan)(origin[None], direction[None])
    radiance = np.array(light[0], np.float64)
    if not isinstance(scene.color, Source):
        tint = 1.0 if scene.tint is None else np.array(scene.tint)
        radiance = radiance + -np.expm1(-tau[0] * tint) * np.array(scene.color)
    rule = plan.rule + (", nearest" if plan.nearest else "")
    bound = None if error is None else float(error[0]) + PIXEL_ERROR
    return Seen(rule, float(tau[0]), radiance, int(evaluations), bound, samples)


def with_step(plan: Plan, step_voxels: float | None) -> Plan:
    """The plan with another rule: midpoint with a step, or exact."""
    return replace(plan, step_voxels=step_voxels, max_error=None, target_error=None)


def sample_count(scene: Scene, plan: Plan, origin: Floats, direction: Floats) -> float:
    """Steps of the midpoint rule along a ray; the last may be a part of one."""
    near, far = span(scene, plan.nearest, origin, direction)
    if not near < far:
        return 0.0
    assert plan.step_voxels is not None, "asked for by the caller"
    speed = np.linalg.norm(scene.density.local_from_world[:, :3] @ direction)
    return (far - near) * float(speed) / plan.step_voxels


def sample_distances(scene: Scene, plan: Plan, origin: Floats, direction: Floats) -> Floats:
    """(m,): where the midpoint rule samples: in the middle of each step, the last one cut.

    Raises
    ------
    UsageError
        There would be more than `render.MAX_STEPS`.
    """
    count = sample_count(scene, plan, origin, direction)
    if count == 0:
        return np.empty(0)
    if count > MAX_STEPS:
        raise UsageError(f"--step {plan.step_voxels:g}: {count:.0e} samples of one ray; give more")
    near, far = span(scene, plan.nearest, origin, direction)
    step = (far - near) / count
    begin = np.arange(np.ceil(count)) * step
    return near + (begin + np.minimum(begin + step, far - near)) / 2
