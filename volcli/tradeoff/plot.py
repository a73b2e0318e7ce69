"""Error against time as a figure of matplotlib's."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from volcli.files import write_figure
from volcli.tradeoff.measure import Measured
from volcli.tradeoff.report import Tradeoff

_FAMILIES = {
    "exact": ("#1b4f72", "s", "exact"),
    "midpoint": ("#ca6f1e", "o", "midpoint, by its step in voxels"),
    "certified": ("#1e8449", "D", "certified, by the error that it may make"),
}


def write_plot(
    path: Path,
    found: Tradeoff,
    *,
    target_error: float | None = None,
    time_budget: float | None = None,
    advised: Measured | None = None,
    overwrite: bool = True,
) -> None:
    """Draw the largest error of each setting against the time of the picture, and write it.

    Parameters
    ----------
    target_error, time_budget
        Drawn as limits.
    advised
        The setting that is marked as what to take.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.5, 6.2), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.set(xscale="log", yscale="log")
    _draw_front(axes, found)
    for family in _FAMILIES:
        _draw_family(axes, [m for m in found.measured if m.setting.family == family], family)
    if target_error is not None:
        axes.axhline(target_error, color="0.4", linestyle="--", linewidth=1)
        axes.annotate(
            f"target {target_error:.3g}",
            (1, target_error),
            xycoords=("axes fraction", "data"),
            xytext=(-4, 3),
            textcoords="offset points",
            ha="right",
            fontsize=8,
            color="0.35",
        )
    if time_budget is not None:
        axes.axvline(time_budget, color="0.4", linestyle=":", linewidth=1)
        axes.annotate(
            f"budget {time_budget:.3g} s",
            (time_budget, 1),
            xycoords=("data", "axes fraction"),
            xytext=(4, -10),
            textcoords="offset points",
            fontsize=8,
            color="0.35",
        )
    for one, label, size, color in (
        (found.own, "your own setting", 17, "#922b21"),
        (advised, "what to take", 23, "#6c3483"),
    ):
        if one is not None:
            axes.plot(
                one.median,
                one.errors.largest,
                marker="o",
                markersize=size,
                markerfacecolor="none",
                markeredgecolor=color,
                markeredgewidth=1.6,
                linestyle="none",
                label=label,
            )
    _label(axes, found)
    write_figure(path, figure, overwrite=overwrite)


def _draw_front(axes: Any, found: Tradeoff) -> None:
    """What no setting is better than: a step line, since nothing lies between two of them."""
    best = found.front
    axes.step(
        [m.median for m in best],
        [m.errors.largest for m in best],
        where="post",
        color="0.75",
        linewidth=5,
        solid_capstyle="round",
        label="Pareto front",
        zorder=1,
    )


def _draw_family(axes: Any, measured: list[Measured], family: str) -> None:
    """One rule: its settings with their spread, each with its step or error beside it."""
    if not measured:
        return
    color, marker, label = _FAMILIES[family]
    axes.errorbar(
        [m.median for m in measured],
        [m.errors.largest for m in measured],
        xerr=[
            [m.median - min(m.seconds) for m in measured],
            [max(m.seconds) - m.median for m in measured],
        ],
        color=color,
        marker=marker,
        markersize=6,
        linewidth=1,
        elinewidth=0.8,
        capsize=2,
        label=label,
        zorder=3,
    )
    for one in measured:
        text = "exact" if one.setting.value is None else f"{one.setting.value:g}"
        axes.annotate(
            text,
            (one.median, one.errors.largest),
            xytext=(7, 5),
            textcoords="offset points",
            fontsize=8,
            color=color,
        )


def _label(axes: Any, found: Tradeoff) -> None:
    from matplotlib.ticker import LogLocator, NullFormatter

    width, height = found.size
    rays = f"{found.samples} rays a pixel, " if found.samples > 1 else ""
    axes.set_title(
        f"{Path(found.source).name}, {width}x{height}, {rays}{found.threads} threads",
        loc="left",
        fontsize=10,
    )
    order = f"; midpoint's order is {found.order.order:.2f} here" if found.order else ""
    quick = ""
    if found.measured_size != found.size:
        quick = f", taken from one of {found.measured_size[0]}x{found.measured_size[1]}"
    axes.set_xlabel(f"seconds of the picture{quick}: median of {found.rounds}, from least to most")
    axes.set_ylabel(f"largest error of a pixel{order}")
    axes.grid(visible=True, which="both", color="0.92", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.xaxis.set_minor_formatter(NullFormatter())
    legend = axes.legend(fontsize=8, loc="best")
    for line in legend.get_lines():
        line.set_markersize(min(line.get_markersize(), 8))
