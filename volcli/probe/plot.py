"""Rays as a figure of matplotlib: sigma with the samples of rules on it, T, weight, radiance."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from volcli.files import write_figure
from volcli.probe.walk import FALLS, Walk

MOST_RAYS = 6
"""Rays of one figure, beside each other."""

MOST_DOTS = 600
"""A rule that takes more samples is drawn without them: they would hide the curve."""

_PER_CELL = 6  # points of a curve: the field is a cubic in each
_CHANNELS = {"red": "#c0392b", "green": "#1e8449", "blue": "#2471a3"}
_RULES = ("#d35400", "#8e44ad", "#117a65", "#7f8c8d")


def write_plot(
    path: Path, walks: Sequence[Walk | None], rays: Sequence[dict[str, Any]], *, overwrite: bool
) -> None:
    """Draw rays, a column each, and write a .png, .svg or .pdf.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(max(8.5, 5 * len(rays)), 8), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(3, len(rays), sharex="col", squeeze=False)
    for column, (walked, ray) in enumerate(zip(walks, rays, strict=True)):
        axes = grid[:, column]
        axes[0].set_title(title_of(ray), loc="left", fontsize=10)
        axes[2].set_xlabel("distance from the camera, world units")
        if walked is None:
            axes[1].text(0.5, 0.5, "meets no grid", ha="center", transform=axes[1].transAxes)
            continue
        t = _curve(walked)
        _draw_sigma(axes[0], walked, ray, t)
        _draw_transmittance(axes[1], walked, ray, t)
        _draw_light(axes[2], walked, t)
        axes[0].set_xlim(t[0], t[-1])
    for row, label in enumerate(("extinction sigma", "transmittance T", "T sigma, and radiance")):
        grid[row, 0].set_ylabel(label)
    write_figure(path, figure, overwrite=overwrite)


def title_of(ray: dict[str, Any]) -> str:
    """A name of a ray, for people."""
    if ray["pixel"] is not None:
        return f"pixel {ray['pixel'][0]},{ray['pixel'][1]}"
    return "ray " + ",".join(f"{v:g}" for v in (*ray["origin"], *ray["direction"]))


def _curve(walked: Walk) -> Any:
    """Distances at which curves are drawn: several in each cell of the part that holds anything."""
    shown = np.flatnonzero((walked.tau > 0) | (walked.light != 0).any(axis=1))
    first, last = (shown[0], shown[-1]) if len(shown) else (0, len(walked.tau) - 1)
    begin, end = walked.begin[first : last + 1], walked.end[first : last + 1]
    # Not to the very ends of a cell: nearest-voxel values jump there.
    parts = np.linspace(1e-6, 1 - 1e-6, _PER_CELL)
    return (begin[:, None] + (end - begin)[:, None] * parts).reshape(-1)


def _tau_at(walked: Walk, t: Any) -> Any:
    """Optical depth up to t: exact at the ends of cells, a straight line within."""
    ends = np.append(walked.begin[:1], walked.end)
    return np.interp(t, ends, np.append(0, np.cumsum(walked.tau)))


def _draw_sigma(axes: Any, walked: Walk, ray: dict[str, Any], t: Any) -> None:
    axes.plot(t, walked.sigma(t), color="0.15", linewidth=1.2, label="sigma(t)")
    drawn = [rule for rule in ray["rules"] if 0 < len(rule["samples"]["t"]) <= MOST_DOTS]
    for rule, color in zip(drawn, _RULES, strict=False):
        at, sigma = rule["samples"]["t"], rule["samples"]["sigma"]
        axes.step(at, sigma, where="mid", color=color, linewidth=0.8, alpha=0.8)
        axes.plot(at, sigma, ".", color=color, markersize=4, label=f"{rule['rule']}, as sampled")
    axes.set_ylim(bottom=0)
    axes.legend(fontsize=8)


def _draw_transmittance(axes: Any, walked: Walk, ray: dict[str, Any], t: Any) -> None:
    axes.plot(t, np.exp(-_tau_at(walked, t)), color="0.15", linewidth=1.2)
    axes.set_ylim(0, 1.05)
    for T in FALLS:
        at = ray["falls"][str(T)]
        if at is not None:
            axes.plot([t[0], at, at], [T, T, 0], color="0.5", linewidth=0.8, linestyle=":")
            axes.annotate(f"T = {T:g} at {at:.4g}", (at, T), fontsize=8, xytext=(4, 3),
                          textcoords="offset points")  # fmt: skip


def _draw_light(axes: Any, walked: Walk, t: Any) -> None:
    through = np.exp(-_tau_at(walked, t))
    axes.plot(t, through * walked.sigma(t), color="0.15", linewidth=1.2, label="T sigma")
    axes.set_ylim(bottom=0)
    seen = axes.twinx()
    total = np.cumsum(walked.light, axis=0)
    for c, (name, color) in enumerate(_CHANNELS.items()):
        style = ("-", "--", ":")[c]  # told apart without colours as well
        seen.plot(walked.end, total[:, c], color=color, linestyle=style, linewidth=1.2, label=name)
    seen.set_ylabel("radiance so far")
    seen.legend(handles=[*axes.get_lines(), *seen.get_lines()], loc="center right", fontsize=8)
