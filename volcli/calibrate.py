"""The longest step of the midpoint rule that keeps the error of a picture small: an estimate.

Some thousand rays of the very picture are rendered exactly, and by the midpoint rule with shorter
and shorter steps; the first step that is off by little enough on all but a few is taken. That says
what pixels in general do, and nothing of any one of them: for that there is ``max_error``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from volcli.bounds import brightest_light
from volcli.camera import Camera
from volcli.plan import Plan
from volcli.render import Scene
from volcli.scene import scene_box
from volcli.trace import Floats, RayResult, errors, trace

STEPS = (8.0, 5.6, 4.0, 2.8, 2.0, 1.4, 1.2, 1.0, 0.5, 0.333, 0.25, 0.2, 0.167, 0.125)
"""Voxels: the steps that are tried. From 1 down they are parts of a voxel, whose error is often
half of that of others and less: in samples/cloud.vdb that of 0.7 is above that of 1."""

RAYS = 8192
"""Of a pilot. Were 1 pixel in 1000 above the target, 8 of them would be on average, and only
1 pilot in 80 would see no more than 2 and take the step all the same."""

SPARED = 4000
"""One ray in so many may be above the target."""

MARGIN = 0.9
"""The share of the target that rays are held to: pixels are other rays."""

SAMPLE = 0.5
"""What a sample of the midpoint rule costs, in cells of the exact rule: measured, 0.3 to 0.5."""

_ROWS = 4
"""Rows whose rays go through the same columns: made together they cost less."""

_FEW = 512
"""Rays that are followed first: a step that is too long most often shows on these already, and they
tell how many samples it takes."""

THICK = 4.0
"""What a cell costs at most, in cells that are thin: it is cut in parts for the depth of a hit."""


@dataclass(frozen=True)
class Trial:
    """A step that was tried.

    Attributes
    ----------
    rays
        That were followed: all of the pilot's, or some that were off by too much already.
    largest, above
        The largest error of theirs, and how many were off by more than the target and its margin
        allow.
    """

    step_voxels: float
    rays: int
    largest: float
    above: int


@dataclass(frozen=True)
class Pilot:
    """What a pilot showed.

    Attributes
    ----------
    rays
        Rays of the picture that met the volume's box and were followed.
    trials
        The steps that were tried, longest first.
    step_voxels
        The last of them if it was good enough; None: the exact rule, no step being that and faster.
    """

    target_error: float
    rays: int
    trials: tuple[Trial, ...]
    step_voxels: float | None

    def settled(self, plan: Plan) -> Plan:
        """The plan with what was chosen."""
        return replace(plan, step_voxels=self.step_voxels, target_error=None)

    def as_data(self) -> dict[str, Any]:
        """What JSON can hold of it: the step or null, the rays, and each step that was tried."""
        return {
            "target_error": self.target_error,
            "step": self.step_voxels,
            "rays": self.rays,
            "said": self.said,
            "tried": [
                {
                    "step": one.step_voxels,
                    "rays": one.rays,
                    "largest_error": one.largest,
                    "rays_above": one.above,
                }
                for one in self.trials
            ],
        }

    @property
    def said(self) -> str:
        """For people, in a line."""
        if not self.rays:
            return "no ray of this picture meets the volume"
        if not self.trials:
            return f"{self.rays:,} rays of this picture have fewer cells than any step has samples"
        *longer, last = self.trials
        seen = f"{last.rays:,} rays of this picture were off by up to {last.largest:.2g}"
        shown = f"{seen} at step {last.step_voxels:g}"
        if self.step_voxels is None:
            return f"{shown}, which is too much, and shorter steps are no faster than exact"
        if last.above:
            shown += f" ({last.above} of them by more than is wanted)"
        if longer:
            shown += f", by {longer[-1].largest:.2g} or more at {longer[-1].step_voxels:g}"
        return shown


def calibrate(
    scene: Scene,
    plan: Plan,
    camera: Camera,
    threads: int | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Pilot:
    """Choose the longest step for a picture whose error is to stay below a target.

    The error is that of transmittance, and of radiance as a share of the brightest light. The same
    picture always has the same rays and so the same step, whoever renders whatever part of it.

    Parameters
    ----------
    plan
        With `Plan.target_error`.
    camera
        Of the whole picture. Of a pixel with several samples its centre is followed; the mean of
        several rays is off by no more than they are.
    progress
        Called with the steps that were tried, and those that there are.
    """
    target_error = plan.target_error
    assert target_error is not None, "else there is nothing to choose"
    origins, directions = pilot_rays(scene, camera)
    count = len(origins)
    if not count:
        return Pilot(target_error, 0, (), None)
    exact = replace(plan, step_voxels=None, target_error=None)
    brightest = brightest_light(scene, plan.nearest, threads)

    def followed(rays: NDArray[np.int64], step: float | None) -> RayResult:
        rule = replace(exact, step_voxels=step)
        return trace(scene, rule, origins[rays], directions[rays], threads)

    def trial(step: float, seen: RayResult, truth: RayResult) -> Trial:
        off = errors(seen, truth, brightest)
        above = len(off) - int(np.count_nonzero(off <= MARGIN * target_error))  # NaN is above
        return Trial(step, len(off), float(off.max()), above)

    every, spared = np.arange(count), count // SPARED
    few = np.sort(np.random.default_rng(0).choice(every, min(count, _FEW), replace=False))
    truth_of_few, truth = followed(few, None), None
    affordable = _cost(truth_of_few, plan) / SAMPLE
    trials: list[Trial] = []
    for done, step in enumerate(STEPS):
        progress(done, len(STEPS))
        seen = followed(few, step)
        if seen.evaluations > affordable:
            break
        trials.append(trial(step, seen, truth_of_few))
        if trials[-1].above <= spared:
            truth = truth or followed(every, None)
            trials[-1] = trial(step, followed(every, step), truth)
            if trials[-1].above <= spared:
                progress(len(STEPS), len(STEPS))
                return Pilot(target_error, count, tuple(trials), step)
    progress(len(STEPS), len(STEPS))
    return Pilot(target_error, count, tuple(trials), None)


def _cost(truth: RayResult, plan: Plan) -> float:
    """What the exact rule costs, in thin cells: by what it does, for no clock says the same twice.

    Without light that varies, whose rays end where nothing is seen any more, the weights of a thick
    cell are made in parts of an optical depth of `kernels.cell.MAX_TAU` each.
    """
    tau = truth.optical_depth[truth.optical_depth > 0]
    if not (plan.depth and len(tau)) or plan.color or plan.emission:
        return float(truth.evaluations)
    from volcli.kernels.cell import MAX_TAU

    cells = truth.evaluations / len(tau)
    return float(np.clip(tau / MAX_TAU, cells, THICK * cells).sum())


def pilot_rays(scene: Scene, camera: Camera) -> tuple[Floats, Floats]:
    """(n, 3) each: origins and directions of rays spread over the pixels that meet a scene's box.

    About `RAYS`, or one through each such pixel if there are fewer: a pixel chosen at random, but
    always the same, from each of as many stretches of rows.
    """
    box = scene_box(scene)
    if box is None:
        return np.empty((0, 3)), np.empty((0, 3))
    width, height = camera.resolution
    rough = max(1, math.isqrt(width * height // RAYS))
    origins, directions = camera.rays(slice(None, None, rough), slice(None, None, rough))
    share = max(float(meets(box, origins, directions).mean()), RAYS / (width * height) / 4)
    rows, columns = _spread(width, height, RAYS / share)
    random = np.random.default_rng(0)
    every = _one_of_each(random, height, rows)
    found = [
        camera.rays(every[first : first + _ROWS], _one_of_each(random, width, columns))
        for first in range(0, rows, _ROWS)
    ]
    origins, directions = (np.concatenate(part) for part in zip(*found, strict=True))
    hit = meets(box, origins, directions)
    return origins[hit], directions[hit]


def meets(box: Floats, origins: Floats, directions: Floats) -> NDArray[np.bool_]:
    """(n,): whether rays meet a box (2, 3)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        low, high = (box[:, None] - origins) / directions
    # NaN, of a ray within a face of the box, is passed over: it neither enters nor leaves there.
    near = np.fmax.reduce(np.fmin(low, high), axis=1)
    far = np.fmin.reduce(np.fmax(low, high), axis=1)
    return np.asarray((near <= far) & (far >= 0))


def _spread(width: int, height: int, wanted: float) -> tuple[int, int]:
    """How many rows, and pixels of each row, make as many pixels, in squares."""
    edge = math.sqrt(max(1.0, width * height / wanted))
    return max(1, round(height / edge)), max(1, round(width / edge))


def _one_of_each(random: np.random.Generator, size: int, count: int) -> NDArray[np.int64]:
    """(count,): a number from each of as many equal parts of 0 to size."""
    edges = np.linspace(0, size, count + 1)
    return np.minimum(random.uniform(edges[:-1], edges[1:]).astype(np.int64), size - 1)
