"""Planck's law as colour: a published table, closed forms, and what no temperature may break."""

import mpmath
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from volcli.blackbody import HOTTEST, LUMINANCE, OBSERVER, blackbody_rgb, blackbody_xyz

FOURMILAB = """
 1000 0.6528 0.3444    1500 0.5857 0.3931    2000 0.5267 0.4133    2500 0.4770 0.4137
 3000 0.4369 0.4041    3500 0.4053 0.3907    4000 0.3805 0.3768    4500 0.3608 0.3636
 5000 0.3451 0.3516    5500 0.3325 0.3411    6000 0.3221 0.3318    6500 0.3135 0.3237
 7000 0.3064 0.3166    7500 0.3004 0.3103    8000 0.2952 0.3048    8500 0.2908 0.3000
 9000 0.2869 0.2956    9500 0.2836 0.2918   10000 0.2807 0.2884
"""
"""Kelvin, x, y: J. Walker, "Colour Rendering of Spectra", Fourmilab (1996), the table printed by
its program; CIE 1931 2-degree observer.
"""

PUBLISHED = np.array(FOURMILAB.split(), float).reshape(-1, 3)
TEMPERATURES = st.floats(0, HOTTEST)


def chromaticity(kelvin):
    xyz = blackbody_xyz(kelvin)
    return xyz[..., :2] / xyz.sum(axis=-1, keepdims=True)


def test_chromaticity_is_that_of_a_published_table_from_1000_to_10000_kelvin():
    found = chromaticity(PUBLISHED[:, 0])
    assert np.abs(found - PUBLISHED[:, 1:]).max() < 1e-3  # it has four digits: this is 2e-4


def test_illuminant_a_is_that_of_the_cie():
    """CIE 15:2004: x 0.44758, y 0.40745, at 2856 K by the second radiation constant of 1990."""
    np.testing.assert_allclose(chromaticity(2848 * 1.4388 / 1.4350), [0.44758, 0.40745], atol=2e-4)


def test_luminance_at_the_freezing_point_of_platinum_is_the_candela_of_1948():
    """It was defined so that a blackbody at 2042 K has 60 candela / cm2."""
    assert blackbody_xyz(2042.0)[1] == pytest.approx(60e4, rel=0.03)


def test_the_spectrum_is_plancks_law_in_many_digits():
    h, c, k = (mpmath.mpf(s) for s in ("6.62607015e-34", "299792458", "1.380649e-23"))
    for kelvin in (300, 1234.5, 6500, 50000):
        total = mpmath.mpf(0)
        for i, row in enumerate(OBSERVER):
            wavelength = mpmath.mpf(380 + 5 * i) * mpmath.mpf("1e-9")
            x = h * c / (wavelength * k * kelvin)
            total += 2 * h * c**2 / wavelength**5 / mpmath.expm1(x) * mpmath.mpf(row[1])
        assert blackbody_xyz(kelvin)[1] == pytest.approx(float(683 * total * 5e-9), rel=1e-11)


def test_the_observer_is_the_standard_one():
    assert OBSERVER.shape == (81, 3)
    assert OBSERVER[:, 1].max() == OBSERVER[35, 1] == 1.0, "555 nm"
    # CIE 15:2004: an equal-energy spectrum is x = y = 1/3
    sums = OBSERVER.sum(axis=0)
    np.testing.assert_allclose(sums / sums.sum(), 1 / 3, atol=1e-5)


@given(TEMPERATURES)
def test_a_normalized_colour_has_luminance_1_and_nothing_below_0(kelvin):
    rgb = blackbody_rgb(kelvin, True)
    assert (rgb >= 0).all()
    assert rgb @ LUMINANCE == pytest.approx(1.0 if kelvin > 0 else 0.0, abs=1e-12)


@given(TEMPERATURES, TEMPERATURES)
def test_what_is_hotter_is_brighter(one, other):
    cold, hot = sorted((one, other))
    assert (blackbody_rgb(cold, False) <= blackbody_rgb(hot, False) * (1 + 1e-12)).all()


def test_white_is_near_the_temperature_of_daylight_and_red_below_and_blue_above_it():
    red, white, blue = blackbody_rgb([1500.0, 6600.0, 15000.0], True)
    assert red[0] > 3 * red[1] > 9 * red[2]
    assert np.ptp(white) < 0.07
    assert blue[2] > 1.3 * blue[0]


@pytest.mark.parametrize("kelvin", [0.0, -1.0, 1e-300, 5e-324, 1e-3, HOTTEST])
@pytest.mark.parametrize("normalized", [True, False])
def test_no_temperature_gives_what_is_not_a_number(kelvin, normalized):
    rgb = blackbody_rgb(kelvin, normalized)
    assert np.isfinite(rgb).all()
    if kelvin <= 0:
        assert (rgb == 0).all()
