"""The colour of a blackbody: Planck's law through the CIE 1931 observer to linear sRGB.

Temperatures in kelvin to linear R, G, B with Rec.709 primaries. What a temperature stands for in a
grid is for `tables`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

STEP_NM = 5.0
FIRST_NM = 380.0

H, C, K = 6.62607015e-34, 299792458.0, 1.380649e-23
"""Planck's constant (J s), the speed of light (m/s), Boltzmann's constant (J/K): exact, SI 2019."""

LUMENS_PER_WATT = 683.0
"""The luminous efficacy of a radiation at 555 nm, by which Y becomes candela / m2 (CIE 15:2004)."""

XYZ_FROM_RGB = np.array(
    [
        [0.4124, 0.3576, 0.1805],
        [0.2126, 0.7152, 0.0722],
        [0.0193, 0.1192, 0.9505],
    ]
)
"""Linear sRGB to XYZ, Y of white is 1 (IEC 61966-2-1)."""
RGB_FROM_XYZ = np.linalg.inv(XYZ_FROM_RGB)
LUMINANCE = XYZ_FROM_RGB[1]

_OBSERVER = """
0.001368 3.9e-05 0.00645   0.002236 6.4e-05 0.01055   0.004243 0.00012 0.02005
0.00765 0.000217 0.03621   0.01431 0.000396 0.06785   0.02319 0.00064 0.1102
0.04351 0.00121 0.2074   0.07763 0.00218 0.3713   0.13438 0.004 0.6456
0.21477 0.0073 1.03905   0.2839 0.0116 1.3856   0.3285 0.01684 1.62296
0.34828 0.023 1.74706   0.34806 0.0298 1.7826   0.3362 0.038 1.77211
0.3187 0.048 1.7441   0.2908 0.06 1.6692   0.2511 0.0739 1.5281
0.19536 0.09098 1.28764   0.1421 0.1126 1.0419   0.09564 0.13902 0.81295
0.05795 0.1693 0.6162   0.03201 0.20802 0.46518   0.0147 0.2586 0.3533
0.0049 0.323 0.272   0.0024 0.4073 0.2123   0.0093 0.503 0.1582
0.0291 0.6082 0.1117   0.06327 0.71 0.07825   0.1096 0.7932 0.05725
0.1655 0.862 0.04216   0.22575 0.91485 0.02984   0.2904 0.954 0.0203
0.3597 0.9803 0.0134   0.43345 0.99495 0.00875   0.51205 1 0.00575
0.5945 0.995 0.0039   0.6784 0.9786 0.00275   0.7621 0.952 0.0021
0.8425 0.9154 0.0018   0.9163 0.87 0.00165   0.9786 0.8163 0.0014
1.0263 0.757 0.0011   1.0567 0.6949 0.001   1.0622 0.631 0.0008
1.0456 0.5668 0.0006   1.0026 0.503 0.00034   0.9384 0.4412 0.00024
0.85445 0.381 0.00019   0.7514 0.321 0.0001   0.6424 0.265 5e-05
0.5419 0.217 3e-05   0.4479 0.175 2e-05   0.3608 0.1382 1e-05
0.2835 0.107 0   0.2187 0.0816 0   0.1649 0.061 0
0.1212 0.04458 0   0.0874 0.032 0   0.0636 0.0232 0
0.04677 0.017 0   0.0329 0.01192 0   0.0227 0.00821 0
0.01584 0.005723 0   0.0113592 0.004102 0   0.00811092 0.002929 0
0.00579035 0.002091 0   0.00410946 0.001484 0   0.00289933 0.001047 0
0.00204919 0.00074 0   0.00143997 0.00052 0   0.000999949 0.0003611 0
0.000690079 0.0002492 0   0.000476021 0.0001719 0   0.000332301 0.00012 0
0.000234826 8.48e-05 0   0.000166151 6e-05 0   0.000117413 4.24e-05 0
8.30753e-05 3e-05 0   5.87065e-05 2.12e-05 0   4.15099e-05 1.499e-05 0
"""
OBSERVER = np.array(_OBSERVER.split(), np.float64).reshape(-1, 3)
"""(81, 3): the colour-matching functions x, y, z of the CIE 1931 2-degree standard observer, every
5 nm from 380 to 780 nm (CIE 15:2004, table T.4)."""

WAVELENGTHS = (FIRST_NM + STEP_NM * np.arange(len(OBSERVER))) * 1e-9
"""(81,) metres."""


HOTTEST = 1e9
"""Kelvin. Colour no longer changes there, and light grows in proportion."""


def blackbody_xyz(kelvin: ArrayLike) -> NDArray[np.float64]:
    """The colour of a blackbody, (...) kelvin to (..., 3) XYZ with Y in candela / m2.

    XYZ = 683 lm/W sum_i B(lambda_i, T) (x, y, z)(lambda_i) 5 nm, where B is Planck's spectral
    radiance, 2 h c^2 / lambda^5 / (exp(h c / (lambda k T)) - 1). It is 0 at and below 0 K; above
    `HOTTEST` numbers may end.
    """
    return _observed(kelvin, np.zeros(np.shape(kelvin)))


def blackbody_rgb(kelvin: ArrayLike, normalized: bool) -> NDArray[np.float64]:
    """The colour of a blackbody as linear sRGB, (...) kelvin to (..., 3).

    A blackbody below about 1900 K is redder than sRGB can show: its blue is below 0, and becomes 0.

    Parameters
    ----------
    normalized
        Whether luminance, 0.2126 R + 0.7152 G + 0.0722 B, is 1 at every temperature above 0 K;
        else R, G, B are in candela / m2.
    """
    t = np.asarray(kelvin, np.float64)
    if not normalized:
        return np.maximum(blackbody_xyz(t) @ RGB_FROM_XYZ.T, 0.0)
    # Relative to the far red end of the spectrum: Planck's law itself is 0 in float64 below 25 K.
    reddest = H * C / (K * WAVELENGTHS[-1]) / np.maximum(t, 1.0)
    rgb = np.maximum(_observed(t, reddest) @ RGB_FROM_XYZ.T, 0.0)
    luminance = np.where(t > 0, rgb @ LUMINANCE, 1.0)
    return rgb / luminance[..., None]


def _observed(kelvin: ArrayLike, shift: NDArray[np.float64]) -> NDArray[np.float64]:
    """(..., 3): XYZ of Planck's law times exp(shift), (...)."""
    t = np.asarray(kelvin, np.float64)[..., None]
    # Below 1 K colour no longer changes, and light is 0 in float64.
    x = np.where(t > 0, H * C / (K * WAVELENGTHS) / np.maximum(t, 1.0), np.inf)
    # exp(shift) / (exp(x) - 1), without an overflow
    spectrum = np.exp(shift[..., None] - x) / -np.expm1(-x)
    spectrum *= 2 * H * C**2 / WAVELENGTHS**5
    return LUMENS_PER_WATT * STEP_NM * 1e-9 * (spectrum @ OBSERVER)
