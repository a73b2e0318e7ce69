"""The equations of emission and absorption, as small NumPy functions over arrays of samples.

After Tagliasacchi and Mildenhall, "Volume Rendering Digest (for NeRF)", arXiv:2209.02417, and Max,
"Optical models for direct volume rendering" (1995). This is the readable definition of what volcli
computes, a public API for people who hold samples along rays, and the oracle that the compiled
kernels are tested against: they never import it and it never imports them.

Along a ray, all arrays have samples on the last axis (n of them) and any batch axes before it:

    sigma     (..., n)     extinction of each interval, 1 / length
    delta     (..., n)     length of each interval
    alpha     (..., n)     opacity of each interval, 1 - exp(-sigma delta)
    radiance  (..., n, c)  what each interval emits

Computation is in float64. Functions raise ValueError where shapes do not match, as NumPy does.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

__all__ = [
    "alpha_from_density",
    "composite",
    "expected_distance",
    "hit_density",
    "homogeneous_radiance",
    "opacity",
    "optical_depth",
    "optical_depth_before",
    "segment_radiance",
    "transmittance",
    "transmittance_from_alpha",
    "transmittance_from_density",
    "weights_from_alpha",
    "weights_from_density",
]


def optical_depth(sigma: ArrayLike, delta: ArrayLike) -> Floats:
    """tau = integral of sigma ds = sum_n sigma_n delta_n, shape (...,).

    >>> optical_depth([2.0, 2.0], [0.5, 0.75])
    np.float64(2.5)
    """
    return np.sum(_thickness(sigma, delta), axis=-1)


def optical_depth_before(sigma: ArrayLike, delta: ArrayLike) -> Floats:
    """The optical depth in front of each sample: sum over k < n of sigma_k delta_k, (..., n).

    The sum excludes the sample itself; the digest's last display runs its index to n, which would
    count a sample's own absorption twice.

    >>> optical_depth_before([1.0, 2.0, 3.0], [1.0, 1.0, 1.0])
    array([0., 1., 3.])
    """
    thickness = _thickness(sigma, delta)
    before = np.zeros_like(thickness)
    np.cumsum(thickness[..., :-1], axis=-1, out=before[..., 1:])
    return before


def transmittance(tau: ArrayLike) -> Floats:
    """T = exp(-tau): the probability of crossing without a hit (digest: transmittance).

    >>> transmittance(0.5).round(5)
    np.float64(0.60653)
    """
    return np.exp(-np.asarray(tau, np.float64))


def opacity(tau: ArrayLike) -> Floats:
    """O = 1 - T, as -expm1(-tau): right to rounding however thin the medium (digest: opacity).

    >>> float(opacity(1e-20))
    1e-20
    """
    return -np.expm1(-np.asarray(tau, np.float64))


def alpha_from_density(sigma: ArrayLike, delta: ArrayLike) -> Floats:
    """alpha_n = 1 - exp(-sigma_n delta_n), (..., n). Digest, piecewise-constant data.

    >>> alpha_from_density([0.8, 0.1], [1.0, 1.0]).round(4)
    array([0.5507, 0.0952])
    """
    return opacity(_thickness(sigma, delta))


def transmittance_from_density(sigma: ArrayLike, delta: ArrayLike) -> Floats:
    """T_n = exp(-sum over k < n of sigma_k delta_k), (..., n): what reaches each sample.

    >>> transmittance_from_density([1.0, 1.0], [np.log(2), 1.0])
    array([1. , 0.5])
    """
    return transmittance(optical_depth_before(sigma, delta))


def transmittance_from_alpha(alpha: ArrayLike) -> Floats:
    """T_n = product over k < n of (1 - alpha_k), (..., n); through log1p, so that many thin samples
    do not lose their digits. An alpha of 1 lets nothing pass.

    >>> transmittance_from_alpha([0.5, 0.5, 1.0])
    array([1.  , 0.5 , 0.25])
    """
    alpha = np.asarray(alpha, np.float64)
    with np.errstate(divide="ignore"):
        logs = np.log1p(-alpha)
    before = np.zeros_like(logs)
    np.cumsum(logs[..., :-1], axis=-1, out=before[..., 1:])
    return np.exp(before)


def weights_from_density(sigma: ArrayLike, delta: ArrayLike) -> Floats:
    """w_n = T_n alpha_n, (..., n): the probability that the first hit is in interval n.

    They sum to the opacity of the whole, 1 - T_N.

    >>> weights_from_density([0.8, 0.1, 0.8, 0.1], [1.0, 1.0, 1.0, 1.0]).round(4)
    array([0.5507, 0.0428, 0.2239, 0.0174])
    """
    return transmittance_from_density(sigma, delta) * alpha_from_density(sigma, delta)


def weights_from_alpha(alpha: ArrayLike) -> Floats:
    """w_n = alpha_n times the product over k < n of (1 - alpha_k), (..., n).

    >>> weights_from_alpha([0.3, 0.8, 0.8, 0.5]).round(4)
    array([0.3  , 0.56 , 0.112, 0.014])
    """
    return transmittance_from_alpha(alpha) * np.asarray(alpha, np.float64)


def composite(
    radiance: ArrayLike, sigma: ArrayLike, delta: ArrayLike, background: ArrayLike = 0.0
) -> Floats:
    """C = sum_n T_n alpha_n c_n + T_N c_background, (..., c). Digest, the piecewise-constant rule.

    ``background`` is (c,) or broadcasts to (..., c).

    >>> composite([[1.0], [3.0]], [np.log(2), np.log(2)], [1.0, 1.0], background=[8.0])
    array([3.25])
    """
    weights = weights_from_density(sigma, delta)
    behind = transmittance(optical_depth(sigma, delta))
    colour = np.sum(weights[..., None] * np.asarray(radiance, np.float64), axis=-2)
    return colour + behind[..., None] * np.asarray(background, np.float64)


def hit_density(sigma: ArrayLike, tau_before: ArrayLike) -> Floats:
    """T(t) sigma(t), (...,): the probability density of the distance of the first hit, 1 / length.

    Its integral is the opacity, which is the distribution function (digest: hit probability).

    >>> hit_density(2.0, np.log(4)).round(12)
    np.float64(0.5)
    """
    return transmittance(tau_before) * np.asarray(sigma, np.float64)


def segment_radiance(radiance: ArrayLike, tau: ArrayLike, tau_before: ArrayLike = 0.0) -> Floats:
    """C = c T(a) (1 - T(a, b)), (...,): one radiance over [a, b] (digest: alternate form).

    ``tau`` is the optical depth of [a, b], ``tau_before`` that in front of a: neither radiance nor
    density is sampled inside beyond it.

    >>> segment_radiance(8.0, np.log(2), tau_before=np.log(4)).round(12)
    np.float64(1.0)
    """
    return np.asarray(radiance, np.float64) * transmittance(tau_before) * opacity(tau)


def homogeneous_radiance(radiance: ArrayLike, sigma: ArrayLike, length: ArrayLike) -> Floats:
    """C = c (1 - exp(-sigma (b - a))): one radiance and one extinction over [a, b] (homogeneous).

    >>> homogeneous_radiance(2.0, np.log(2), 1.0).round(12)
    np.float64(1.0)
    """
    return segment_radiance(radiance, np.asarray(sigma, np.float64) * np.asarray(length))


def expected_distance(sigma: ArrayLike, delta: ArrayLike, t: ArrayLike) -> Floats:
    """sum_n w_n t_n / sum_n w_n, (...,): where on average a ray is stopped, if it is stopped.

    ``t`` is (..., n), the distance of each sample; +inf where the opacity is 0.

    >>> expected_distance([0.0, 5.0], [1.0, 1.0], [0.5, 1.5])
    np.float64(1.5)
    """
    weights = weights_from_density(sigma, delta)
    hit = opacity(optical_depth(sigma, delta))
    moment = np.sum(weights * np.asarray(t, np.float64), axis=-1)
    out = np.full(np.shape(hit), np.inf)
    return np.divide(moment, hit, out=out, where=hit > 0)[()]


def _thickness(sigma: ArrayLike, delta: ArrayLike) -> Floats:
    return np.asarray(sigma, np.float64) * np.asarray(delta, np.float64)
