"""Values that cannot be rendered as they are: found, counted, located, and settled as asked."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import tree_of

from volcli.errors import VolumeError
from volcli.grids.values import clamp_negative, settle_nonfinite


def with_value(value, at=(10, 3, 2)):
    values = np.ones((16, 8, 8), np.float32)
    values[at] = value
    return tree_of(values)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_value_that_is_not_finite_is_an_error_that_says_how_many_and_where(bad):
    with pytest.raises(VolumeError, match=r"^f: 1 values are NaN or Inf.*index \(10, 3, 2\)"):
        settle_nonfinite(with_value(bad), "f", "error")


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_value_that_is_not_finite_becomes_0_where_that_is_accepted(bad):
    tree, notes = settle_nonfinite(with_value(bad), "f", "zero")
    assert notes == ["f: 1 values are NaN or Inf, taken as 0"]
    assert sorted(np.unique(tree.leaf_values)) == [0, 1]
    assert np.count_nonzero(tree.leaf_values == 0) == 1


def test_a_double_beyond_float32_is_not_finite():
    values = np.ones((1, 8, 8, 8), np.float64)
    values[0, 1, 2, 3] = 1e200
    tree = replace(tree_of(values[0] > 0), leaf_values=values)
    with pytest.raises(VolumeError, match=r"1 values.*\(1, 2, 3\)"):
        settle_nonfinite(tree, "f", "error")


def test_values_that_are_sound_are_left_as_they_are():
    tree = with_value(0.5)
    settled, notes = settle_nonfinite(tree, "f", "error")
    assert not notes
    assert np.array_equal(settled.leaf_values, tree.leaf_values)
    assert clamp_negative(tree, "f") == (tree, [])


def test_values_below_0_become_0_and_are_counted():
    tree, notes = clamp_negative(with_value(-3.0), "f")
    assert notes == ["f: 1 values below 0, taken as 0"]
    assert tree.leaf_values.min() == 0
    assert np.count_nonzero(tree.leaf_values == 0) == 1


def test_the_tree_that_was_given_is_not_changed():
    tree = with_value(-3.0)
    clamp_negative(tree, "f")
    assert tree.leaf_values.min() == -3
