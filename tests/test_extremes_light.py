"""The extremes of light: how bright, behind how much, from how far. A table; each row is one ray.

Colour and emission lie in grids of their own, and density is a constant where the ray is: then
light has a closed form. With sigma the extinction and L the length of the way,

    colour      c (1 - T)                         of one colour c
                c0 + k / sigma                    of c0 + k t, up to where nothing is seen
    emission    e (1 - exp(-sigma L)) / sigma     and e L where sigma is 0
"""

from dataclasses import dataclass

import mpmath
import numpy as np
import pytest
from extremes import Block, cube, grid_of, picture_of, tile
from mpmath import mpf
from vdbwriter import write_vdb

COLOUR, FLAME = ("color.grid", "Cd"), ("emission.grid", "flame")
BLACK = ("color.constant", (0.0, 0.0, 0.0))
MIDPOINT = (("quadrature.rule", "midpoint"), ("quadrature.step", 0.5))
"""Of steps that end where density turns: each holds its optical depth exactly."""

ALLOWED = 1e-2


@dataclass(frozen=True)
class Lit:
    """A row: what absorbs, what shines, and the light (r, g, b) that is seen.

    Attributes
    ----------
    colour, flame
        Blocks of the grids ``Cd`` and ``flame``, of three channels each.
    brightest
        What an error is a share of.
    rtol
        How far off the exact rule may be, as a share of the light.
    smooth
        Whether the midpoint rule has the same closed form.
    """

    name: str
    blocks: tuple
    scale: float
    light: tuple
    colour: tuple = ()
    flame: tuple = ()
    flags: tuple = ()
    eye: tuple = (-9.0, 3.5, 3.5)
    size: float = 1.0
    rtol: float = 2e-7
    smooth: bool = True

    def __str__(self):
        return self.name


def opacity(tau):
    return -mpmath.expm1(-mpf(tau))


def grey(light):
    return (mpf(light),) * 3


def emitted(sigma, length, e=1.0):
    """e (1 - exp(-sigma L)) / sigma."""
    sigma, length = mpf(sigma), mpf(length)
    return grey(mpf(e) * (opacity(sigma * length) / sigma if sigma else length))


def coloured(name, sigma, c, **what):
    """Eight voxels in a colour that is the same all along the ray."""
    c = tuple(float(np.float32(x)) for x in c)
    light = tuple(mpf(x) * opacity(8 * mpf(sigma)) for x in c)
    along = (tile(128, c), tile(128, c, (-128, 0, 0)))
    return Lit(name, (cube(8),), sigma, light, along, flags=(COLOUR,), **what)


def burning(name, sigma, e, length=8, **what):
    """Voxels that are not blended and glow: the ray is in them from end to end."""
    e = float(np.float32(e))
    flags = (FLAME, BLACK, ("density.interpolation", "nearest"))
    size = what.get("size", 1.0)
    return Lit(name, (cube(8),), sigma, emitted(sigma, length * mpf(size), e),
               flame=(cube(8, (e,) * 3),), flags=flags, **what)  # fmt: skip


LINE = tuple(Block((n, 0, 0), (n, 7, 7), (1.0 + n, 2.0, 64.0 - n)) for n in range(64))
"""Colour that changes by 1 from voxel to voxel."""


def ramp(sigma):
    """The first 1 / sigma of a colour that is 1 + x, 2 and 64 - x, from an eye at x = 1."""
    k = 1 / mpf(sigma)
    return Lit(f"a ramp of colour in an extinction of {sigma:g}", (tile(128),), sigma,
               (2 + k, mpf(2), 63 - k), LINE, flags=(COLOUR,), eye=(1.0, 3.5, 3.5), rtol=1e-6,
               smooth=False)  # fmt: skip


# fmt: off
CASES = [
    *(coloured(f"one colour in an extinction of 1e{e}", float(f"1e{e}"), (0.5, 1.0, 2.0))
      for e in (-36, -30, -12, -6, -3, 0, 1, 3, 6, 12, 30, 37)),
    *(coloured(f"a colour of {c:g}", 0.5, (c, c / 2, 0.0))
      for c in (1e-37, 1e-30, 1e-6, 65504.0, 1e6, 1e30, 3e38)),
    coloured("colours that differ by 1e12", 0.5, (1e-6, 1.0, 1e6)),
    coloured("a colour below 0", 0.5, (-1.0, -1e-6, -1e6)),
    coloured("a colour of -0.0", 0.5, (-0.0, 0.0, -0.0)),
    coloured("a colour of denormals behind an opaque skin", 1e6, (2.0**-140, 2.0**-149, 2.0**-127)),

    *(ramp(sigma) for sigma in (1.0, 10.0, 1e2, 1e3, 1e4, 1e6, 1e9)),

    *(burning(f"a flame in an extinction of {s:g}", s, 0.25)
      for s in (1e-300, 1e-30, 1e-12, 1e-6, 1e-3, 0.1, 1.0)),
    *(burning(f"a flame of {e:g}", 0.5, e) for e in (1e-37, 1e-30, 1e-6, 65504.0, 1e6, 1e30)),
    *(burning(f"a flame in voxels of {k:g}", 0.5 / k, 1.0, size=k) for k in (1e-6, 1e-3, 1e6)),
    burning("a flame without smoke", 0.0, 0.25),
    burning("a flame of 1e30 without smoke", 0.0, 1e30),
    burning("a flame around the eye", 0.5, 1.0, mpf("4.25"), eye=(3.25, 3.25, 3.5)),
    burning("a flame behind the eye", 0.5, 1.0, 0, eye=(9.0, 3.5, 3.5)),
]
# fmt: on


def see(lit, folder, *rule):
    """(r, g, b) of the one pixel, and all that it holds."""
    world = np.diag([lit.size] * 3 + [1.0])
    grids = [grid_of(lit.blocks, world)]
    grids += [
        grid_of(blocks, world, name=name, value_type="vec3s", background=(0, 0, 0))
        for name, blocks in (("Cd", lit.colour), ("flame", lit.flame))
        if blocks
    ]
    path = folder / "lit.vdb"
    if not path.exists():
        write_vdb(path, grids)
    eye = np.array(lit.eye) * lit.size
    ahead = eye + np.array([lit.size, 0.0, 0.0])
    flags = [
        ("camera.type", "orthographic"),
        ("camera.width", 1.0),
        ("camera.eye", tuple(eye.tolist())),
        ("camera.target", tuple(ahead.tolist())),
        ("camera.resolution", (1, 1)),
        ("density.scale", lit.scale),
        *lit.flags,
        *rule,
    ]
    seen, report = picture_of(path, flags, folder / "lit.exr")
    return [seen[c] for c in "RGB"], seen, report


@pytest.mark.parametrize("lit", CASES, ids=str)
def test_light_is_its_closed_form_under_every_rule(lit, tmp_path):
    for rule in ((), MIDPOINT) if lit.smooth else ((),):
        light, _, _ = see(lit, tmp_path, *rule)
        for found, expected in zip(light, lit.light, strict=True):
            assert abs(found - expected) <= lit.rtol * abs(expected) + 2.0**-149, (rule, expected)


@pytest.mark.parametrize("lit", CASES, ids=str)
def test_a_certified_error_of_light_is_not_exceeded(lit, tmp_path):
    light, seen, report = see(lit, tmp_path, ("quadrature.max_error", ALLOWED))
    bound = seen["error_bound.Y"]
    assert bound == report.error_bound <= ALLOWED
    values = [abs(v) for b in (*lit.colour, *lit.flame) for v in b.value]
    # Of what is emitted, the most that there can be along the diagonal of its box.
    brightest = max(values) * (9 * np.sqrt(3) * lit.size if lit.flame else 1)
    for found, expected in zip(light, lit.light, strict=True):
        assert abs(found - expected) <= bound * brightest + 2.0**-149
