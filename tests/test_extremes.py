"""The extremes of numbers: how thick, how dense, how it is stored. A table; each row is one ray.

Every row goes from a file to a file, under every rule. `extremes` says what a row is; sizes, places
and directions are in `test_extremes_places`, colours in `test_extremes_light`, and what is refused
in `test_extremes_inputs`.
"""

import numpy as np
import pytest
from extremes import (
    Block,
    Case,
    assert_certified,
    assert_closed_form,
    assert_exact,
    assert_midpoint,
    cube,
    tile,
)
from mpmath import mpf, sqrt

# Along x the integral of the field over a lattice line is the sum of the values on it: the tent of
# a voxel has an area of 1. Between lines it is what lies between their sums.
ON_LINE = (-9.0, 0.0, 0.0), (0.0, 0.0, 0.0)
BETWEEN = (-9.0, 3.5, 3.5), (0.0, 3.5, 3.5)
DIAGONAL = (-9.0, -9.0, -9.0), (0.0, 0.0, 0.0)
INSIDE = (3.0, 3.5, 3.5), (9.0, 3.5, 3.5)


def row(name, blocks, ray, tau, scale=1.0, **what):
    return Case(name, tuple(blocks), *ray, tau=tau, scale=float(scale), **what)


def decimal(text):
    """A number as the float64 of a job is the nearest to it."""
    return mpf(float(text))


def single(value):
    """A number as a float32 is the nearest to it."""
    return mpf(float(np.float32(value)))


def half(value):
    return mpf(float(np.float16(value)))


# fmt: off
CASES = [
    # --- extinction, 1e-44 to 1e37 per unit: what float32 can hold of the optical depth ----------
    *(row(f"extinction 1e{e}", [cube(8)], BETWEEN, 8 * decimal(f"1e{e}"), f"1e{e}")
      for e in (-44, -37, -30, -20, -10, -6, -3, 0, 3, 8, 15, 20, 30, 37)),
    *(row(f"extinction 1e{e} on a diagonal", [cube(1)], DIAGONAL, sqrt(3) / 2 * decimal(f"1e{e}"),
          f"1e{e}")
      for e in (-30, -8, 0, 8, 30)),

    # --- optical depth, 1e-12 to 1e12 -------------------------------------------------------------
    *(row(f"optical depth {tau}", [cube(8)], BETWEEN, decimal(tau), float(tau) / 8)
      for tau in ("1e-12", "1e-9", "1e-6", "1e-3", "0.1", "1", "2.5", "1e3", "1e6", "1e12")),
    *(row(f"optical depth {tau}, {why}", [cube(8)], BETWEEN, decimal(tau), float(tau) / 8)
      for tau, why in (("16.6", "where float32 takes 1 - T for 1"),
                       ("87", "where T is the last normal float32"),
                       ("88", "where T is a denormal float32"),
                       ("103.2", "where T is the smallest float32"),
                       ("104", "where T is 0 as float32"),
                       ("745", "where T is the smallest float64"),
                       ("746", "where T is 0"))),

    # --- density times scale, whatever each is ----------------------------------------------------
    row("density 1e-38, scale 1e38", [cube(8, 1e-38)], BETWEEN,
        8 * single(1e-38) * decimal("1e38"), 1e38),
    row("density 1e30, scale 1e-30", [cube(8, 1e30)], BETWEEN,
        8 * single(1e30) * decimal("1e-30"), 1e-30),
    row("the largest float32", [cube(8, 3.4028235e38)], BETWEEN,
        8 * (2 - mpf(2)**-23) * mpf(2)**127 * decimal("1e-38"), 1e-38),
    row("the largest float32 on a diagonal", [cube(1, 3.4028235e38)], DIAGONAL,
        sqrt(3) / 2 * (2 - mpf(2)**-23) * mpf(2)**127 * decimal("1e-38"), 1e-38),
    row("the largest float32 beside nothing", [Block((0, 0, 0), (0, 7, 7), 3.4028235e38)], BETWEEN,
        (2 - mpf(2)**-23) * mpf(2)**127 * decimal("1e-38"), 1e-38),
    row("the smallest normal float32", [cube(8, 2.0**-126)], BETWEEN, 8 * mpf(2)**-26, 2.0**100),
    row("a denormal float32", [cube(8, 2.0**-140)], BETWEEN, 8 * mpf(2)**-40, 2.0**100),
    row("the smallest float32", [cube(8, 2.0**-149)], BETWEEN, 8 * mpf(2)**0, 2.0**149),
    row("the smallest float32 on a diagonal", [cube(1, 2.0**-149)], DIAGONAL, sqrt(3) / 2,
        2.0**149),
    row("a double below float32 is 0", [cube(8, 1e-60)], BETWEEN, mpf(0), 1e60,
        value_type="double"),
    row("a double that float32 rounds", [cube(8, 1 / 3)], BETWEEN, 8 * single(1 / 3),
        value_type="double"),
    row("a scale below float64's normal numbers", [cube(8, 3e38)], BETWEEN,
        8 * single(3e38) * mpf(2)**-1074, 5e-324),
    row("a scale far beyond float32", [cube(8, 2.0**-149)], BETWEEN,
        8 * mpf(2)**-149 * decimal("1e75"), 1e75),

    # --- how values are stored --------------------------------------------------------------------
    row("the largest half", [cube(8, 65504)], BETWEEN, mpf(8 * 65504), half=True),
    row("the smallest normal half", [cube(8, 2.0**-14)], BETWEEN, mpf(2)**-11, half=True),
    row("the smallest half", [cube(8, 2.0**-24)], BETWEEN, mpf(2)**-21, half=True),
    row("a third as a half", [cube(8, 1 / 3)], BETWEEN, 8 * half(1 / 3), half=True),
    row("the largest int32", [cube(8, 2**31 - 1)], BETWEEN, mpf(8 * 2**31), value_type="int32"),
    row("the largest int64", [cube(8, 2**62)], BETWEEN, mpf(2)**65, value_type="int64"),

    # --- densities that differ by 1e12 and more along one ray -------------------------------------
    row("1e-6 before 1e6", [cube(1, 1e-6), cube(1, 1e6, (1, 0, 0))], ON_LINE,
        single(1e-6) + 10**6),
    row("1e6 before 1e-6", [cube(1, 1e6), cube(1, 1e-6, (1, 0, 0))], ON_LINE,
        single(1e-6) + 10**6),
    row("1e-6 and 1e6, scaled to an optical depth of 1",
        [cube(1, 1e-6), cube(1, 1e6, (1, 0, 0))], ON_LINE, (single(1e-6) + 10**6) * decimal("1e-6"),
        1e-6),
    row("1e-6 past 1e6 in the same brick", [Block((0, 0, 0), (7, 0, 0), 1e-6),
        Block((0, 2, 0), (7, 7, 7), 1e6)], ON_LINE, 8 * single(1e-6)),
    row("1e-30 past 1e30 in the same brick", [Block((0, 0, 0), (7, 0, 0), 1e-30),
        Block((0, 2, 0), (7, 7, 7), 1e30)], ON_LINE, 8 * single(1e-30)),
    row("1e-6 in line with 1e6 that lies behind the eye", [Block((5, 0, 0), (7, 7, 7), 1e-6),
        Block((0, 0, 0), (1, 7, 7), 1e6)], INSIDE, 3 * single(1e-6)),
    row("a tile of 1e-9 before a voxel of 1e3", [tile(4096, 1e-9), cube(1, 1e3, (4100, 0, 0))],
        ON_LINE, 4096 * single(1e-9) + 1000, step=61.0),
    row("a hundred voxels in turn 1e-6 and 1e6, each in a brick of its own",
        [cube(1, 1e6 if n % 2 else 1e-6, (8 * n, 0, 0)) for n in range(100)], ON_LINE,
        (50 * single(1e-6) + 50 * 10**6) * decimal("1e-7"), 1e-7, step=7.0),
]
# fmt: on


@pytest.mark.parametrize("case", CASES, ids=str)
def test_every_rule_gives_what_its_closed_form_says(case, tmp_path):
    assert_closed_form(case)
    assert_exact(case, tmp_path)
    assert_certified(case, tmp_path, 1e-1, 1e-5)
    assert_midpoint(case, tmp_path)
