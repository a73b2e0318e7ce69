"""The mathematics of one cell against mpmath's, and the laws that it obeys."""

import mpmath
import numba
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from volcli.kernels import cell
from volcli.kernels.cell import MAX_TAU


def entry(function):
    """A compiled function that only kernels call, to be called from here."""
    return numba.njit(lambda *arguments: function(*arguments), error_model="numpy")


absorbed = entry(cell.absorbed)
antiderivative = entry(cell.antiderivative)
cubic = entry(cell.cubic)
hit_weights = entry(cell.hit_weights)
integral = entry(cell.integral)
load = entry(cell.load)
trilinear = entry(cell.trilinear)
value = entry(cell.value)

EPS = 2.0**-52

mpmath.mp.dps = 40

unit = st.floats(0.0, 1.0)
density = st.floats(0.0, 1e6)
corners = st.tuples(*[density] * 8)
component = st.floats(-4.0, 4.0).map(lambda x: 0.0 if abs(x) < 1e-6 else x)
direction = st.tuples(component, component, component)
position = st.tuples(unit, unit, unit)


def exact_trilinear(v, x, y, z):
    """The definition: eight corners by the volumes opposite to them."""
    x, y, z = (mpmath.mpf(c) for c in (x, y, z))
    total = mpmath.mpf(0)
    for n, corner in enumerate(v):
        i, j, k = n >> 2 & 1, n >> 1 & 1, n & 1
        weight = (x if i else 1 - x) * (y if j else 1 - y) * (z if k else 1 - z)
        total += weight * mpmath.mpf(corner)
    return total


def along(v, p, d):
    """The field on the line p + u d, a function of u."""
    x, y, z = (mpmath.mpf(c) for c in p)
    dx, dy, dz = (mpmath.mpf(c) for c in d)
    return lambda u: exact_trilinear(v, x + u * dx, y + u * dy, z + u * dz)


def polynomial(p, u):
    return sum(mpmath.mpf(c) * mpmath.mpf(u) ** n for n, c in enumerate(p))


def size(v, d, u=1.0):
    """A bound on the terms of the cubic: what rounding is relative to."""
    return max(v) * (1 + abs(u) * max(abs(c) for c in d)) ** 3 * 8 + 1e-300


def test_load_reads_the_corners_with_z_fastest():
    atlas = np.arange(2 * 729, dtype=np.float32).reshape(2, 729)
    cube = atlas.reshape(2, 9, 9, 9)
    for brick, i, j, k in ((0, 0, 0, 0), (1, 7, 7, 7), (1, 2, 5, 3)):
        expected = cube[brick, i : i + 2, j : j + 2, k : k + 2].reshape(-1)
        assert load(atlas, brick, i, j, k) == tuple(float(v) for v in expected)


@given(corners, position)
def test_trilinear_is_its_definition(v, p):
    assert abs(trilinear(v, *p) - exact_trilinear(v, *p)) <= 16 * EPS * max(v)


@given(corners)
def test_trilinear_gives_back_the_corners(v):
    for n, corner in enumerate(v):
        at = (float(n >> 2 & 1), float(n >> 1 & 1), float(n & 1))
        assert trilinear(v, *at) == pytest.approx(corner, rel=1e-12, abs=8 * EPS * max(v))


def test_trilinear_knows_mitsubas_example():
    """3^3 ones with [0,0,0] = 0 and [1,1,1] = .5, cell-centred: .8125 at (1/3)^3, which is in the
    middle of the first cell."""
    assert trilinear((0.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.5), 0.5, 0.5, 0.5) == 0.8125


@given(corners, position, direction, st.floats(-1.0, 1.0))
def test_the_cubic_is_the_field_along_the_line(v, p, d, u):
    got = polynomial(cubic(v, *p, *d), u)
    assert abs(got - along(v, p, d)(mpmath.mpf(u))) <= 64 * EPS * size(v, d, u)


@given(corners, position, direction)
def test_coefficients_are_the_derivatives_of_the_field(v, p, d):
    """A cubic is known from four points: its coefficients by exact differences."""
    f = along(v, p, d)
    f0, f1, f2, g1 = f(0), f(1), f(2), f(-1)
    p3 = (f2 - 3 * f1 + 3 * f0 - g1) / 6
    p2 = (f1 + g1) / 2 - f0
    p1 = f1 - f0 - p2 - p3
    for got, expected in zip(cubic(v, *p, *d), (f0, p1, p2, p3), strict=True):
        assert abs(got - expected) <= 64 * EPS * size(v, d)


@given(corners, position, direction, st.floats(0.0, 1.0))
def test_the_integral_is_exact_from_two_coefficients(v, p, d, length):
    """Against Gauss-Legendre with 4 nodes in 40 digits, exact for a cubic."""
    f, half = along(v, p, d), mpmath.mpf(length) / 2
    nodes = [(n, w) for n, w in gauss4()]
    expected = half * sum(w * f(half * n) for n, w in nodes)
    got = integral(cubic(v, *p, *d), length)
    assert abs(got - max(mpmath.mpf(0), expected)) <= 64 * EPS * length * size(v, d, length / 2)


def gauss4():
    outer = mpmath.sqrt(mpmath.mpf(3) / 7 + mpmath.mpf(2) / 7 * mpmath.sqrt(mpmath.mpf(6) / 5))
    inner = mpmath.sqrt(mpmath.mpf(3) / 7 - mpmath.mpf(2) / 7 * mpmath.sqrt(mpmath.mpf(6) / 5))
    for node, weight in (
        (outer, (18 - mpmath.sqrt(30)) / 36),
        (inner, (18 + mpmath.sqrt(30)) / 36),
    ):
        yield node, weight
        yield -node, weight


@given(corners, position, direction, st.floats(0.0, 1.0))
def test_the_integral_is_the_same_from_the_other_end(v, p, d, length):
    there = integral(cubic(v, *p, *d), length)
    back = integral(cubic(v, *p, *(-c for c in d)), length)
    assert there == pytest.approx(back, rel=1e-13, abs=64 * EPS * length * size(v, d))


@given(corners, position, direction, unit, unit, unit)
def test_integrals_of_two_parts_add_up_to_the_whole(v, p, d, a, b, c):
    a, b, c = sorted((a, b, c))
    f = cubic(v, *p, *d)
    whole = antiderivative(f, c) - antiderivative(f, a)
    parts = (
        antiderivative(f, b) - antiderivative(f, a) + antiderivative(f, c) - antiderivative(f, b)
    )
    assert abs(whole - parts) <= 64 * EPS * size(v, d)


@given(corners, position, direction, st.floats(-0.5, 0.5))
def test_antiderivative_and_value_are_those_of_the_cubic(v, p, d, u):
    f = cubic(v, *p, *d)
    assert abs(value(f, u) - polynomial(f, u)) <= 16 * EPS * size(v, d)
    exact = sum(mpmath.mpf(c) * mpmath.mpf(u) ** (n + 1) / (n + 1) for n, c in enumerate(f))
    assert abs(antiderivative(f, u) - exact) <= 16 * EPS * size(v, d)


def test_the_integral_is_never_below_0():
    assert integral((-1.0, 0.0, 0.0, 0.0), 1.0) == 0.0
    assert integral((1.0, 0.0, -100.0, 0.0), 1.0) == 0.0


# --- opacity --------------------------------------------------------------------------------------


def ulps_of_absorbed(x):
    exact = -mpmath.expm1(-mpmath.mpf(x))
    return float(abs(mpmath.mpf(absorbed(x)) - exact) / mpmath.mpf(np.spacing(float(exact))))


def test_opacity_is_right_to_3_ulps_from_0_to_50():
    """Dense samples, and both sides of 1, where the polynomial ends."""
    points = np.concatenate(
        [
            np.linspace(1e-3, 1.0, 2001),
            np.linspace(1.0, 50.0, 500),
            np.geomspace(1e-300, 1e-3, 300),
            [np.nextafter(1.0, 0.0), 1.0, np.nextafter(1.0, 2.0)],
        ]
    )
    assert max(ulps_of_absorbed(float(x)) for x in points) <= 3.0


@given(st.floats(0.0, 1e308))
def test_opacity_is_a_probability(x):
    assert 0.0 <= absorbed(x) <= 1.0


def test_opacity_at_its_ends():
    assert absorbed(0.0) == 0.0
    assert absorbed(1e-20) == 1e-20
    assert absorbed(5e-324) == 5e-324
    assert absorbed(1e30) == 1.0
    assert absorbed(float("inf")) == 1.0


@given(st.floats(0.0, 20.0), st.floats(0.0, 20.0))
def test_opacities_of_two_spans_compose(a, b):
    """T(a + b) = T(a) T(b)."""
    assert absorbed(a + b) == pytest.approx(
        absorbed(a) + (1 - absorbed(a)) * absorbed(b), rel=1e-12, abs=1e-300
    )


def test_opacity_is_right_to_1e_12_at_least():
    for x in np.linspace(1e-3, 3.0, 1000):
        exact = -mpmath.expm1(-mpmath.mpf(float(x)))
        assert float(abs(absorbed(float(x)) / exact - 1)) < 1e-12


@given(st.floats(0.0, 30.0))
def test_more_matter_is_more_opaque(x):
    assert absorbed(x) <= absorbed(x + max(x, 1e-3) * 1e-6)


# --- how the light of a span divides among samples of its source ----------------------------------

positive_line = st.tuples(st.floats(1e-3, 1e3), st.floats(1e-3, 1e3))


def line(ends):
    """The cubic about the middle of [-1/2, 1/2] that runs straight from one value to another."""
    return ((ends[0] + ends[1]) / 2, ends[1] - ends[0], 0.0, 0.0)


@given(corners, position, direction, st.floats(0.0, 10.0), unit)
def test_weights_are_convex_and_lie_in_the_span(v, p, d, scale, width):
    """A convex combination cannot leave the range of the colours, whatever the density does."""
    tau, u, w = hit_weights(cubic(v, *p, *d), scale, -width / 2, width / 2)
    assert tau >= 0.0
    assert all(x >= 0.0 for x in w)
    assert sum(w) == pytest.approx(1.0, abs=4 * EPS)
    assert all(-width / 2 <= x <= width / 2 for x in u)
    assert list(u) == sorted(u)


@given(positive_line, st.floats(1e-6, 10.0))
def test_tau_of_a_span_is_the_scaled_integral(ends, scale):
    tau, _, _ = hit_weights(line(ends), scale, -0.5, 0.5)
    assert tau == pytest.approx(scale * (ends[0] + ends[1]) / 2, rel=1e-13)


def test_nothing_in_a_span_hits_nothing():
    tau, _, w = hit_weights((0.0, 0.0, 0.0, 0.0), 1.0, -0.5, 0.5)
    assert tau == 0.0
    assert sum(w) == 1.0


@given(st.floats(1e-6, 1e3))
def test_weights_of_a_thin_span_are_symmetric_for_an_even_density(density):
    _, u, w = hit_weights((density, 0.0, 0.0, 0.0), 1e-12 / density, -0.5, 0.5)
    assert sum(a * b for a, b in zip(u, w, strict=True)) == pytest.approx(0.0, abs=1e-12)


@given(positive_line)
def test_in_a_thin_span_light_divides_as_density_does(ends):
    """Where T is 1 the mean place of a hit is the density's centre of mass: (b - a) / 6 (a + b)."""
    a, b = ends
    _, u, w = hit_weights(line(ends), 1e-12 / max(a, b), -0.5, 0.5)
    centre = sum(x * y for x, y in zip(u, w, strict=True))
    assert centre == pytest.approx((b - a) / (6 * (a + b)), abs=1e-11)


@given(positive_line, st.floats(1e-3, MAX_TAU), st.integers(0, 2))
def test_moments_of_a_hit_are_those_of_the_exact_integral(ends, tau, power):
    """A source u^n, n up to 2, over a span that is not split: within 1e-5 of its range even where
    the density changes a thousandfold."""
    scale = tau / ((ends[0] + ends[1]) / 2)
    _, u, w = hit_weights(line(ends), scale, -0.5, 0.5)
    got = sum(b * a**power for a, b in zip(u, w, strict=True))
    nodes, weights = np.polynomial.legendre.leggauss(40)
    t = nodes / 2
    sigma = scale * ((ends[0] + ends[1]) / 2 + (ends[1] - ends[0]) * t)
    before = scale * (ends[0] * (t + 0.5) + (ends[1] - ends[0]) * (t + 0.5) ** 2 / 2)
    hits = weights * sigma * np.exp(-before)
    assert got == pytest.approx((hits * t**power).sum() / hits.sum(), abs=1e-5)


def test_errors_of_the_weights_fall_with_a_high_power_of_a_spans_thickness():
    """Four nodes: halving a homogeneous span divides the error of a hit's mean place by 2^7 or
    so (the place itself scales with the span, which is taken as of length 1 here)."""

    def error(tau):
        _, u, w = hit_weights((1.0, 0.0, 0.0, 0.0), tau, -0.5, 0.5)
        exact = 1 / mpmath.mpf(tau) - mpmath.mpf(1) / 2 - 1 / mpmath.expm1(mpmath.mpf(tau))
        return abs(float(sum(a * b for a, b in zip(u, w, strict=True)) - exact))

    thick = np.array([4.0, 2.0, 1.0])
    order = np.polyfit(np.log(thick), np.log([error(t) for t in thick]), 1)[0]
    assert order > 6.5
    assert error(1.0) < 1e-8
