"""A small picture in a terminal: half blocks, two pixels each, in 24-bit colour."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from volcli.images import srgb_from_linear
from volcli.opacity.background import radiance_of
from volcli.opacity.colormap import limits, shades
from volcli.opacity.maps import Maps

GAP = 2
"""Columns between the picture and the map beside it."""

MOST_LINES = 24

_CHECKS = np.array([0.35, 0.55])  # sRGB greys of the board behind the picture


def picture_and_map(
    maps: Maps, name: str, columns: int, *, colormap: str, logarithmic: bool
) -> str:
    """The picture, over a checkerboard, and a map of it, side by side under their names.

    Parameters
    ----------
    columns
        Width of the terminal; each of the two takes at most half of it and `MOST_LINES` lines.
    """
    width, height = maps.stored.size
    across = max(2, min((columns - GAP) // 2, round(2 * MOST_LINES * width / height), width))
    down = max(2, min(2 * MOST_LINES, round(across * height / width)))
    size = (down + down % 2, across)
    parts = [(name, map_pixels(maps, name, size, colormap=colormap, logarithmic=logarithmic))]
    picture = picture_pixels(maps, size)
    if picture is not None:
        parts.insert(0, ("picture", picture))
    head = (" " * GAP).join(f"{title:<{across}.{across}}" for title, _ in parts).rstrip()
    lines = zip(*(half_blocks(pixels) for _, pixels in parts), strict=True)
    return "\n".join([head, *((" " * GAP).join(line) for line in lines)])


def picture_pixels(maps: Maps, size: tuple[int, int]) -> NDArray[np.uint8] | None:
    """(h, w, 3): the volume over a checkerboard, as shown (sRGB); None without colour."""
    radiance = radiance_of(maps)
    if radiance is None:
        return None
    light = np.stack([averaged(radiance[..., c], size) for c in range(3)], axis=-1)
    through = np.stack(
        [averaged(t, size) for t in np.moveaxis(np.atleast_3d(maps.through), -1, 0)], axis=-1
    )
    rows, columns = np.indices(size)
    board = _CHECKS[(rows // 4 + columns // 4) % 2][..., None]
    linear = light + through * ((board + 0.055) / 1.055) ** 2.4
    return np.rint(255 * srgb_from_linear(np.clip(np.nan_to_num(linear), 0, 1))).astype(np.uint8)


def map_pixels(
    maps: Maps, name: str, size: tuple[int, int], *, colormap: str, logarithmic: bool
) -> NDArray[np.uint8]:
    """(h, w, 3): a map in colours; grey where it has no value."""
    low, high = limits(name, maps.layers[name], logarithmic)
    values = averaged(maps.layers[name], size).astype(np.float64)
    missing = ~np.isfinite(values)
    if logarithmic:
        missing |= values <= 0
        values[missing] = low
        values, low, high = np.log(values), np.log(low), np.log(high)
    unit = np.clip(np.where(missing, 0, (values - low) / max(high - low, 1e-30)), 0, 1)
    pixels = shades(colormap)[np.rint(unit * 255).astype(int)]
    pixels[missing] = 96
    return pixels


def averaged(values: NDArray[np.float32], size: tuple[int, int]) -> NDArray[np.float64]:
    """Means over a grid of ``size`` (rows, columns) of rectangles; Inf and NaN do not count.

    A rectangle that holds no other is NaN.
    """
    finite = np.isfinite(values)
    total = _sums(np.where(finite, values, np.float32(0)), size)
    count = _sums(finite, size)
    with np.errstate(invalid="ignore"):
        return total / count


def _sums(values: NDArray[Any], size: tuple[int, int]) -> NDArray[np.float64]:
    out: NDArray[Any] = values
    for axis, n in enumerate(size):
        length = out.shape[axis]
        starts = np.minimum(np.arange(n) * length // n, length - 1)
        out = np.add.reduceat(out, starts, axis=axis, dtype=np.float64)
    return out


def half_blocks(pixels: NDArray[np.uint8]) -> list[str]:
    """Lines of text that show (h, w, 3) pixels, h even: the upper half block, coloured above as
    text and below as its background. Each line ends with the colours of the terminal."""
    lines = []
    for above, below in zip(pixels[::2].tolist(), pixels[1::2].tolist(), strict=True):
        cells = []
        before = None
        for top, bottom in zip(above, below, strict=True):
            if (top, bottom) != before:
                before = (top, bottom)
                codes = ";".join(map(str, [38, 2, *top, 48, 2, *bottom]))
                cells.append(f"\x1b[{codes}m")
            cells.append("\u2580")
        lines.append("".join(cells) + "\x1b[0m")
    return lines
