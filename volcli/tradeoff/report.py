"""Measurements as plain data, as CSV, and as the rows of a table."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import volcli
from volcli.tradeoff.advice import Order, front, observed_order
from volcli.tradeoff.measure import Measured, Refused

COLUMNS = (
    "rule",
    "step_voxels",
    "max_error",
    "own",
    "on_front",
    "largest_error",
    "error_of_999_in_1000",
    "rms_error",
    "mean_error",
    "error_bound",
    "evaluations",
    "seconds_median",
    "seconds_min",
    "seconds_max",
    "setup_seconds",
    "compile_seconds",
    "refused",
)

HEAD = ("rule", "seconds", "from .. to", "error", "999 in 1000", "certified", "evaluations")
"""``error`` is that of the worst pixel, ``999 in 1000`` what so many stay within."""


@dataclass(frozen=True)
class Tradeoff:
    """What was measured on one picture.

    Attributes
    ----------
    source
        The volume.
    size, measured_size
        (width, height): of the user's picture, for which all times are; and of the one measured.
    samples
        Rays a pixel.
    rounds, threads
        How often, and with how many threads, each setting was timed.
    truth_error
        What the truth is off by at most.
    rows
        The settings, from exact to the finest error.
    warnings
        What the user should know of the scene.
    """

    source: str
    size: tuple[int, int]
    measured_size: tuple[int, int]
    samples: int
    rounds: int
    threads: int
    truth_error: float
    rows: tuple[Measured | Refused, ...]
    warnings: tuple[str, ...]

    @property
    def measured(self) -> list[Measured]:
        """The rows that could be measured."""
        return [row for row in self.rows if isinstance(row, Measured)]

    @property
    def front(self) -> list[Measured]:
        """The Pareto front, the fastest first."""
        return front(self.measured)

    @property
    def order(self) -> Order | None:
        """The observed order of convergence of midpoint."""
        return observed_order(self.measured)

    @property
    def own(self) -> Measured | None:
        """The user's own setting, if there is one."""
        return next((row for row in self.measured if row.setting.own), None)


def as_data(found: Tradeoff) -> dict[str, Any]:
    """All of it, of the kinds that JSON has."""
    best = {row.setting.name for row in found.front}
    return {
        "version": volcli.__version__,
        "source": found.source,
        "size": list(found.size),
        "measured_size": list(found.measured_size),
        "samples": found.samples,
        "rounds": found.rounds,
        "threads": found.threads,
        "truth_error": found.truth_error,
        "settings": [_row(row, best) for row in found.rows],
        "front": [row.setting.name for row in found.front],
        "own": None if found.own is None else found.own.setting.name,
        "order": None
        if found.order is None
        else {"order": found.order.order, "steps": list(found.order.steps)},
        "warnings": list(found.warnings),
    }


def _row(row: Measured | Refused, best: set[str]) -> dict[str, Any]:
    quadrature = row.setting.quadrature
    found: dict[str, Any] = dict.fromkeys(COLUMNS)
    found |= {
        "rule": row.setting.name,
        "step_voxels": quadrature.step_voxels,
        "max_error": quadrature.max_error,
        "own": row.setting.own,
        "on_front": row.setting.name in best,
    }
    if isinstance(row, Refused):
        return found | {"seconds": [], "refused": row.reason}
    return found | {
        "largest_error": row.errors.largest,
        "error_of_999_in_1000": row.errors.most,
        "rms_error": row.errors.rms,
        "mean_error": row.errors.mean,
        "error_bound": row.error_bound,
        "evaluations": row.evaluations,
        "seconds_median": row.median,
        "seconds_min": min(row.seconds),
        "seconds_max": max(row.seconds),
        "seconds": list(row.seconds),
        "setup_seconds": row.setup_seconds,
        "compile_seconds": row.compile_seconds,
    }


def as_csv(found: Tradeoff) -> bytes:
    """A line for each setting, under `COLUMNS`."""
    out = io.StringIO()
    writer = csv.DictWriter(out, COLUMNS, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(as_data(found)["settings"])
    return out.getvalue().encode()


def rows(found: Tradeoff) -> list[list[str]]:
    """The cells of a table under `HEAD`; a * is on the front."""
    best = {row.setting.name for row in found.front}
    return [
        [_named(row, best), *(_cells(row) if isinstance(row, Measured) else ["-"] * 6)]
        for row in found.rows
    ]


def reasons(found: Tradeoff) -> list[str]:
    """Why settings were left out, those of one reason together."""
    names: dict[str, list[str]] = {}
    for row in found.rows:
        if isinstance(row, Refused):
            names.setdefault(row.reason, []).append(row.setting.name)
    return [f"left out: {', '.join(named)}: {reason}" for reason, named in names.items()]


def _named(row: Measured | Refused, best: set[str]) -> str:
    marks = (" *" if row.setting.name in best else "") + (" (yours)" if row.setting.own else "")
    return row.setting.name + marks


def _cells(row: Measured) -> Sequence[str]:
    return (
        f"{row.median:.3g}",
        f"{min(row.seconds):.3g} .. {max(row.seconds):.3g}",
        f"{row.errors.largest:.1e}",
        f"{row.errors.most:.1e}",
        "-" if row.error_bound is None else f"{row.error_bound:.1e}",
        f"{row.evaluations:,}",
    )
