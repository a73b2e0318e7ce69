"""Functions of a grid's values as tables: colour by value, and density by value.

A job's ramp, blackbody or constant and the range of a grid's values in; knots and what they stand
for out, linear between, and constant beyond the ends. The kernels evaluate nothing else. What a job
may say is in `sources`; the grids are read elsewhere.
"""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from volcli.blackbody import HOTTEST, blackbody_rgb
from volcli.errors import UsageError, VolumeError
from volcli.schema import Job
from volcli.sources import DEFAULT_MAP, Blackbody, Color, DensityRamp, Emission, Ramp
from volcli.srgb import linear_from_srgb

Range = tuple[float, float]

KNOTS = 1024
"""Knots of a blackbody. From 0 to 3000 K it is off by 5e-6 of its brightest colour between them; of
luminance 1, from 100 to 3000 K, by 6e-4, where blue leaves sRGB.
"""

KINK = 2e-3
"""Where a table is a kink, and not a smooth curve in small pieces: see `ColorTable.kinks`."""

MAP_KNOTS = 256
"""Knots of a named map: as many as matplotlib's own have colours."""


@dataclass(frozen=True, eq=False)
class ColorTable:
    """Colour by the value of a scalar grid.

    Attributes
    ----------
    knots
        (k,) float64, ascending.
    colors
        (k, 3) float64: linear R, G, B at the knots; linear between, constant beyond the ends.
    """

    knots: NDArray[np.float64]
    colors: NDArray[np.float64]

    @property
    def kinks(self) -> NDArray[np.float64]:
        """(m,): the knots whose colour is off the line between their neighbours by more than
        `KINK` of the brightest, ends included."""
        before, after = self.knots[1:-1] - self.knots[:-2], self.knots[2:] - self.knots[1:-1]
        share = (before / (before + after))[:, None]
        line = self.colors[:-2] + share * (self.colors[2:] - self.colors[:-2])
        ends = np.abs(np.diff(self.colors, axis=0)[[0, -1]])  # beyond them it is constant
        off = np.vstack([ends[:1], np.abs(self.colors[1:-1] - line), ends[1:]]).max(axis=1)
        return self.knots[off > KINK * np.abs(self.colors).max()]

    @property
    def bends(self) -> NDArray[np.float64]:
        """(k + 1,): how much the slope has changed before the first knot (0) and behind each; see
        `kernels.source.Table`."""
        slopes = np.diff(self.colors, axis=0) / np.diff(self.knots)[:, None]
        changes = np.abs(np.diff(slopes, axis=0, prepend=np.zeros((1, 3)), append=np.zeros((1, 3))))
        return np.concatenate([[0.0], np.cumsum(changes.max(axis=1))])

    def at(self, values: ArrayLike) -> NDArray[np.float64]:
        """(...) values to (..., 3) colours."""
        at = np.asarray(values, np.float64)
        channels = [np.interp(at, self.knots, self.colors[:, c]) for c in range(3)]
        return np.stack(channels, axis=-1)


@dataclass(frozen=True, eq=False)
class TransferTable:
    """Density by the value of a scalar grid, before ``density.scale``.

    Attributes
    ----------
    knots
        (k,) float64, ascending.
    values
        (k,) float64, >= 0: densities at the knots; linear between, constant beyond the ends.
    """

    knots: NDArray[np.float64]
    values: NDArray[np.float64]

    def at(self, values: ArrayLike) -> NDArray[np.float64]:
        """(...) values to (...) densities."""
        return np.asarray(np.interp(np.asarray(values, np.float64), self.knots, self.values))


def source_table(
    part: Color | Emission, name: str, active: Range, field: Range, where: str
) -> ColorTable:
    """The table of a source that reads a scalar grid, its strength included.

    Parameters
    ----------
    name
        ``color`` or ``emission``: the source's name in the job, for messages.
    active, field
        The range of the grid's active values, and of all values that its field takes.
    where
        The grid, for messages.

    Raises
    ------
    UsageError, VolumeError
        See `ramp_table` and `blackbody_table`.
    """
    if part.ramp is not None:
        table = ramp_table(part.ramp, active, f"{name}.ramp", where)
    elif part.blackbody is not None:
        table = blackbody_table(part.blackbody, field, f"{name}.blackbody", where)
    else:
        table = proportional_table(part.constant or (1.0, 1.0, 1.0), field)
    return ColorTable(table.knots, table.colors * part.strength)


def check_maps(job: Job) -> None:
    """Raise the `UsageError` of a colour map that there is not, before anything is read."""
    for name, part in (("color", job.color), ("emission", job.emission)):
        if part.ramp is not None and part.ramp.stops is None:
            map_colors(part.ramp.map or DEFAULT_MAP, f"{name}.ramp.map")


def transfer_table(ramp: DensityRamp) -> TransferTable:
    """The table of ``density.ramp``."""
    stops = np.array(ramp.stops, np.float64)
    return TransferTable(stops[:, 0].copy(), stops[:, 1].copy())


def proportional_table(color: tuple[float, float, float], field: Range) -> ColorTable:
    """A colour times the value, (r, g, b) v, over the range of a grid's field; below 0 it is 0.

    The end of a range of one value is moved, so that there are two knots.
    """
    low, high = max(field[0], 0.0), max(field[1], 0.0)
    knots = np.array([low, high if high > low else low + 1.0])
    return ColorTable(knots, knots[:, None] * np.array(color, np.float64))


def ramp_table(ramp: Ramp, active: Range, key: str, where: str) -> ColorTable:
    """The table of a ramp.

    Parameters
    ----------
    active
        The range of the grid's active values, which a map without a range takes.
    key, where
        The ramp's name in the job, and the grid, for messages.

    Raises
    ------
    UsageError
        The map has no such name.
    VolumeError
        There is no range: the grid is one value all over.
    """
    if ramp.stops is not None:
        stops = np.array(ramp.stops, np.float64)
        return ColorTable(stops[:, 0].copy(), stops[:, 1:].copy())
    low, high = active if ramp.range is None else ramp.range
    if not low < high:
        raise VolumeError(
            f"{where}: is {low:g} wherever it is active, which is no range for a colour map; give "
            f"{key}.range"
        )
    colors = map_colors(ramp.map or DEFAULT_MAP, f"{key}.map")
    return ColorTable(np.linspace(low, high, MAP_KNOTS), colors)


def map_colors(name: str, where: str) -> NDArray[np.float64]:
    """(256, 3): one of matplotlib's colour maps in linear light, from its first colour to its last.

    Parameters
    ----------
    where
        Who asks for it, for the message: ``color.ramp.map``, ``--colormap``.

    Raises
    ------
    UsageError
        There is no such map; suggests one.
    """
    from matplotlib import colormaps

    if name not in colormaps:
        known: dict[str, Any] = {other.lower(): other for other in colormaps}
        close = difflib.get_close_matches(name.lower(), known, n=1)
        meant = (
            f"; did you mean '{known[close[0]]}'?"
            if close
            else ", such as viridis, inferno or coolwarm"
        )
        raise UsageError(f"{where}: no colour map '{name}' in matplotlib{meant}")
    shown = colormaps[name](np.linspace(0.0, 1.0, MAP_KNOTS))[:, :3]
    return linear_from_srgb(shown)


def blackbody_table(blackbody: Blackbody, field: Range, key: str, where: str) -> ColorTable:
    """The table of a blackbody over the range of a grid's field.

    Raises
    ------
    VolumeError
        A temperature is below 0 K, or above `HOTTEST`.
    """
    low, high = field
    values = np.linspace(low, high if high > low else low + 1.0, KNOTS)
    kelvin = blackbody.scale * values + blackbody.offset
    ends = blackbody.scale * np.array([low, high]) + blackbody.offset
    if not (ends.min() >= 0 and ends.max() <= HOTTEST):
        wrong = "below 0 K" if ends.min() < 0 else f"above {HOTTEST:g} K"
        raise VolumeError(
            f"{where}: is {low:g} to {high:g}, its background included; {key} makes that "
            f"{ends.min():g} to {ends.max():g} K, {wrong}; change {key}.scale or {key}.offset"
        )
    return ColorTable(values, blackbody_rgb(np.maximum(kelvin, 0.0), blackbody.normalized))
