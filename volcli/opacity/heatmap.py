"""A map as a picture in colours, with a colour bar and contour lines: a figure of matplotlib's."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from volcli.files import write_figure
from volcli.opacity.colormap import limits, shades
from volcli.opacity.maps import Maps

THIN_MEDIUM = 0.05
"""A scale is logarithmic where the median opacity of what is visible is less."""

LARGEST = 1600
"""Pixels of a map along the longer side of a figure: of a larger map, means are shown."""

LABELS = {
    "opacity": "opacity, 1 - T",
    "transmittance": "transmittance, T",
    "optical_depth": "optical depth",
    "depth": "depth along the camera's axis, world units",
    "error_bound": "certified error of transmittance and radiance",
    "error_estimate": "estimated error of radiance",
}

_NOTHING = "0.8"  # the grey of pixels that have no value


def suits_logarithm(maps: Maps, name: str) -> bool:
    """Whether a map is better seen on a logarithmic scale: of a thin medium, or of a wide range."""
    if name not in ("opacity", "optical_depth"):
        return False
    visible = maps.opacity[maps.opacity > 0]
    return bool(visible.size) and float(np.median(visible)) < THIN_MEDIUM


def write_heatmap(
    path: Path,
    maps: Maps,
    name: str,
    *,
    colormap: str,
    logarithmic: bool,
    contours: tuple[float, ...] = (),
    overwrite: bool = True,
) -> None:
    """Draw a map with matplotlib and write it as PNG, SVG or PDF, by the path's extension.

    Parameters
    ----------
    name
        A map that the image has; grey is where it has no value: a depth where nothing is hit, 0 on
        a logarithmic scale.
    contours
        Opacities at which lines are drawn, whatever the map.

    Raises
    ------
    UsageError
        matplotlib has no such colour map.
    OutputError
        The file cannot be written.
    """
    from matplotlib.colors import LogNorm, Normalize

    values = maps.layers[name]
    low, high = limits(name, values, logarithmic)
    shown = reduced(values)
    missing = ~np.isfinite(shown) | ((shown <= 0) if logarithmic else False)
    figure, axes = drawn(
        np.ma.masked_array(shown, missing),
        maps.stored.size,
        colormap=colormap,
        norm=LogNorm(low, high) if logarithmic else Normalize(low, high),
        label=LABELS[name],
        title=maps.stored.path.name,
        missing="0" if logarithmic else "nothing",
    )
    if contours and min(shown.shape) > 1:  # of one row or column there are no lines
        _draw_contours(axes, maps.opacity, contours)
    write_figure(path, figure, overwrite=overwrite)


def drawn(
    values: Any,
    size: tuple[int, int],
    *,
    colormap: str,
    norm: Any,
    label: str,
    title: str,
    missing: str,
    extend: str = "neither",
) -> tuple[Any, Any]:
    """A figure of values in colours with a colour bar, and its axes, in pixels of the image.

    Parameters
    ----------
    values
        A masked array, of the image's shape or `reduced`; grey where it is masked.
    size
        (width, height) of the image.
    missing
        What grey stands for.

    Raises
    ------
    UsageError
        matplotlib has no such colour map.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.colors import ListedColormap
    from matplotlib.figure import Figure

    width, height = size
    tall = min(max(8 * height / width, 2.5), 14)
    figure = Figure(figsize=(9.5, tall + 0.9), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    image = axes.imshow(
        values,
        cmap=ListedColormap(shades(colormap) / 255.0).with_extremes(bad=_NOTHING),
        norm=norm,
        extent=(0, width, height, 0),
        interpolation="nearest",
    )
    figure.colorbar(image, ax=axes, shrink=0.9, pad=0.02, extend=extend).set_label(label)
    axes.set_title(title, loc="left", fontsize=10)
    axes.set_xlabel("x, pixels")
    axes.set_ylabel("y, pixels")
    if np.ma.getmaskarray(values).any():
        axes.annotate(
            f"grey: {missing}",
            (1, 1.01),
            xycoords="axes fraction",
            ha="right",
            fontsize=8,
            color="0.35",
        )
    return figure, axes


def _draw_contours(axes: Any, opacity: NDArray[np.float32], levels: tuple[float, ...]) -> None:
    """Lines of equal opacity, white with a dark rim, so that they show on any colour."""
    from matplotlib.patheffects import withStroke

    values = reduced(opacity)
    height, width = opacity.shape
    rows, columns = values.shape
    x = (np.arange(columns) + 0.5) * (width / columns)
    y = (np.arange(rows) + 0.5) * (height / rows)
    lines = axes.contour(x, y, values, levels=sorted(set(levels)), colors="white", linewidths=1.0)
    rim = [withStroke(linewidth=2.2, foreground="black")]
    lines.set_path_effects(rim)
    for label in axes.clabel(lines, fmt="%g", fontsize=8):
        label.set_path_effects(rim)


def reduced(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """A map no larger than `LARGEST`, of means over squares; a square with Inf or NaN has none."""
    factor = -(-max(values.shape) // LARGEST)
    if factor == 1:
        return values
    height, width = (-(-n // factor) * factor for n in values.shape)
    padding = ((0, height - values.shape[0]), (0, width - values.shape[1]))
    squares = np.pad(values, padding, mode="edge").reshape(
        height // factor, factor, width // factor, factor
    )
    return squares.mean(axis=(1, 3))
