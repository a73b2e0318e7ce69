"""The digest's equations on numbers that others published, and the laws between them."""

import doctest

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from volcli import quadrature as q

sigmas = hnp.arrays(np.float64, 12, elements=st.floats(0.0, 50.0))
deltas = hnp.arrays(np.float64, 12, elements=st.floats(0.0, 2.0))


def test_the_examples_in_the_docstrings_hold():
    result = doctest.testmod(q)
    assert result.attempted >= 12
    assert result.failed == 0


def test_beer_and_lambert():
    """sigma 2 over lengths 0, .25, 2.5, 5."""
    lengths = np.array([0.0, 0.25, 2.5, 5.0])
    got = q.transmittance(2 * lengths)
    np.testing.assert_allclose(got, [1, 0.60653, 6.7379e-3, 4.5400e-5], rtol=1e-5)
    np.testing.assert_allclose(q.homogeneous_radiance(3.0, 2.0, lengths), 3 * (1 - got), rtol=1e-14)


def test_nerfaccs_weights_from_alphas():
    weights = q.weights_from_alpha([0.3, 0.8, 0.8, 0.5])
    np.testing.assert_allclose(weights, [0.3, 0.56, 0.112, 0.014], rtol=1e-12)


def test_nerfaccs_weights_from_densities():
    weights = q.weights_from_density([0.8, 0.1, 0.8, 0.1], np.ones(4))
    np.testing.assert_allclose(weights, [0.5507, 0.0428, 0.2239, 0.0174], atol=5e-5)


def test_what_reaches_a_sample_is_dimmed_by_those_before_it_and_not_by_itself():
    """The product runs over k < n; the digest's last display prints n."""
    alpha = np.array([0.5, 0.25, 0.125])
    np.testing.assert_allclose(q.transmittance_from_alpha(alpha), [1, 0.5, 0.375], rtol=1e-14)
    sigma, delta = np.array([1.0, 2.0, 3.0]), np.array([0.5, 0.25, 2.0])
    np.testing.assert_allclose(q.optical_depth_before(sigma, delta), [0, 0.5, 1.0])
    np.testing.assert_allclose(
        q.transmittance_from_density(sigma, delta), np.exp([0, -0.5, -1.0]), rtol=1e-14
    )


@given(sigmas, deltas)
def test_weights_sum_to_the_opacity_of_the_whole(sigma, delta):
    total = q.opacity(q.optical_depth(sigma, delta))
    assert q.weights_from_density(sigma, delta).sum() == pytest.approx(total, rel=1e-12, abs=1e-300)


@given(sigmas, deltas)
def test_densities_and_alphas_tell_the_same(sigma, delta):
    alpha = q.alpha_from_density(sigma, delta)
    # 1 - alpha has rounding of 1e-16, which is large beside it where alpha is nearly 1.
    np.testing.assert_allclose(
        q.weights_from_alpha(alpha), q.weights_from_density(sigma, delta), rtol=1e-6, atol=1e-14
    )


@given(sigmas, deltas, st.integers(1, 11))
def test_two_parts_of_a_ray_composite_to_the_whole(sigma, delta, cut):
    radiance = np.linspace(0, 1, 36).reshape(12, 3)
    behind = q.composite(radiance[cut:], sigma[cut:], delta[cut:], background=[1.0, 2.0, 3.0])
    front = q.composite(radiance[:cut], sigma[:cut], delta[:cut], background=behind)
    whole = q.composite(radiance, sigma, delta, background=[1.0, 2.0, 3.0])
    np.testing.assert_allclose(front, whole, rtol=1e-12, atol=1e-14)


@given(sigmas, deltas)
def test_a_constant_radiance_needs_no_samples(sigma, delta):
    got = q.composite(np.full((12, 1), 0.7), sigma, delta)
    expected = 0.7 * q.opacity(q.optical_depth(sigma, delta))
    np.testing.assert_allclose(got, [expected], rtol=1e-12, atol=1e-300)


@given(sigmas, deltas)
def test_a_composite_never_leaves_the_range_of_what_it_blends(sigma, delta):
    radiance = np.random.default_rng(0).uniform(0.2, 0.9, (12, 3))
    got = q.composite(radiance, sigma, delta, background=[0.5] * 3)
    assert (got >= 0.2 - 1e-12).all()
    assert (got <= 0.9 + 1e-12).all()


def test_batches_are_rays_one_by_one():
    rng = np.random.default_rng(1)
    sigma, delta, radiance = rng.random((4, 5, 7)), rng.random((4, 5, 7)), rng.random((4, 5, 7, 3))
    whole = q.composite(radiance, sigma, delta, background=[1.0, 0.0, 2.0])
    assert whole.shape == (4, 5, 3)
    t = np.cumsum(delta, axis=-1)
    for at in np.ndindex(4, 5):
        one = q.composite(radiance[at], sigma[at], delta[at], background=[1.0, 0.0, 2.0])
        np.testing.assert_allclose(whole[at], one, rtol=1e-14)
        assert q.expected_distance(sigma, delta, t)[at] == pytest.approx(
            q.expected_distance(sigma[at], delta[at], t[at]), rel=1e-14
        )


def test_a_million_thin_samples_multiply_to_exp_of_minus_1():
    """In float32 a running product of (1 - alpha) gives .3856."""
    sigma, delta = np.full(10**6, 1.0), np.full(10**6, 1e-6)
    assert q.transmittance(q.optical_depth(sigma, delta)) == pytest.approx(np.exp(-1), rel=1e-12)
    alpha = q.alpha_from_density(sigma, delta)
    # A running sum of a million terms rounds a million times.
    assert q.transmittance_from_alpha(alpha)[-1] == pytest.approx(np.exp(-1 + 1e-6), rel=1e-10)


def test_opacity_keeps_its_digits_however_thin_the_medium():
    for tau in (1e-300, 1e-20, 1e-8, 1e-6):
        assert q.opacity(tau) == pytest.approx(tau - tau**2 / 2, rel=1e-12)
    assert q.opacity(1e4) == 1.0
    assert q.opacity(np.inf) == 1.0


def test_an_opaque_sample_hides_the_rest():
    np.testing.assert_array_equal(q.transmittance_from_alpha([0.5, 1.0, 0.5]), [1.0, 0.5, 0.0])
    weights = q.weights_from_density([1e30, 1.0], [1.0, 1.0])
    np.testing.assert_array_equal(weights, [1.0, 0.0])


def test_the_expected_distance_of_nothing_is_infinite():
    assert q.expected_distance(np.zeros(3), np.ones(3), np.arange(3.0)) == np.inf
    both = q.expected_distance([[0.0, 0.0], [1.0, 0.0]], np.ones(2), [0.5, 1.5])
    np.testing.assert_array_equal(both, [np.inf, 0.5])


def test_the_expected_distance_of_many_samples_is_that_of_the_exponential():
    delta = np.full(100_000, 1e-4)
    t = (np.arange(100_000) + 0.5) * 1e-4
    rest = np.exp(-3.0 * 10)
    exact = 1 / 3.0 - 10 * rest / (1 - rest)
    assert q.expected_distance(np.full(100_000, 3.0), delta, t) == pytest.approx(exact, rel=1e-7)


def test_shapes_that_do_not_match_are_refused():
    with pytest.raises(ValueError):
        q.optical_depth(np.ones(3), np.ones(4))
    with pytest.raises(ValueError):
        q.composite(np.ones((3, 3)), np.ones(4), np.ones(4))


def test_all_that_is_public_is_listed_in_order():
    public = [n for n, f in vars(q).items() if callable(f) and f.__module__ == q.__name__]
    assert sorted(n for n in public if not n.startswith("_")) == q.__all__
