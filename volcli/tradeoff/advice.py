"""What follows from measurements: the Pareto front, the order of convergence, the cheapest setting.

Times are those of the whole picture, errors the largest of any pixel. What is shown and what a
budget pays for are medians; which setting is the cheapest is judged by the quickest round of each:
whatever else a machine does only ever adds to a time, so that another run finds the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from volcli.render import PIXEL_ERROR
from volcli.tradeoff.measure import Measured

LEVEL = 0.1
"""Times that differ by less than this share of the shorter one are taken for the same: in another
run either might be ahead."""

_FINE_STEP = 1.0
_ROUNDING = 1e-6
"""The order is observed at steps up to so many voxels, where the error is not yet rounding's."""


@dataclass(frozen=True)
class Order:
    """How fast the error of the midpoint rule falls with its step: as step ** order.

    Attributes
    ----------
    steps
        Voxels: between which it was observed, longest first.
    """

    order: float
    steps: tuple[float, ...]


def front(measured: Sequence[Measured]) -> list[Measured]:
    """Those than which no other is both as fast and as accurate, the fastest first."""
    found: list[Measured] = []
    for one in sorted(measured, key=lambda m: (m.median, m.errors.largest)):
        if not found or one.errors.largest < found[-1].errors.largest:
            found.append(one)
    return found


def observed_order(measured: Sequence[Measured]) -> Order | None:
    """The slope of log rms error over log step, by least squares; None of fewer than 3 steps."""
    fine = [
        (m.setting.value, m.errors.rms)
        for m in measured
        if m.setting.family == "midpoint"
        and m.setting.value is not None
        and m.setting.value <= _FINE_STEP
        and m.errors.rms > _ROUNDING
    ]
    if len(fine) < 3:
        return None
    steps, errors = zip(*sorted(fine, reverse=True), strict=True)
    slope = np.polyfit(np.log(steps), np.log(errors), 1)[0]
    return Order(float(slope), steps)


def cheapest(measured: Sequence[Measured], target_error: float) -> Measured | None:
    """The fastest setting whose every pixel is within a target; of those that are as fast as it, as
    far as can be told, the most accurate. None: no setting is accurate enough.
    """
    good = [m for m in measured if m.errors.largest <= target_error]
    if not good:
        return None
    limit = min(m.quickest for m in good) * (1 + LEVEL)
    return min((m for m in good if m.quickest <= limit), key=_by_error)


def advise(
    measured: Sequence[Measured], target_error: float | None, time_budget: float | None
) -> Measured | None:
    """The cheapest setting that meets a target; without one, the most accurate that takes no longer
    than so many seconds. None: there is none; with a target and a budget, none that meets both.
    """
    if time_budget is not None:
        measured = [m for m in measured if m.median <= time_budget]
    if target_error is not None:
        return cheapest(measured, target_error)
    return min(measured, key=_by_error, default=None)


def _by_error(one: Measured) -> tuple[float, float]:
    """Errors below rounding to float32 are the same; then the faster one is better."""
    return max(one.errors.largest, PIXEL_ERROR), one.quickest
