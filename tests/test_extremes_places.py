"""The extremes of places: how large voxels are, where they lie, where the eye is, where it looks.

A table like that of `test_extremes`; each row is one ray, whose optical depth has a closed form. A
voxel's tent has an area of 1 along its axes, 2/3 sqrt 2 along the diagonals of its faces, and
1/2 sqrt 3 along those of its body; what it is beyond its last lattice point is half of each.
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
from scenes import SHEAR, affine, rotation

ONE, EIGHT = (cube(1),), (cube(8),)
TURNED = affine(rotation((1, 2, 3), 37.0))
HALF = mpf(1) / 2


def row(name, blocks, eye, target, tau, **what):
    """A row without a transform: world space is index space."""
    return Case(name, tuple(blocks), eye, target, tau=tau, **what)


def under(world, name, blocks, eye, target, tau=None, **what):
    """A row under a transform, its eye and target given in index space."""
    eye, target = (tuple((world @ [*map(float, p), 1.0])[:3].tolist()) for p in (eye, target))
    return Case(name, tuple(blocks), eye, target, tau=tau, world=world, **what)


def sized(size):
    return affine(size * np.eye(3))


def moved(*offset):
    return affine(np.eye(3), offset)


FLAT = (-9, 3.5, 3.5), (0, 3.5, 3.5)  # of a cube of 8: what is off across the ray changes nothing
CORNERS = (-9, -9, -9), (0, 0, 0)
ACROSS = (-9, 0.5, 0), (0, 0.5, 0)  # of one voxel: half of it
OBLIQUE = (-9.3, 20.7, 11.9), (0.1, -0.2, 0.15)

# fmt: off
SIZES = [
    *(under(sized(float(k)), f"voxels of {k}", EIGHT, *FLAT, mpf(8), scale=1 / float(k))
      for k in ("1e-12", "1e-6", "1e-3", "1e3", "1e6", "1e12")),
    *(under(sized(float(k)), f"voxels of {k}, on a diagonal", ONE, *CORNERS,
            sqrt(3) / 2, scale=1 / float(k)) for k in ("1e-6", "1e6")),
    *(under(sized(float(k)), f"voxels of {k}, oblique", [cube(2)], *OBLIQUE, scale=1 / float(k))
      for k in ("1e-6", "1e6")),
    *(under(sized(float(k)) @ TURNED, f"voxels of {k}, turned", EIGHT, (-9, 3, 4), (0, 3, 4), None,
            scale=1 / float(k)) for k in ("1e-6", "1e6")),
    *(under(affine(np.diag([1e-6, 1.0, 1e6])), f"voxels of 1e-6 x 1 x 1e6, along {axis}", EIGHT,
            eye, (3.5, 3.5, 3.5), mpf(8), scale=1 / size)
      for axis, eye, size in (("x", (-9, 3.5, 3.5), 1e-6), ("y", (3.5, -9, 3.5), 1.0),
                              ("z", (3.5, 3.5, -9), 1e6))),
    under(affine(np.diag([1e-6, 1.0, 1e6])), "voxels of 1e-6 x 1 x 1e6, on a diagonal", ONE,
          *CORNERS, sqrt(mpf(10)**-12 + 1 + mpf(10)**12) / 2 / 10**6, scale=1e-6),
    under(affine(SHEAR @ np.diag([1e-3, -1.0, 1e3])), "sheared and mirrored, voxels of 1e-3 to 1e3",
          [cube(3)], (-9, 2, 20), (1, 1.1, 0.9), scale=1e-3),
]

OFFSETS = [
    *(under(moved(float(far), -float(far), float(far)), f"a world {far} away, along x", EIGHT,
            *FLAT, mpf(8)) for far in ("1e3", "1e5", "1e7")),
    *(under(moved(float(far), -float(far), float(far)), f"a world {far} away, across a tent", ONE,
            *ACROSS, HALF) for far in ("1e3", "1e5", "1e7")),
    under(moved(1e7, -1e7, 1e7), "a world 1e7 away, on a diagonal", ONE, *CORNERS, sqrt(3) / 2),
    under(moved(1e7, -1e7, 1e7), "a world 1e7 away, oblique", [cube(2)], *OBLIQUE),
    under(moved(1e7, -1e7, 1e7) @ TURNED, "a world 1e7 away, turned", [cube(2)], *OBLIQUE),
    under(affine(1e-3 * np.eye(3), (1e7,) * 3), "voxels of 1e-3 in a world 1e7 away", ONE, *ACROSS,
          scale=1e3, rtol=1e-5),  # float64 holds places there to 1e-6 of a voxel
    *(under(moved(*(-float(i) for i in at)), f"voxels at {at}, brought back", [cube(8, at=at)],
            tuple(np.add(FLAT[0], at)), tuple(np.add(FLAT[1], at)), mpf(8), rtol=1e-6)
      for at in ((10**7, -(10**7), 10**7), (2**30, -(2**30), 0), (2**31 - 16, -(2**31) + 8, 8))),
    row("voxels at (10^7, 10^7, 10^7) where they are", [cube(1, at=(10**7,) * 3)],
        (10**7 - 9, 10**7 + 0.5, 10**7), (10**7, 10**7 + 0.5, 10**7), HALF),
]

EYES = [
    row("an eye 1e6 voxels away", EIGHT, (-1e6, 3.5, 3.5), (0, 3.5, 3.5), mpf(8)),
    row("an eye 1e6 voxels away, across a tent", ONE, (-1e6, 0.5, 0), (0, 0.5, 0), HALF),
    row("an eye 1e6 voxels away along each axis", ONE, (-1e6, -1e6, -1e6), (0, 0, 0), sqrt(3) / 2),
    row("an eye 13e6 voxels away, oblique", ONE, (-3e6, -4e6, -12e6), (0, 0, 0), None),
    row("an eye 1e9 voxels away", ONE, (-1e9, 0.5, 0), (0, 0.5, 0), HALF, rtol=1e-6),
    row("an eye 1e6 voxels away, in perspective", ONE, (-1e6, 0.5, 0), (0, 0.5, 0), HALF,
        camera="perspective"),
    row("a panorama 1e6 voxels away", ONE, (-1e6, 0.5, 0), (0, 0.5, 0), HALF, camera="panorama"),
    row("an eye on a lattice point", EIGHT, (3, 3, 3), (9, 3, 3), mpf("4.5")),
    row("an eye on a lattice point, on a diagonal", EIGHT, (3, 3, 3), (4, 4, 4),
        sqrt(3) * (4 + mpf(1) / 4)),
    row("an eye on a lattice line", EIGHT, (3, 3, 3.5), (9, 3, 3.5), mpf("4.5")),
    row("an eye in a lattice plane", EIGHT, (3, 3.25, 3.5), (9, 3.25, 3.5), mpf("4.5")),
    row("an eye in a lattice plane that looks along it", EIGHT, (3.25, 3, 3.5), (9, 3, 3.5),
        mpf("4.25")),
    row("an eye between", EIGHT, (3.25, 3.3, 3.4), (9, 3.3, 3.4), mpf("4.25")),
    row("an eye on the first lattice point that looks away", EIGHT, (0, 0, 0), (-1, 0, 0), HALF),
    row("an eye on the last lattice point that looks away", EIGHT, (7, 7, 7), (8, 7, 7), HALF),
    row("an eye in the skirt", EIGHT, (7.5, 7, 7), (8, 7, 7), mpf(1) / 8),
    row("an eye where the skirt ends", EIGHT, (8, 7, 7), (9, 7, 7), mpf(0)),
    row("an eye where the skirt ends that looks back", EIGHT, (8, 7, 7), (7, 7, 7), mpf(8)),
    row("an eye beyond it all", EIGHT, (80, 7, 7), (81, 7, 7), mpf(0)),
    row("an eye on the one voxel there is", ONE, (0, 0, 0), (1, 1, 1), sqrt(3) / 4),
    row("an eye between two clouds", [cube(8), cube(8, 5.0, (40, 0, 0))], (20, 3, 3), (21, 3, 3),
        mpf(40)),
    row("an eye in a tile of 4096", [tile(4096)], (2048, 99, 99), (2049, 99, 99), mpf("2047.5"),
        step=37.0),
    row("an eye in a tile of 4096, on a diagonal", [tile(4096)], (2048,) * 3, (2049,) * 3,
        sqrt(3) * (2047 + mpf(1) / 4), step=37.0),
    row("an eye that touches its target", EIGHT, (3, 3, 3), (3 + 2.0**-50, 3, 3), mpf("4.5")),
]

SIGNS = [(a, b, c) for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)]
DIRECTIONS = [
    *(row(f"along {name}", EIGHT, tuple(3.5 - 20 * x for x in d), (3.5, 3.5, 3.5), mpf(8))
      for name, d in (("+x", (1, 0, 0)), ("-x", (-1, 0, 0)), ("+y", (0, 1, 0)), ("-y", (0, -1, 0)),
                      ("+z", (0, 0, 1)), ("-z", (0, 0, -1)))),
    *(row(f"along the diagonal {d} of a body", ONE, tuple(-9 * x for x in d), (0, 0, 0),
          sqrt(3) / 2) for d in SIGNS),
    *(row(f"along the diagonal {d} of a face", ONE, tuple(-9 * x for x in d), (0, 0, 0),
          2 * sqrt(2) / 3) for d in ((1, 1, 0), (1, 0, -1), (0, -1, 1), (-1, -1, 0))),
    row("through eight lattice points, corner to corner", EIGHT, *CORNERS, sqrt(3) * mpf("7.5")),
    row("along an edge of the cube of values", EIGHT, (-9, 0, 0), (0, 0, 0), mpf(8)),
    row("along its last edge", EIGHT, (-9, 7, 7), (0, 7, 7), mpf(8)),
    row("in a face of it", EIGHT, (-9, 0, 3.3), (0, 0, 3.3), mpf(8)),
    row("half a voxel beside a face", EIGHT, (-9, -0.5, 3.5), (0, -0.5, 3.5), mpf(4)),
    row("half a voxel beside an edge", EIGHT, (-9, 7.5, 7.5), (0, 7.5, 7.5), mpf(2)),
    row("a millionth within the skirt", EIGHT, (-9, 8 - 2.0**-20, 3), (0, 8 - 2.0**-20, 3),
        8 * mpf(2)**-20, rtol=1e-6),
    row("where the skirt ends", EIGHT, (-9, 8, 3), (0, 8, 3), mpf(0)),
    row("where the skirt ends, along an edge", EIGHT, (-9, -1, -1), (0, -1, -1), mpf(0)),
    row("a billionth beside the skirt", EIGHT, (-9, 8 + 1e-9, 3), (0, 8 + 1e-9, 3), mpf(0)),
    row("past the corner of a skirt", ONE, (3, -1, 0), (1, 1, 0), mpf(0)),
    row("with -0.0 across", EIGHT, (-9, 0, 0), (0, -0.0, -0.0), mpf(8)),
    row("backwards with -0.0 across", EIGHT, (20, 7, 7), (0, 7, 7), mpf(8)),
    row("from -0.0", ONE, (-0.0, -0.0, -0.0), (1, -0.0, -0.0), HALF),
    under(affine(-np.eye(3)), "mirrored, with -0.0 across", EIGHT, (-9, 0, 0), (0, -0.0, 0),
          mpf(8)),
    *(row(f"with {tilt:g} across", EIGHT, (-9, 3, 3), (1, 3 + 10 * tilt, 3 + 10 * tilt), mpf(8))
      for tilt in (1e-300, 1e-17)),
    *(row(f"with {tilt:g} across, in a lattice plane", EIGHT, (-9, 0, 0),
          (1, 10 * tilt, -10 * tilt), mpf(8)) for tilt in (1e-300, 1e-310, -1e-310, 5e-324)),
    row("with 1e-9 across", ONE, (-9, 0, 0), (1, 1e-8, 0), None),
    row("with 1e-9 along", [cube(2)], (1e-8, -9, 0.5), (0, 1, 0.5), None),
    row("with 1e-300 across, next to an edge", ONE, (-9, 0.5, 1e-300), (0, 0.5, -1e-300), HALF),
]

WIDTHS = [
    row("one voxel", ONE, (-9, 0, 0), (0, 0, 0), mpf(1)),
    row("one voxel, oblique", ONE, *OBLIQUE, None),
    *(row(f"a tile of {w}", [tile(w)], (-9, w / 2, w / 2), (0, w / 2, w / 2), mpf(w), step=w / 50)
      for w in (8, 128, 4096)),
    *(row(f"a tile of {w}, corner to corner", [tile(w)], *CORNERS, sqrt(3) * (w - HALF),
          step=w / 50) for w in (8, 128, 4096)),
    *(row(f"a tile of {w}, half a voxel beside it", [tile(w)], (-9, 7, w - 0.5), (0, 7, w - 0.5),
          mpf(w) / 2, step=w / 50) for w in (8, 128, 4096)),
    row("two tiles of 4096 side by side", [tile(4096), tile(4096, at=(4096, 0, 0))],
        (-9, 1, 4095), (0, 1, 4095), mpf(8192), step=77.0),
    row("two tiles of 4096, along where they meet", [tile(4096), tile(4096, at=(0, 4096, 0))],
        (-9, 4095.5, 7), (0, 4095.5, 7), mpf(4096), step=77.0),
    row("two tiles of 4096 that meet at a corner", [tile(4096), tile(4096, at=(4096,) * 3)],
        *CORNERS, sqrt(3) * (2 * 4095 + 1), step=77.0),
    row("a tile of 4096 of a thousand times another", [tile(4096, 1e-3), tile(4096, 1.0,
        (-4096, 0, 0))], (9000, 20, 20), (0, 20, 20), 4096 * (1 + mpf(float(np.float32(1e-3)))),
        step=77.0),
    row("a tile of 4096, oblique", [tile(4096)], (-500, 3, 99), (4000, 4097.5, 4095.75), None,
        step=77.0),
    row("a voxel between tiles of 4096", [tile(4096), tile(4096, at=(8192, 0, 0)),
        cube(1, 7.0, (6000, 9, 9))], (-9, 9, 9), (0, 9, 9), mpf(8192 + 7), step=77.0),
    row("tiles of three widths", [tile(8), tile(128, at=(128, 0, 0)), tile(4096, at=(4096, 0, 0))],
        (-9, 3, 3), (0, 3, 3), mpf(8 + 128 + 4096), step=77.0),
    row("a slab one voxel thick", [Block((0, 0, 0), (0, 63, 63))], (-9, 30, 30), (0, 31, 32),
        None),
]

NEAREST = [
    row("one voxel, not blended", ONE, (-9, 0.25, 0), (0, 0.25, 0), mpf(1), nearest=True),
    row("one voxel, not blended, corner to corner", ONE, *CORNERS, sqrt(3), nearest=True),
    row("an eye in a voxel that is not blended", EIGHT, (3.25, 3, 3), (9, 3, 3), mpf("4.25"),
        nearest=True),
    row("a tile of 4096, not blended", [tile(4096)], (-9, 4095.25, 7), (0, 4095.25, 7), mpf(4096),
        nearest=True, step=77.0),
    row("1e-6 before 1e6, not blended", [cube(1, 1e-6), cube(1, 1e6, (1, 0, 0))], (-9, 0.25, 0),
        (0, 0.25, 0), 10**6 + mpf(float(np.float32(1e-6))), nearest=True, step=0.5),
    under(moved(1e7, 1e7, 1e7), "one voxel 1e7 away, not blended", ONE, *CORNERS, sqrt(3),
          nearest=True, rtol=1e-6),
]
# fmt: on

CASES = [*SIZES, *OFFSETS, *EYES, *DIRECTIONS, *WIDTHS, *NEAREST]


@pytest.mark.parametrize("case", CASES, ids=str)
def test_every_rule_gives_what_its_closed_form_says(case, tmp_path):
    if case.tau is not None:
        assert_closed_form(case)
    assert_exact(case, tmp_path)
    assert_certified(case, tmp_path, 1e-1)
    assert_midpoint(case, tmp_path)
