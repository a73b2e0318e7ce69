"""A walk along a ray, and what the rules make of it, as plain data and as CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from typing import Any

import numpy as np

from volcli.probe.field import BRICK, Floats
from volcli.probe.rules import Seen
from volcli.probe.walk import FALLS, Walk

COLUMNS = ("begin", "end", "sigma", "tau", "T", "weight", "red", "green", "blue")
"""Of the table of a ray: distances from the camera; mean extinction; optical depth and
transmittance at the end; the probability of a hit in the interval; the light that it adds."""


def report(
    walked: Walk | None,
    seen: Sequence[Seen],
    origin: Floats,
    direction: Floats,
    *,
    pixel: tuple[int, int] | None = None,
    depth_per_distance: float = 1.0,
) -> dict[str, Any]:
    """What is known of one ray, of the kinds that JSON has.

    Parameters
    ----------
    walked
        The walk, or None where the ray meets no grid.
    seen
        What the rules make of the ray.
    depth_per_distance
        Depth along the camera's axis for a unit of distance.

    Returns
    -------
    ``pixel``, ``origin``, ``direction``; ``range`` (near and far, or None); ``optical_depth``,
    ``transmittance``, ``opacity``, ``radiance``; ``distance`` and ``depth`` of a hit on average, or
    None; ``falls``: where T falls to each of `walk.FALLS`, or None; ``cells``: the columns of
    `table`; ``bricks``; ``rules``, each with the error of its transmittance, what it certified of
    it (or None), and its samples.
    """
    tau = walked.optical_depth if walked else 0.0
    distance = walked.distance if walked else None
    transmittance = float(np.exp(-tau))
    found: dict[str, Any] = {
        "pixel": None if pixel is None else list(pixel),
        "origin": origin.tolist(),
        "direction": direction.tolist(),
        "range": [float(walked.begin[0]), float(walked.end[-1])] if walked else None,
        "optical_depth": tau,
        "transmittance": transmittance,
        "opacity": float(-np.expm1(-tau)),
        "radiance": walked.light.sum(axis=0).tolist() if walked else [0.0] * 3,
        "distance": distance,
        "depth": None if distance is None else distance * depth_per_distance,
        "falls": {str(T): walked.fall(T) if walked else None for T in FALLS},
        "cells": {},
        "bricks": bricks(walked) if walked else [],
        "rules": [_rule(one, walked, transmittance) for one in seen],
    }
    if walked and walked.scene.tint is not None:
        channels = tau * np.array(walked.scene.tint)
        found["transmittance_by_channel"] = np.exp(-channels).tolist()
    columns = table(walked) if walked else np.empty((0, len(COLUMNS)))
    found["cells"] = {name: columns[:, i].tolist() for i, name in enumerate(COLUMNS)}
    return found


def table(walked: Walk) -> Floats:
    """(n, 9): a row of `COLUMNS` for each interval."""
    total = np.cumsum(walked.tau)
    length = walked.end - walked.begin
    sigma = np.divide(walked.tau, length, out=np.zeros_like(length), where=length > 0)
    numbers = [walked.begin, walked.end, sigma, total, np.exp(-total), walked.weight]
    return np.column_stack([*numbers, walked.light])


def folded(columns: dict[str, list[float]], most: int) -> list[list[float]]:
    """At most ``most`` rows of the table, neighbours joined where something is: for people."""
    rows = np.array([columns[name] for name in COLUMNS]).T
    if not len(rows):
        return []
    dense = np.flatnonzero((rows[:, 2] > 0) | (rows[:, 6:] != 0).any(axis=1))
    if not len(dense):
        return []
    rows = rows[dense[0] : dense[-1] + 1]
    starts = np.unique(np.arange(most) * len(rows) // most)
    ends = np.append(starts[1:], len(rows)) - 1
    length = rows[:, 1] - rows[:, 0]
    mass = np.add.reduceat(rows[:, 2] * length, starts)
    mass /= np.maximum(np.add.reduceat(length, starts), np.finfo(float).tiny)
    sums = np.add.reduceat(rows[:, 5:], starts, axis=0)
    joined = np.column_stack([rows[starts, 0], rows[ends, 1], mass, rows[ends, 3:5], sums])
    return joined.tolist()


def bricks(walked: Walk) -> list[dict[str, Any]]:
    """The bricks and constant regions of density that the ray meets, in order.

    Each with ``kind`` (brick or tile), the ``index`` of a brick's lowest lattice point, ``begin``
    and ``end``, ``optical_depth``, and the least and largest ``density`` that it holds. Background
    of 0 is left out.
    """
    field = walked.density
    grid = field.line.grid
    corner = np.where(field.entry[:, None] >= 0, field.voxel // BRICK * BRICK, 0)
    key = np.column_stack([field.entry, corner, field.inside])
    starts = np.flatnonzero(np.append(True, (key[1:] != key[:-1]).any(axis=1)))
    found = []
    for first, last in zip(starts, np.append(starts[1:], len(key)), strict=True):
        entry = int(field.entry[first])
        if not field.inside[first]:
            continue
        if entry >= 0:
            values = grid.arrays.atlas[entry]
            low, high = float(values.min()), float(values.max())
        else:
            low = high = float(grid.arrays.constants[-1 - entry])
            if high == 0:
                continue
        found.append(
            {
                "kind": "brick" if entry >= 0 else "tile",
                "index": (corner[first] + grid.origin).tolist() if entry >= 0 else None,
                "begin": float(walked.begin[first]),
                "end": float(walked.end[last - 1]),
                "optical_depth": float(walked.tau[first:last].sum()),
                "density": [low, high],
            }
        )
    return found


def _rule(seen: Seen, walked: Walk | None, transmittance: float) -> dict[str, Any]:
    sigma = walked.sigma(seen.samples) if walked and len(seen.samples) else np.empty(0)
    through = float(np.exp(-seen.tau))
    return {
        "rule": seen.rule,
        "evaluations": seen.evaluations,
        "optical_depth": seen.tau,
        "transmittance": through,
        "opacity": float(-np.expm1(-seen.tau)),
        "radiance": seen.radiance.tolist(),
        "error": abs(through - transmittance),
        "error_bound": seen.error_bound,
        "samples": {"t": seen.samples.tolist(), "sigma": sigma.tolist()},
    }


def as_csv(rays: Sequence[dict[str, Any]]) -> bytes:
    """The tables of rays, one below the other; the first column is the number of the ray."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["ray", *COLUMNS])
    for number, ray in enumerate(rays):
        for row in zip(*(ray["cells"][name] for name in COLUMNS), strict=True):
            writer.writerow([number, *(repr(value) for value in row)])
    return out.getvalue().encode()
