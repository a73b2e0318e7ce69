"""Maps to numbers: coverage, percentiles, histograms, what is visible, and what is odd.

All of it is plain data, of the kinds that JSON has. Percentiles and histograms are of what is
visible, the pixels whose opacity is above 0: the empty part of a picture would drown them.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from volcli.opacity.maps import SAME, Floats, Maps

PERCENTILES = (1, 5, 25, 50, 75, 95, 99)
BINS = 64

_THREADS = 2  # sorting and counting release the interpreter lock
_ROWS = 64
"""Rows looked at at a time, so that what is made of them stays in the cache."""

_SAMPLE = 1_000_000
"""Pixels, evenly spread, on which it is judged whether colour looks premultiplied."""


def statistics(maps: Maps) -> dict[str, Any]:
    """The numbers of an image.

    Returns
    -------
    ``image``, ``size``, ``format``, ``rule`` and ``density_scale`` (as far as the header tells);
    ``coverage``: shares of all pixels; ``maps``: for each map where it is from and, of the visible
    pixels, ``min``, ``max``, ``mean``, ``percentiles``, ``histogram``, and how many values are
    ``distinct`` or ``not_finite``; ``visible_box``: the first and last column and row that hold
    any, and the ``edges`` of the picture that they touch; ``nonfinite``: channels that hold NaN or
    Inf; ``levels``: how finely opacity is stored; ``colour``: brightness and premultiplication;
    ``disagreement``: how far alpha and layers differ.
    """
    visible = maps.opacity > 0
    with ThreadPoolExecutor(_THREADS) as pool:
        colour = pool.submit(_colour, maps, visible)
        described = pool.map(lambda values: _describe(values, visible), maps.layers.values())
        odd = pool.map(lambda name: _nonfinite(name, maps), maps.stored.planes)
        box = pool.submit(_visible_box, visible, maps.opacity)
        disagreement = pool.submit(_disagreement, maps)
    by_name = dict(zip(maps.layers, described, strict=True))
    for name, found in by_name.items():
        found["from"] = maps.source[name]
    return {
        "image": str(maps.stored.path),
        "size": list(maps.stored.size),
        "format": f"{maps.stored.file_format}, {maps.stored.sample}",
        "rule": maps.rule,
        "density_scale": maps.density_scale,
        "coverage": _coverage(maps.opacity),
        "maps": by_name,
        "visible_box": box.result(),
        "nonfinite": [found for found in odd if found],
        "levels": _levels(maps, by_name["opacity"]["distinct"], visible),
        "colour": colour.result(),
        "disagreement": disagreement.result(),
    }


def _coverage(opacity: Floats) -> dict[str, float]:
    """Shares of the pixels; ``saturated``: opacity is 1 as far as the file can tell."""
    counts = dict.fromkeys(("above_0", "above_0.5", "above_0.99", "saturated"), 0)
    for rows in _bands(opacity):
        band = opacity[rows]
        counts["above_0"] += int(np.count_nonzero(band > 0))
        counts["above_0.5"] += int(np.count_nonzero(band > 0.5))
        counts["above_0.99"] += int(np.count_nonzero(band > 0.99))
        counts["saturated"] += int(np.count_nonzero(band >= 1))
    return {name: count / opacity.size for name, count in counts.items()}


def _bands(plane: Floats) -> list[slice]:
    """A few rows after the other."""
    return [slice(y, y + _ROWS) for y in range(0, len(plane), _ROWS)]


def _describe(values: Floats, visible: NDArray[np.bool_]) -> dict[str, Any]:
    """The numbers of one map where it is visible and finite; None where no pixel is."""
    ordered = values[visible]
    ordered.sort()  # NaN and +Inf last
    first = np.searchsorted(ordered, np.float32(-np.inf), side="right")
    finite = ordered[first : np.searchsorted(ordered, np.float32(np.inf))]
    found: dict[str, Any] = {
        "not_finite": len(ordered) - len(finite),
        "distinct": int(np.count_nonzero(finite[1:] != finite[:-1])) + 1 if len(finite) else 0,
    }
    if not len(finite):
        nothing = dict.fromkeys(("min", "max", "mean", "percentiles", "histogram"))
        return found | nothing
    low, high = float(finite[0]), float(finite[-1])
    edges = np.linspace(low, high, BINS + 1).astype(np.float32)
    below = np.searchsorted(finite, edges, side="left")
    below[-1] = len(finite)  # the last bin includes its end
    return found | {
        "min": low,
        "max": high,
        "mean": float(finite.mean(dtype=np.float64)),
        "percentiles": {str(q): _percentile(finite, q) for q in PERCENTILES},
        "histogram": {"edges": edges.tolist(), "counts": np.diff(below).tolist()},
    }


def _percentile(ordered: Floats, q: float) -> float:
    """As `numpy.percentile`, of values that are sorted already."""
    at = (len(ordered) - 1) * q / 100
    low = int(at)
    high = min(low + 1, len(ordered) - 1)
    a, b = float(ordered[low]), float(ordered[high])
    return a + (b - a) * (at - low)


def _visible_box(visible: NDArray[np.bool_], opacity: Floats) -> dict[str, Any] | None:
    """The box of what is visible; ``edges``: those where it is more than an 8-bit step opaque."""
    rows, columns = (np.flatnonzero(visible.any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return None
    borders = {
        "left": opacity[:, 0],
        "right": opacity[:, -1],
        "top": opacity[0],
        "bottom": opacity[-1],
    }
    return {
        "x": [int(columns[0]), int(columns[-1])],
        "y": [int(rows[0]), int(rows[-1])],
        "edges": [name for name, border in borders.items() if (border > 1 / 255).any()],
    }


def _nonfinite(name: str, maps: Maps) -> dict[str, Any] | None:
    """How many NaN and Inf a channel holds, and where the first is, as (x, y).

    A depth of +Inf where nothing is visible is what it should be, and not counted.
    """
    plane = maps.stored.planes[name]
    nan = inf = 0
    first = None
    for rows in _bands(plane):
        bad = ~np.isfinite(plane[rows])
        if plane is maps.depth:
            bad &= ~((maps.opacity[rows] == 0) & (plane[rows] == np.inf))
        if not bad.any():
            continue
        if first is None:
            y, x = np.unravel_index(int(np.argmax(bad)), bad.shape)
            first = [int(x), int(y) + rows.start]
        count = int(np.count_nonzero(np.isnan(plane[rows])))
        nan, inf = nan + count, inf + int(np.count_nonzero(bad)) - count
    return None if first is None else {"channel": name, "nan": nan, "inf": inf, "first": first}


def _levels(maps: Maps, distinct: int, visible: NDArray[np.bool_]) -> dict[str, Any]:
    """How many values opacity takes where it is visible, and on which grid of integers they lie.

    ``bits`` is 8 or 16 where opacity is stored as such integers, or was before it became floats.
    """
    bits = maps.stored.bits
    if bits is None and 2 < distinct <= 2**16:
        values = np.unique(maps.opacity[visible]).astype(np.float64)
        for guess in (8, 16):
            steps = values * (2**guess - 1)
            if bits is None and np.abs(steps - np.rint(steps)).max() < 1e-3:
                bits = guess
    return {"distinct": distinct, "bits": bits}


def _colour(maps: Maps, visible: NDArray[np.bool_]) -> dict[str, Any] | None:
    """Brightness, and whether colour is multiplied by opacity; None where there is no colour.

    ``straight`` is True where colour does not fade with opacity (it looks unassociated), None
    where that cannot be told: behind a background, or with nothing half transparent.
    """
    planes = [maps.stored.find(name) for name in "RGB"]
    if any(plane is None for plane in planes):
        return None
    alpha = maps.stored.find("A")
    covered = alpha is None or bool((alpha >= 1 - SAME).all())
    most = 0.0
    above = at = dark = 0
    for rows in _bands(maps.opacity):
        brightest = _brightest(planes, rows)
        seen = brightest[visible[rows] & np.isfinite(brightest)]
        most = max(most, float(seen.max(initial=0)))
        above += int(np.count_nonzero(seen > 1))
        at += int(np.count_nonzero(seen >= 1))
        dark += int(np.count_nonzero((brightest > 0) & ~visible[rows]))
    found: dict[str, Any] = {
        "associated": maps.stored.associated,
        "over_background": covered and not bool((maps.opacity >= 1 - SAME).all()),
        "max": most,
        "above_1": above,
        "at_1": at,
        "light_where_empty": dark,
        "straight": None,
    }
    if maps.stored.associated and not covered:
        step = max(1, round((maps.opacity.size / _SAMPLE) ** 0.5))
        some = slice(None, None, step)
        found["straight"] = _looks_straight(
            _brightest(planes, some)[:, some].ravel(), maps.opacity[some, some].ravel()
        )
    return found


def _brightest(planes: list[Floats | None], rows: slice) -> Floats:
    """The brightest of the channels in some rows."""
    red, green, blue = (plane[rows] for plane in planes if plane is not None)
    return np.maximum(np.maximum(red, green), blue)


def _looks_straight(brightest: Floats, opacity: Floats) -> bool | None:
    """Whether colour is not multiplied by opacity: where opacity is low, colour stays as bright.

    Premultiplied colour is at most c times the opacity, c being the brightest colour where there is
    much opacity. It is straight if most of the faint pixels are brighter than twice that.
    """
    faint = (opacity > 0) & (opacity < 0.25)
    dense = opacity > 0.5
    if np.count_nonzero(faint) < 16:
        return None
    c = float(np.percentile(brightest[dense] / opacity[dense], 99)) if dense.any() else 1.0
    return bool(np.count_nonzero(brightest[faint] > 2 * c * opacity[faint]) * 2 > faint.sum())


def _disagreement(maps: Maps) -> dict[str, float]:
    """The largest differences of opacity between what the file says twice: 0 or rounding.

    Means over samples or channels differ by more, as they should, and are not compared.
    """
    found = {}
    layered = [name for name in ("transmittance", "optical_depth") if maps.source[name][0] == "l"]
    if len(layered) == 2 and not maps.is_mean:
        largest = 0.0
        for rows in _bands(maps.opacity):
            opacity = -np.expm1(-maps.optical_depth[rows])
            largest = max(largest, _largest(opacity, maps.transmittance[rows]))
        found["transmittance"] = largest
    if "transmittance" in layered and maps.source["opacity"] == "alpha":
        found["alpha"] = _largest(maps.opacity, maps.transmittance)
    return found


def _largest(a: Floats, b: Floats) -> float:
    """The largest difference of opacities ``a`` and 1 - ``b`` where both are finite."""
    largest = 0.0
    for rows in _bands(a):
        with np.errstate(invalid="ignore"):
            difference = np.abs(a[rows] - (1 - b[rows]))
        largest = max(largest, float(difference.max(where=np.isfinite(difference), initial=0)))
    return largest
