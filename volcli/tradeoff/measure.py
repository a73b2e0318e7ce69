"""Settings, rendered and timed in rounds, against the truth.

Each picture is rendered as a user's would be. A first one that is not timed compiles, fills the
caches of the processor and shows the errors; the timed ones then take turns, so that whatever else
the machine does in the meantime is shared by all settings.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from volcli.bounds import scene_bounds
from volcli.camera import Camera
from volcli.errors import UsageError
from volcli.plan import Plan
from volcli.render import Scene, render
from volcli.tradeoff.settings import Setting
from volcli.tradeoff.truth import Truth


@dataclass(frozen=True)
class Errors:
    """How far off the pixels of a picture are.

    Attributes
    ----------
    largest
        Of any pixel.
    most
        What 999 of 1000 pixels stay within.
    rms, mean
        Over all pixels.
    """

    largest: float
    most: float
    rms: float
    mean: float


@dataclass(frozen=True)
class Measured:
    """What a setting makes of a picture, and how long it takes.

    Attributes
    ----------
    error_bound
        The largest certificate of all pixels; None of a rule that certifies nothing.
    evaluations
        Cells, samples, or parts taken as a whole.
    seconds
        Of the picture in each round, what is made for it beforehand included.
    setup_seconds
        What of that is made once for a picture: bounds of bricks.
    compile_seconds
        What it took, before the rounds, to have the kernels ready.
    """

    setting: Setting
    errors: Errors
    error_bound: float | None
    evaluations: int
    seconds: tuple[float, ...]
    setup_seconds: float
    compile_seconds: float

    @property
    def median(self) -> float:
        """Of the rounds."""
        return statistics.median(self.seconds)

    @property
    def quickest(self) -> float:
        """The shortest of the rounds."""
        return min(self.seconds)

    def scaled(self, factor: float) -> Measured:
        """With the times of a picture of so many times the rays."""
        seconds = tuple(
            self.setup_seconds + (one - self.setup_seconds) * factor for one in self.seconds
        )
        return replace(self, seconds=seconds)


@dataclass(frozen=True)
class Refused:
    """A setting that cannot be measured, and why."""

    setting: Setting
    reason: str


def with_bounds(scene: Scene, plan: Plan, threads: int | None = None) -> tuple[Scene, float]:
    """The scene with its bounds, which the certified rule needs, and how long those take."""
    bounds = scene_bounds(scene, plan.nearest, threads)  # compiles
    times = []
    for _ in range(3):
        begin = time.perf_counter()
        scene_bounds(scene, plan.nearest, threads)
        times.append(time.perf_counter() - begin)
    return replace(scene, bounds=bounds), statistics.median(times)


def measure(
    scene: Scene,
    plan: Plan,
    camera: Camera,
    truth: Truth,
    chosen: Sequence[Setting],
    rounds: int,
    setup_seconds: float = 0.0,
    threads: int | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Measured | Refused]:
    """Measure settings.

    Parameters
    ----------
    scene
        With its bounds.
    plan
        Of any rule.
    setup_seconds
        What those took: part of the time of the certified rule.
    progress
        Called with pictures done and pictures in all.

    Returns
    -------
    One for each setting, in their order.
    """
    total, done = len(chosen) * (rounds + 1), 0
    found: dict[str, Measured | Refused] = {}
    for setting in chosen:
        found[setting.name] = _first(setting, scene, plan, camera, truth, threads)
        done += 1
        progress(done, total)
    for number in range(rounds):
        for setting in chosen if number % 2 else chosen[::-1]:
            done += 1
            before = found[setting.name]
            if isinstance(before, Measured):
                extra = setup_seconds if setting.family == "certified" else 0.0
                result = render(scene, setting.plan(plan), camera, threads=threads)
                seconds = (*before.seconds, extra + result.render_seconds)
                found[setting.name] = replace(before, seconds=seconds, setup_seconds=extra)
            progress(done, total)
    return [found[setting.name] for setting in chosen]


def _first(
    setting: Setting, scene: Scene, plan: Plan, camera: Camera, truth: Truth, threads: int | None
) -> Measured | Refused:
    """The picture that is not timed."""
    try:
        result = render(scene, setting.plan(plan), camera, threads=threads)
    except UsageError as error:
        return Refused(setting, str(error))
    off = truth.errors(result)
    return Measured(
        setting,
        Errors(
            largest=float(off.max()),
            most=float(np.quantile(off, 0.999)),
            rms=float(np.sqrt(np.square(off).mean())),
            mean=float(off.mean()),
        ),
        None if result.error_bound is None else float(result.error_bound.max()),
        result.evaluations,
        (),
        0.0,
        result.compile_seconds,
    )
