"""Plots of results, into docs/: ``python -m benchmarks.plots``; needs matplotlib (extra: bench)."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from benchmarks.common import RESULTS

DOCS = Path(__file__).parents[1] / "docs"
MARKS = "osD^v"
COLOURS = ("#0b6e4f", "#c1440e", "#3a5fa8", "#8a4fae", "#777777")


WHAT = {
    "volcli": ("volcli midpoint, step", "midpoint ", (-3, -13, "right")),
    "vdb_render": ("vdb_render, step", "step ", (0, 7, "center")),
    "VTK": ("VTK on CPUs, sample distance", "distance ", (0, 7, "center")),
    "Mitsuba": ("Mitsuba volpath, samples a pixel", "", (0, 7, "center")),
}
"""Of each renderer: its line, what its settings begin with, and where their labels go."""


def peers(results: dict[str, Any]) -> Any:
    """Error of opacity against time; every setting is a point, one line a renderer."""
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(11, 5), sharex=True, layout="constrained")
    for axis, key, title in zip(axes, ("max", "rms"), ("largest", "root mean square"), strict=True):
        axis.set_title(f"error of opacity, {title}")
        for n, (name, peer) in enumerate(results["peers"].items()):
            line, start, (right, up, align) = WHAT[name]
            lone, joined = {}, {}
            for label, row in peer.get("settings", {}).items():
                alone = label == "exact" or "," in label  # no step of a series
                (lone if alone else joined)[label] = row
            for rows, style in (
                (joined, {"marker": MARKS[n], "label": line}),
                (lone, {"marker": "*" if name == "volcli" else MARKS[n], "linestyle": "none"}),
            ):
                if not rows:
                    continue
                seconds = [row["seconds"] for row in rows.values()]
                times = [s["median"] * 1e3 for s in seconds]
                spread = [
                    [(s["median"] - s["min"]) * 1e3 for s in seconds],
                    [(s["max"] - s["median"]) * 1e3 for s in seconds],
                ]
                errors = [row["opacity_error"][key] for row in rows.values()]
                if "exact" in rows:
                    style |= {"markersize": 13, "label": "volcli exact"}
                axis.errorbar(
                    times, errors, xerr=spread, color=COLOURS[n], linewidth=1.2, capsize=2, **style
                )
                for time, error, label in zip(times, errors, rows, strict=True):
                    shown = label.removeprefix(start).split(" sample")[0]
                    axis.annotate(
                        shown,
                        (time, error),
                        xytext=(4, 7) if label == "exact" else (right, -14 if "," in label else up),
                        textcoords="offset points",
                        ha="left" if label == "exact" else align,
                        fontsize=8,
                        color=COLOURS[n],
                    )
        axis.set_xscale("log")
        axis.set_yscale("log")
        axis.set_xlabel("milliseconds a picture, median (bars: least to most)")
        axis.grid(alpha=0.25)
        axis.margins(x=0.12, y=0.08)
    axes[0].legend(loc="lower right", fontsize=9)
    figure.suptitle(
        f"{results['voxels']:,} voxels, {results['pixels']} x {results['pixels']} rays, "
        f"{results['machine']['threads']} threads; steps and distances in voxels",
        fontsize=10,
    )
    return figure


def scaling(results: dict[str, Any]) -> Any:
    """Time against cells, memory against voxels, with what was fitted."""
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(11, 4.6), layout="constrained")
    n = 0
    for name in ("voxels", "pixels"):
        for threads in sorted({row["threads"] for row in results[name]}):
            rows = [row for row in results[name] if row["threads"] == threads]
            cells = [row["cells"] for row in rows]
            seconds = [row["seconds"]["median"] for row in rows]
            label = f"{name} vary, {threads} thread{'s' if threads > 1 else ''}"
            axes[0].plot(cells, seconds, MARKS[n], color=COLOURS[n], label=label)
            n += 1
    every = [row["cells"] for name in ("voxels", "pixels") for row in results[name]]
    for threads, fit in results["fits"]["seconds_of_cells"].items():
        ends = [min(every), max(every)]
        line = [fit["at_zero"] + fit["slope"] * x for x in ends]
        shown = f"{1e-6 / fit['slope']:.0f} M cells/s on {threads}"
        axes[0].plot(ends, line, "k-" if threads == "1" else "k--", linewidth=0.8, label=shown)
    axes[0].set_xlabel("cells visited")
    axes[0].set_ylabel("seconds of rendering")
    rows = [row for row in results["voxels"] if row["threads"] == 1]
    voxels = [row["active_voxels"] for row in rows]
    for n, (key, label) in enumerate((("held", "bricks"), ("peak", "peak of the process"))):
        sizes = [row[f"{key}_bytes"] / 1e6 for row in rows]
        axes[1].plot(voxels, sizes, MARKS[n], color=COLOURS[n], label=label)
        fit = results["fits"][f"{key}_bytes_of_voxels"]
        ends = [min(voxels) * 10 ** (i / 20) for i in range(200)]
        ends = [x for x in ends if x <= max(voxels) * 1.01]
        line = [(fit["at_zero"] + fit["slope"] * x) / 1e6 for x in ends]
        shown = f"{fit['at_zero'] / 1e6:.0f} MB + {fit['slope']:.1f} bytes a voxel"
        axes[1].plot(ends, line, color=COLOURS[n], linewidth=0.8, label=shown)
    axes[1].set_xlabel("active voxels")
    axes[1].set_ylabel("MB")
    for axis in axes:
        axis.set_xscale("log")
        axis.set_yscale("log")
        axis.grid(alpha=0.25)
        axis.legend(fontsize=8)
    return figure


PLOTS = {"peers": peers, "scaling": scaling}


def draw(name: str) -> None:
    """Draw ``results/NAME.json`` to ``docs/NAME.png``, where matplotlib is installed."""
    try:
        import matplotlib
    except ImportError:
        print(f"no matplotlib (pip install '.[bench]'): docs/{name}.png is left as it is")
        return
    matplotlib.use("Agg")
    results = json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))
    DOCS.mkdir(exist_ok=True)
    PLOTS[name](results).savefig(DOCS / f"{name}.png", dpi=110)
    print(f"wrote docs/{name}.png")


if __name__ == "__main__":
    for plot in PLOTS:
        draw(plot)
