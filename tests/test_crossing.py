"""Where a cubic along a ray first crosses a level: against the roots of polynomials."""

import numba
import numpy as np
import pytest

from volcli.kernels import crossing

first_crossing = numba.njit(lambda *given: crossing.first_crossing(*given), error_model="numpy")


def cubics(count=2000):
    """(p, u, end, levels): cubics, parabolas, lines and constants; some begin on a level."""
    rng = np.random.default_rng(0)
    for n in range(count):
        p = rng.normal(size=4)
        for every, degree in ((5, 2), (7, 1), (11, 0)):
            if n % every == 0:
                p[degree + 1 :] = 0
        u = rng.uniform(-2, 1)
        levels = rng.normal(size=rng.integers(1, 6))
        if n % 3 == 0:
            levels[0] = p[0] + u * (p[1] + u * (p[2] + u * p[3]))
        yield tuple(p.tolist()), u, u + rng.uniform(0.1, 3), np.sort(levels)


def test_the_first_crossing_is_found_and_nothing_before_it():
    crossed = 0
    for p, u, end, levels in cubics():
        roots = np.concatenate([np.roots([p[3], p[2], p[1], p[0] - level]) for level in levels])
        real = roots.real[np.abs(roots.imag) < 1e-12]
        expected = min(real[(real > u + 1e-9) & (real < end)], default=end)
        to, piece = first_crossing(p, u, end, levels)
        if to < u + 1e-9:  # it begins on a level, but for rounding
            u = to + 1e-12
            to, piece = first_crossing(p, u, end, levels)
        assert to == pytest.approx(expected, abs=1e-9)
        middle = 0.5 * (u + to)
        between = p[0] + middle * (p[1] + middle * (p[2] + middle * p[3]))
        assert piece == np.searchsorted(levels, between, side="right") - 1
        crossed += to < end
    assert crossed > 500


def test_a_level_that_is_touched_is_not_crossed():
    p = (0.0, 0.0, 1.0, 0.0)  # u^2, lowest at 0
    assert first_crossing(p, -1.0, 2.0, np.array([0.0, 9.0])) == (2.0, 0)
    assert first_crossing(p, -1.0, 2.0, np.array([-1.0, 0.5]))[0] == pytest.approx(-(0.5**0.5))
