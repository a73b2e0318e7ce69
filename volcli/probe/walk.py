"""The integrals along one ray, in NumPy and float64, from field values alone.

Letters: t is the distance from the camera in world units; sigma the extinction; tau optical depth
from the start; T = exp(-tau); c the radiance of a particle; e emission per world unit. What is seen
is the integral of T (sigma c + e) dt; under a tint each channel has its own sigma. Every interval
is integrated by Gauss-Legendre rules, after it is halved until it is thin: the error is rounding
wherever a field is a polynomial, and below 1e-6 where a table of colours bends.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from volcli.probe.field import Field, Floats, Line, cuts, field_along, make_line
from volcli.render import Scene, Source

OUTER = np.polynomial.legendre.leggauss(8)
INNER = np.polynomial.legendre.leggauss(4)
"""Nodes and weights on [-1, 1]; four are exact for the integral of a cubic."""

MAX_TAU = 0.25
"""Light is integrated over parts of at most this optical depth: eight nodes then leave 1e-16."""

DARK_TAU = 100.0
"""What lies behind more than this is not halved further: less than 1e-43 of its light is seen."""

FALLS = (0.95, 0.5, 0.05)
"""Transmittances whose places on the ray are told."""


@dataclass(frozen=True)
class Walk:
    """What a ray crosses, interval by interval.

    Attributes
    ----------
    origin, direction
        (3,) world units.
    near
        Distance from the origin to where the first grid begins; times of ``density`` count from it.
    begin, end
        (n,): distances from the origin of each interval.
    density
        The density's field on these intervals.
    scene
        What is walked through.
    tau
        (n,): optical depth of each interval.
    light
        (n, 3): radiance that each interval adds to what is seen.
    moment
        (n,): the integral of (t - near) T sigma over each interval, for the mean hit distance.
    """

    origin: Floats
    direction: Floats
    near: float
    begin: Floats
    end: Floats
    density: Field
    scene: Scene
    tau: Floats
    light: Floats
    moment: Floats

    @property
    def tau_before(self) -> Floats:
        """(n,): optical depth up to the start of each interval."""
        return np.concatenate([[0.0], np.cumsum(self.tau)[:-1]])

    @property
    def optical_depth(self) -> float:
        """Of the whole ray."""
        return float(self.tau.sum())

    @property
    def weight(self) -> Floats:
        """(n,): the probability that the ray is hit in each interval, T (1 - exp(-tau))."""
        return np.exp(-self.tau_before) * -np.expm1(-self.tau)

    @property
    def distance(self) -> float | None:
        """The mean distance of a hit; None where nothing can be hit."""
        hit = -np.expm1(-self.optical_depth)
        return float(self.near + self.moment.sum() / hit) if hit > 0 else None

    def sigma(self, t: Floats) -> Floats:
        """(m,) distances from the origin to extinctions; 0 beyond the ends."""
        row = np.clip(np.searchsorted(self.begin, t, side="right") - 1, 0, len(self.begin) - 1)
        known = (t >= self.begin[0]) & (t <= self.end[-1]) if len(self.begin) else np.zeros(0, bool)
        found = np.zeros(len(t))
        part = self.density.rows(row, self.begin[row] - self.near, self.end[row] - self.near)
        values = extinction(self.scene, part, (t - self.near)[:, None])[:, 0]
        found[known] = values[known]
        return found

    def fall(self, transmittance: float) -> float | None:
        """The distance from the origin at which T falls to a value; None where it does not."""
        wanted = -np.log(transmittance)
        total = np.cumsum(self.tau)
        if not len(total) or total[-1] < wanted:
            return None
        row = int(np.searchsorted(total, wanted))
        rest = wanted - (total[row - 1] if row else 0.0)
        a, b = self.begin[row] - self.near, self.end[row] - self.near
        part = self.density.rows(np.array([row]), np.array([a]), np.array([b]))
        low, high = a, b
        for _ in range(60):  # halve: optical depth grows along the interval
            middle = (low + high) / 2
            tau = integral(self.scene, part, np.array([a]), np.array([middle]))[0]
            low, high = (middle, high) if tau < rest else (low, middle)
        return self.near + (low + high) / 2


def walk(scene: Scene, nearest: bool, origin: Floats, direction: Floats) -> Walk | None:
    """Walk one ray; None where it meets no grid.

    Parameters
    ----------
    nearest
        Whether values are those of the nearest voxel.
    origin, direction
        (3,) world units; the direction of length 1.
    """
    lines = _lines(scene, nearest, origin, direction)
    spans = [line.span for line in lines if not line.grid.is_empty]
    near, far = span(scene, nearest, origin, direction)
    if not near < far:
        return None
    # From where the ray enters, so that a far camera costs no digits.
    sources = [scene.color] if isinstance(scene.color, Source) else []
    lines += [make_line(source.grid, nearest, origin, direction) for source in sources]
    lines = [line.moved(near) for line in lines]
    length = far - near
    t = np.unique(
        np.concatenate([cuts(line, 0.0, length) for line in lines] + [_ends(spans, near)])
    )
    density = field_along(lines[0], t)
    if scene.transfer is not None:
        t = np.unique(np.concatenate([t, _bends(density, scene.transfer.knots)]))
        density = field_along(lines[0], t)
    begin, end = t[:-1], t[1:]
    tau = integral(scene, density, begin, end)
    color = field_along(lines[-1], t) if sources else None
    emission = field_along(lines[1], t) if scene.emission is not None else None
    light, moment = _light(scene, density, color, emission, begin, end, tau)
    return Walk(
        origin, direction, near, near + begin, near + end, density, scene, tau, light, moment
    )


def span(scene: Scene, nearest: bool, origin: Floats, direction: Floats) -> tuple[float, float]:
    """(near, far): the distances between which a ray is in a box that absorbs or emits, or between
    two; near > far where it meets none."""
    lines = _lines(scene, nearest, origin, direction)
    spans = [line.span for line in lines if not line.grid.is_empty]
    met = [(a, b) for a, b in spans if a < b]
    return (min(a for a, _ in met), max(b for _, b in met)) if met else (1.0, 0.0)


def _lines(scene: Scene, nearest: bool, origin: Floats, direction: Floats) -> list[Line]:
    """The ray as it lies in the density, and in the emission where there is one."""
    grids = [scene.density, *([] if scene.emission is None else [scene.emission.grid])]
    return [make_line(grid, nearest, origin, direction) for grid in grids]


def extinction(scene: Scene, density: Field, t: Floats) -> Floats:
    """(n, m): sigma at distances t, a row for each interval; 0 outside the density's support."""
    values = density.at(t)
    if scene.transfer is not None:
        values = scene.transfer.at(values)
    return scene.scale * np.maximum(values, 0.0) * density.inside[:, None]


def integral(scene: Scene, density: Field, begin: Floats, end: Floats) -> Floats:
    """(n,): optical depth from ``begin`` to ``end``, each within an interval of the field."""
    t, weights = _nodes(begin, end, INNER)
    return (extinction(scene, density, t) * weights).sum(axis=-1)


def radiance_at(source: Source, field: Field, t: Floats) -> Floats:
    """(n, m, 3): what a source gives at distances t."""
    values = field.at(t)
    return source.scale * values if source.table is None else source.table.at(values)


def _light(
    scene: Scene,
    density: Field,
    color: Field | None,
    emission: Field | None,
    begin: Floats,
    end: Floats,
    tau: Floats,
) -> tuple[Floats, Floats]:
    """(n, 3) and (n,): the radiance that each interval adds, and its part of the mean distance."""
    tint = np.ones(3) if scene.tint is None else np.array(scene.tint)
    index, a, b = _thin_parts(scene, density, begin, end, tau, float(tint.max()))
    part = density.rows(index, a, b)
    part_tau = integral(scene, part, a, b)
    before = np.concatenate([[0.0], np.cumsum(part_tau)[:-1]])
    t, weights = _nodes(a, b, OUTER)
    sigma = extinction(scene, part, t)
    inner, inner_weights = _nodes(np.repeat(a, t.shape[1]), t.reshape(-1), INNER)
    many = np.repeat(index, t.shape[1])
    to_node = extinction(scene, density.rows(many, inner[:, 0], inner[:, -1]), inner)
    tau_to = before[:, None] + (to_node * inner_weights).sum(axis=-1).reshape(t.shape)
    moment = _summed((sigma * np.exp(-tau_to) * t * weights).sum(axis=-1), index, len(begin))

    through = np.exp(-tau_to[..., None] * tint)  # (n, m, 3)
    if isinstance(scene.color, Source):
        assert color is not None, "made along with the density"
        seen = radiance_at(scene.color, color.rows(index, a, b), t) * (tint * sigma[..., None])
    else:
        seen = np.zeros((*t.shape, 3))
    if scene.emission is not None:
        assert emission is not None, "made along with the density"
        glow = emission.rows(index, a, b)
        seen = seen + radiance_at(scene.emission, glow, t) * glow.inside[:, None, None]
    light = _summed((through * seen * weights[..., None]).sum(axis=1), index, len(begin))
    if not isinstance(scene.color, Source):  # c (1 - T) in closed form
        start = np.concatenate([[0.0], np.cumsum(tau)[:-1]])[:, None] * tint
        light += np.array(scene.color) * np.exp(-start) * -np.expm1(-tau[:, None] * tint)
    return light, moment


def _thin_parts(
    scene: Scene, density: Field, begin: Floats, end: Floats, tau: Floats, tint: float
) -> tuple[NDArray[np.int64], Floats, Floats]:
    """(index, begin, end) of parts of the intervals of which none is thicker than `MAX_TAU`."""
    index, a, b, thick = np.arange(len(begin)), begin, end, tau
    while True:
        before = np.concatenate([[0.0], np.cumsum(thick)[:-1]])
        middle = (a + b) / 2
        halve = (thick * tint > MAX_TAU) & (before * tint < DARK_TAU) & (middle > a) & (middle < b)
        if not halve.any():
            return index, a, b
        times = 1 + halve
        second = (np.cumsum(times) - 1)[halve]
        index, a, b = np.repeat(index, times), np.repeat(a, times), np.repeat(b, times)
        a[second] = b[second - 1] = middle[halve]
        thick = integral(scene, density.rows(index, a, b), a, b)


def _bends(density: Field, knots: Floats) -> Floats:
    """Where the field passes a knot of the transfer function inside an interval."""
    found = []
    low, high = density.corners.min(axis=1), density.corners.max(axis=1)
    for row in np.flatnonzero(density.end > density.begin):
        within = knots[(knots > low[row]) & (knots < high[row])]
        if not len(within):
            continue
        a, b = density.begin[row], density.end[row]
        at = np.linspace(0.0, 1.0, 4)
        one = density.rows(np.array([row]), np.array([a]), np.array([b]))
        cubic = np.polynomial.Polynomial.fit(
            at, one.at((a + at * (b - a))[None])[0], 3, domain=[0, 1], window=[0, 1]
        )
        for knot in within:
            roots = (cubic - knot).roots()
            real = roots.real[np.abs(roots.imag) < 1e-9]
            found.append(a + real[(real > 0) & (real < 1)] * (b - a))
    return np.concatenate(found) if found else np.empty(0)


def _ends(spans: list[tuple[float, float]], near: float) -> Floats:
    """Where supports begin and end, from ``near`` on."""
    return np.array([end - near for a, b in spans if a < b for end in (a, b)])


def _nodes(begin: Floats, end: Floats, rule: tuple[Floats, Floats]) -> tuple[Floats, Floats]:
    """(n, m) nodes and weights of a rule on [begin, end]."""
    half = (end - begin)[:, None] / 2
    return begin[:, None] + half * (rule[0] + 1), half * rule[1]


def _summed(parts: Floats, index: NDArray[np.int64], count: int) -> Floats:
    """The sums of the parts of each interval."""
    out = np.zeros((count, *parts.shape[1:]))
    np.add.at(out, index, parts)
    return out
