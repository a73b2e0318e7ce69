"""Colour and density by value: what ramps, maps and temperatures become."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from volcli.blackbody import blackbody_rgb
from volcli.errors import UsageError, VolumeError
from volcli.schema import Job
from volcli.sources import Blackbody, Color, DensityRamp, Emission, Ramp
from volcli.srgb import srgb_from_linear
from volcli.tables import blackbody_table, map_colors, ramp_table, source_table, transfer_table

STOPS = ((1.0, 0.0, 0.5, 1.0), (2.0, 1.0, 0.5, 0.0), (4.0, 1.0, 1.0, 1.0))


def test_a_transfer_function_is_linear_between_its_stops_and_constant_beyond_them():
    table = transfer_table(DensityRamp(stops=[[0.3, 0], [0.4, 2], [0.5, 0]]))
    found = table.at([-1, 0.3, 0.35, 0.4, 0.45, 0.5, 9])
    np.testing.assert_allclose(found, [0, 0, 1, 2, 1, 0, 0], atol=1e-12)


def test_one_stop_is_a_constant():
    assert transfer_table(DensityRamp(stops=[[0.3, 2]])).at([-1.0, 5.0]).tolist() == [2, 2]
    table = ramp_table(Ramp(stops=[STOPS[0]]), (0.0, 1.0), "color.ramp", "a")
    assert table.at([0.0, 7.0]).tolist() == [[0, 0.5, 1]] * 2


def test_stops_of_colour_are_linear_light():
    table = ramp_table(Ramp(stops=STOPS), (0.0, 0.0), "color.ramp", "a")
    np.testing.assert_allclose(
        table.at([0, 1.5, 3, 9]),
        [[0, 0.5, 1], [0.5, 0.5, 0.5], [1, 0.75, 0.5], [1, 1, 1]],
        atol=1e-12,
    )


@pytest.mark.parametrize("name", ["inferno", "viridis", "coolwarm", "jet", "gray", "hot_r"])
def test_a_map_shows_on_a_screen_the_colours_that_matplotlib_shows(name):
    from matplotlib import colormaps

    table = ramp_table(Ramp(map=name, range=(10, 20)), (0.0, 1.0), "color.ramp", "a")
    values = np.linspace(9, 21, 200)
    shown = srgb_from_linear(table.at(values))
    expected = colormaps[name](np.clip((values - 10) / 10, 0, 1))[:, :3]
    # matplotlib takes the nearest of its 256 colours; the table goes from one to the next
    steps = np.abs(np.diff(colormaps[name](np.arange(256))[:, :3], axis=0)).max()
    assert np.abs(shown - expected).max() <= steps + 2e-3


def test_the_ends_of_a_map_are_those_of_the_active_values_where_there_is_no_range():
    table = ramp_table(Ramp(map="gray"), (-3.0, 5.0), "color.ramp", "a")
    assert (table.knots[0], table.knots[-1]) == (-3, 5)
    np.testing.assert_allclose(table.at([-3, 5]), [[0] * 3, [1] * 3], atol=1e-12)


def test_a_map_without_a_name_is_inferno():
    table = ramp_table(Ramp(), (0.0, 1.0), "color.ramp", "a")
    np.testing.assert_array_equal(table.colors, map_colors("inferno", "color.ramp.map"))


@pytest.mark.parametrize(
    ("name", "meant"), [("infreno", "inferno"), ("Viridis", "viridis"), ("zzz", "such as")]
)
def test_a_map_that_there_is_not_is_refused_with_a_guess(name, meant):
    with pytest.raises(UsageError, match=f"color.ramp.map: no colour map '{name}'.*{meant}"):
        map_colors(name, "color.ramp.map")


def test_a_grid_of_one_value_has_no_range():
    with pytest.raises(VolumeError, match=r"a: is 5 wherever .*give color\.ramp\.range"):
        ramp_table(Ramp(), (5.0, 5.0), "color.ramp", "a")


@given(
    st.floats(0, 3000),
    st.floats(1, 3000),
    st.floats(0.1, 3),
    st.floats(0, 300),
    st.booleans(),
)
def test_a_blackbody_is_off_by_little_between_its_knots(low, span, scale, offset, normalized):
    """Of its brightest colour; what has luminance 1 above 0 K is black there."""
    part = Blackbody(grid="t", scale=scale, offset=offset, normalized=normalized)
    table = blackbody_table(part, (low, low + span), "color.blackbody", "a")
    if (normalized and scale * low + offset < 100) or scale * (low + span) + offset < 500:
        return
    values = np.linspace(low, low + span, 5000)
    truth = blackbody_rgb(scale * values + offset, normalized)
    assert np.abs(table.at(values) - truth).max() <= (5e-3 if normalized else 1e-3) * truth.max()


@pytest.mark.parametrize(
    ("scale", "offset", "field"),
    [(1, -10, (0, 100)), (-1, 50, (0, 100)), (1, 0, (-5, 100)), (1e9, 0, (0, 100))],
)
def test_what_is_no_temperature_is_refused_by_the_name_of_the_field(scale, offset, field):
    part = Blackbody(grid="t", scale=scale, offset=offset)
    with pytest.raises(VolumeError, match=r"a: is .* K.*emission.blackbody.offset"):
        blackbody_table(part, field, "emission.blackbody", "a")


@pytest.mark.parametrize(("normalized", "error"), [(False, 6e-6), (True, 6e-4)])
def test_a_blackbody_of_a_flame_is_as_near_as_it_is_said_to_be(normalized, error):
    part = Blackbody(grid="t", normalized=normalized)
    table = blackbody_table(part, (0.0, 3000.0), "color.blackbody", "a")
    values = np.linspace(100, 3000, 50_000)
    truth = blackbody_rgb(values, normalized)
    assert np.abs(table.at(values) - truth).max() < error * truth.max()


def test_a_falling_scale_makes_a_falling_table():
    part = Blackbody(grid="t", scale=-1, offset=3000, normalized=False)
    table = blackbody_table(part, (0.0, 2000.0), "color.blackbody", "a")
    assert (np.diff(table.knots) > 0).all()
    assert table.at(0.0)[0] > table.at(2000.0)[0]


def test_emission_of_a_scalar_grid_is_its_colour_times_its_value_and_strength():
    part = Emission(grid="flame", constant=(1, 0.5, 0), strength=3)
    table = source_table(part, "emission", (0.1, 0.7), (0.0, 0.7), "a")
    np.testing.assert_allclose(
        table.at([0, 0.35, 0.7]), np.outer([0, 0.35, 0.7], [3, 1.5, 0]), atol=1e-15
    )


@pytest.mark.parametrize("field", [(-2.0, 4.0), (-2.0, -1.0), (0.0, 0.0), (3.0, 3.0)])
def test_emission_below_0_is_none(field):
    table = source_table(Emission(grid="a"), "emission", field, field, "a")
    assert (np.diff(table.knots) > 0).all()
    values = np.array(field)
    np.testing.assert_allclose(table.at(values)[:, 0], np.maximum(values, 0))


def test_a_colour_is_multiplied_by_its_strength():
    part = Color(ramp=Ramp(stops=STOPS), strength=2)
    table = source_table(part, "color", (0.0, 1.0), (0.0, 1.0), "a")
    np.testing.assert_allclose(table.at(4.0), [2, 2, 2])
    assert Job(color={"constant": [1, 2, 3], "strength": 2}).color.value == (2, 4, 6)
