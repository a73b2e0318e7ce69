"""Volumes made of blocks, seen along one ray: by volcli from file to file, and by mpmath.

A block is the lattice points ``low`` to ``high``, all of one value v. The field that it makes is a
product of three functions of one coordinate each, whether it is one voxel or a tile 4096 wide:

    linear   v  ramp(x) ramp(y) ramp(z),   ramp(x) = min(1, max(0, 1 + min(x - low, high - x)))
    nearest  v  step(x) step(y) step(z),   step(x) = 1 in [low - 1/2, high + 1/2], else 0

and the fields of blocks without a point in common add up. Along a ray each is a polynomial between
the few distances at which a coordinate passes an end of a ramp: that is all the truth here rests
on. It has 60 digits, knows no cells and no bricks, and imports nothing of volcli.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise

import mpmath
import numpy as np
from mpmath import mpf
from vdbwriter import Grid, write_vdb

from volcli.config import load_job
from volcli.images import read_exr
from volcli.run import load, prepare, run

mpmath.mp.dps = 60

ROUNDED = 1e-7
"""Relative: float32 rounds by 6e-8, and nothing before it costs as much."""

COLOUR = (0.5, 1.0, 2.0)


@dataclass(frozen=True)
class Block:
    """The lattice points low to high, of one value; ``tile`` where it is stored as one."""

    low: tuple
    high: tuple
    value: float = 1.0
    tile: bool = False


def cube(width, value=1.0, at=(0, 0, 0)):
    """A block of width^3 lattice points."""
    return Block(tuple(at), tuple(a + width - 1 for a in at), value)


def tile(width, value=1.0, at=(0, 0, 0)):
    """A block that a file holds as one value."""
    return replace(cube(width, value, at), tile=True)


@dataclass(frozen=True)
class Case:
    """A row of a table: what there is, and what is seen of it along one ray.

    The ray begins at ``eye`` and goes through ``target``, in world units.

    Attributes
    ----------
    tau
        The optical depth in closed form; None where only mpmath knows it.
    depth
        The expected hit distance in closed form; None: not looked at.
    rtol
        What is off relatively, of opacity, optical depth and radiance alike.
    step
        The midpoint rule's, in voxels; None: the row is not for that rule.
    value_type, half
        What the file stores the values as.
    """

    name: str
    blocks: tuple
    eye: tuple
    target: tuple
    tau: mpf | None = None
    scale: float = 1.0
    world: np.ndarray = field(default_factory=lambda: np.eye(4))
    nearest: bool = False
    depth: mpf | None = None
    rtol: float = ROUNDED
    step: float | None = 0.37
    camera: str = "orthographic"
    value_type: str = "float"
    half: bool = False

    def __str__(self):
        return self.name

    @cached_property
    def stored(self):
        """The value of each block as volcli holds it: rounded to what the file stores."""
        stored = [np.float16(b.value) if self.half else np.float32(b.value) for b in self.blocks]
        return [mpf(float(np.float32(value))) for value in stored]

    @cached_property
    def ray(self):
        """(o, d): index coordinates at distance 0, and voxels per world unit; (3,) mpf each."""
        inverse = mpmath.matrix(self.world.tolist()) ** -1
        eye, target = ([mpf(float(x)) for x in p] for p in (self.eye, self.target))
        away = [t - e for t, e in zip(target, eye, strict=True)]
        length = mpmath.sqrt(sum(a * a for a in away))
        o = inverse * mpmath.matrix([*eye, 1])
        d = inverse * mpmath.matrix([*(a / length for a in away), 0])
        return list(o)[:3], list(d)[:3]

    def density(self, t):
        """The field at distance t, before ``scale``."""
        o, d = self.ray
        place = [o[axis] + t * d[axis] for axis in range(3)]
        return sum(
            value * _field(block, place, self.nearest)
            for block, value in zip(self.blocks, self.stored, strict=True)
        )

    @cached_property
    def exact(self):
        """The optical depth, mpf."""
        return mpf(self.scale) * sum(
            value * self._along(block)
            for block, value in zip(self.blocks, self.stored, strict=True)
        )

    def _along(self, block):
        """The integral of a block of value 1."""
        o, d = self.ray
        planes = [
            (plane - o[axis]) / d[axis]
            for axis in range(3)
            if d[axis] != 0
            for plane in _ends(block, axis, self.nearest)
        ]
        cuts = [mpf(0), *sorted(t for t in planes if t > 0)]
        total = mpf(0)
        for begin, end in pairwise(cuts):
            near, middle, far = (
                _field(block, [o[a] + t * d[a] for a in range(3)], self.nearest)
                for t in _inner(begin, end)
            )
            # Simpson's rule, open (at 1/4, 1/2 and 3/4), is exact for a cubic.
            total += (end - begin) * (2 * near - middle + 2 * far) / 3
        return total

    @property
    def support(self):
        """(near, far): the distances between which the midpoint rule steps."""
        o, d = self.ray
        reach = mpf("0.5") if self.nearest else mpf(1)
        near, far = mpf(0), mpmath.inf
        for axis in range(3):
            low = min(b.low[axis] for b in self.blocks) - reach
            high = max(b.high[axis] for b in self.blocks) + reach
            if d[axis] != 0:
                ends = sorted([(low - o[axis]) / d[axis], (high - o[axis]) / d[axis]])
                near, far = max(near, ends[0]), min(far, ends[1])
            elif not low <= o[axis] <= high:
                return mpf(0), mpf(0)
        return near, max(near, far)

    @property
    def midpoint(self):
        """The optical depth by the digest's rule: a sample in the middle of each step."""
        near, far = self.support
        _, d = self.ray
        step = mpf(self.step) / mpmath.sqrt(sum(x * x for x in d))
        total, t = mpf(0), near
        while t < far:
            length = min(step, far - t)
            total += length * self.density(t + length / 2)
            t += length
        return mpf(self.scale) * total


def _ends(block, axis, nearest):
    """Where along an axis a block's function of that coordinate turns."""
    low, high = block.low[axis], block.high[axis]
    if nearest:
        return mpf(low) - 0.5, mpf(high) + 0.5
    return low - 1, low, high, high + 1


def _inner(begin, end):
    return [begin + (end - begin) * share / 4 for share in (1, 2, 3)]


def _field(block, place, nearest):
    """A block of value 1 at a place in index coordinates."""
    product = mpf(1)
    for x, low, high in zip(place, block.low, block.high, strict=True):
        if nearest:
            product *= low - mpf("0.5") <= x <= high + mpf("0.5")
        else:
            product *= min(mpf(1), max(mpf(0), 1 + min(x - low, high - x)))
    return product


# --- from file to file ----------------------------------------------------------------------------


def grid_of(blocks, world, **grid):
    """A grid of blocks, active where they are; a tile of 8, 128 or 4096 is one value."""
    channels = (3,) if grid.get("value_type", "").startswith("vec3") else ()
    tiles, leaves = {}, {}
    for block in blocks:
        if block.tile:
            tiles[block.low, block.high[0] - block.low[0] + 1] = (block.value, True)
            continue
        for at in np.ndindex(*np.subtract(block.high, block.low) + 1):
            point = np.add(block.low, at)
            leaf = tuple((point & -8).tolist())
            if leaf not in leaves:
                leaves[leaf] = (np.zeros((8, 8, 8, *channels)), np.zeros((8, 8, 8), bool))
            inside = tuple(point & 7)
            leaves[leaf][0][inside], leaves[leaf][1][inside] = block.value, True
    numbers = tuple(np.asarray(world, float).T.reshape(-1).tolist())
    return Grid(leaves=leaves, tiles=tiles, map_type="AffineMap", map_numbers=numbers, **grid)


def write_blocks(path, blocks, world, **grid):
    """A .vdb file of one grid of blocks."""
    write_vdb(path, [grid_of(blocks, world, **grid)])
    return path


def flags_of(case):
    """The camera, scale and interpolation of a row, as flags of a job."""
    away = np.abs(np.subtract(case.target, case.eye))
    up = np.zeros(3)
    up[int(np.argmin(away))] = 1.0
    lens = [("camera.width", 1.0)] if case.camera == "orthographic" else []
    return [
        ("camera.type", case.camera),
        ("camera.eye", tuple(map(float, case.eye))),
        ("camera.target", tuple(map(float, case.target))),
        ("camera.up", tuple(up.tolist())),
        ("camera.resolution", (1, 1)),
        *lens,
        ("density.scale", case.scale),
        ("density.interpolation", "nearest" if case.nearest else "linear"),
        ("color.constant", COLOUR),
    ]


def picture_of(path, flags, out):
    """The channels of the one pixel that a job of a file makes, and what it reports."""
    job = load_job(path, [*flags, ("output.image", out)])
    prepared = prepare(job)
    report = run(prepared, load(prepared, threads=1), threads=1)
    channels, _ = read_exr(out)
    return {name: float(values[0, 0]) for name, values in channels.items()}, report


def assert_close(found, expected, rtol, what):
    """As float32 has it: relatively, or to the smallest number that there is."""
    difference = abs(mpf(found) - expected)
    assert difference <= rtol * abs(expected) + 2.0**-149, f"{what}: {found!r} for {expected}"


def assert_light(seen, tau, rtol=ROUNDED):
    """All that a picture says of an optical depth."""
    opacity = -mpmath.expm1(-tau)
    assert_close(seen["optical_depth.Y"], tau, rtol, "optical depth")
    assert_close(seen["A"], opacity, rtol, "opacity")
    for channel, colour in zip("RGB", COLOUR, strict=True):
        assert_close(seen[channel], colour * opacity, rtol, channel)
    # What tau is off by is relative to T: far behind, where T is 0 to anyone, it may be all of it.
    off = ROUNDED + (rtol if rtol > ROUNDED else 1e-14) * tau
    assert_close(seen["transmittance.Y"], mpmath.exp(-tau), min(off, 1), "transmittance")
    assert (seen["Z"] == np.inf) == (tau == 0)


def see(case, folder, *rule):
    """What the picture of a row holds, under the rule that flags ask for: (channels, report)."""
    path = folder / "blocks.vdb"
    if not path.exists():
        write_blocks(path, case.blocks, case.world, value_type=case.value_type, half=case.half)
    return picture_of(path, [*flags_of(case), *rule], folder / "seen.exr")


def assert_exact(case, folder):
    """The exact rule gives the integral."""
    seen, _ = see(case, folder)
    assert_light(seen, case.exact, case.rtol)
    if case.depth is not None:
        assert_close(seen["Z"], case.depth, max(case.rtol, 1e-6), "depth")


def assert_certified(case, folder, *errors):
    """A pixel is no farther from the truth than its certificate, nor is that above what was
    allowed."""
    opacity = -mpmath.expm1(-case.exact)
    off = case.rtol if case.rtol > ROUNDED else 0.0
    for allowed in errors:
        seen, report = see(case, folder, ("quadrature.max_error", allowed))
        bound = seen["error_bound.Y"]
        assert bound == report.error_bound <= allowed
        bound += off * min(case.exact, 1)  # of what float64 makes of places it knows nothing
        assert abs(seen["transmittance.Y"] - mpmath.exp(-case.exact)) <= bound
        assert abs(seen["A"] - opacity) <= bound
        for channel, colour in zip("RGB", COLOUR, strict=True):
            assert abs(seen[channel] - colour * opacity) <= bound * max(COLOUR)


def assert_midpoint(case, folder):
    """The midpoint rule gives the digest's sum."""
    seen, _ = see(case, folder, ("quadrature.rule", "midpoint"), ("quadrature.step", case.step))
    assert_light(seen, case.midpoint, case.rtol)


def assert_closed_form(case):
    """A row's closed form is the integral of its field, to what float64 makes of its places."""
    rtol = 1e-14 if case.rtol == ROUNDED else case.rtol
    assert abs(case.tau - case.exact) <= rtol * case.tau, case.exact
