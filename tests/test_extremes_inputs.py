"""The extremes of what is asked for: values that are no densities, pictures of one pixel, lenses as
narrow and as wide as there are, a million steps. Tables; each row is one command.

The volume is eight voxels in a row, of 1 but for one of them. The ray runs along the row, so that
its optical depth is the sum of the values. What is refused says why in one line; that every mistake
does is in `test_cli_errors`.
"""

import math
from dataclasses import dataclass

import numpy as np
import pytest
from commandline import volcli
from extremes import Block, cube, tile, write_blocks
from vdbwriter import Grid, write_vdb

from volcli.images import read_exr

ROW = ("--eye", "-9,0,0", "--target", "0,0,0", "--size", "1x1")
TAKEN_AS_0 = ("--set", "density.nonfinite=zero")


@dataclass(frozen=True)
class Ask:
    """A row of a table: what is asked for, and the optical depth or the refusal that answers it.

    Attributes
    ----------
    value
        Of the fourth of the eight voxels.
    stored
        What the file stores them as.
    says
        A part of what is printed: of the error, or of a warning. None: nothing is.
    """

    name: str
    value: float = 1.0
    flags: tuple = ()
    tau: float | None = None
    code: int = 0
    says: str | None = None
    stored: str = "float"

    def __str__(self):
        return self.name


def written(path, value, stored):
    """Eight voxels along x, the fourth of which is ``value``."""
    values, active = np.zeros((8, 8, 8)), np.zeros((8, 8, 8), bool)
    values[:, 0, 0], active[:, 0, 0] = 1.0, True
    values[3, 0, 0] = value
    half = stored == "half"
    grid = Grid(value_type="float" if half else stored, half=half, map_numbers=(1.0,) * 15)
    grid.leaves[0, 0, 0] = (values, active)
    with np.errstate(over="ignore"):
        write_vdb(path, [grid])
    return path


NAN, INF = math.nan, math.inf
NOT_FINITE = "1 values are NaN or Inf, the first at index (3, 0, 0)"
RAMP = ("--set", "density.ramp.stops=[[-1, 5], [0, 0], [1, 1]]")

# fmt: off
VALUES = [
    Ask("NaN", NAN, code=3, says=NOT_FINITE),
    Ask("Inf", INF, code=3, says=NOT_FINITE),
    Ask("-Inf", -INF, code=3, says=NOT_FINITE),
    Ask("NaN as a half", NAN, code=3, says=NOT_FINITE, stored="half"),
    Ask("a half beyond 65504", 7e4, code=3, says=NOT_FINITE, stored="half"),
    Ask("a double beyond float32", 1e39, code=3, says=NOT_FINITE, stored="double"),
    Ask("NaN taken as 0", NAN, TAKEN_AS_0, 7.0, says="1 values are NaN or Inf, taken as 0"),
    Ask("Inf taken as 0", INF, TAKEN_AS_0, 7.0, says="1 values are NaN or Inf, taken as 0"),
    Ask("-Inf taken as 0", -INF, TAKEN_AS_0, 7.0, says="1 values are NaN or Inf, taken as 0"),
    Ask("a double beyond float32 taken as 0", 1e39, TAKEN_AS_0, 7.0, says="taken as 0",
        stored="double"),
    Ask("NaN that no term needs", NAN, ("--density-scale", "0", "--set", "emission.grid=density"),
        code=3, says=NOT_FINITE),
    Ask("-1", -1.0, tau=7.0, says="1 values below 0, taken as 0"),
    Ask("-1e38", -1e38, tau=7.0, says="1 values below 0, taken as 0"),
    Ask("a negative denormal", -(2.0**-149), tau=7.0, says="1 values below 0, taken as 0"),
    Ask("-0.0", -0.0, tau=7.0),
    Ask("a negative int32", -(2**31), tau=7.0, says="1 values below 0", stored="int32"),
    # 7 voxels of 1, and the fourth, whose ramp is steeper below 0: half a voxel to each side of its
    # neighbours falls from 1 to 0, half a voxel rises to 5.
    Ask("-1 under a transfer function", -1.0, RAMP, 6 + 2 * (0.25 + 1.25)),
    Ask("0", 0.0, tau=7.0),
]

SIZES = [
    Ask("0x0 pixels", flags=("--size", "0x0"), code=2, says="--size 0x0: give width and height"),
    Ask("1x0 pixels", flags=("--size", "1x0"), code=2, says="--size 1x0: give width and height"),
    Ask("0x1 pixels", flags=("--size", "0x1"), code=2, says="--size 0x1: give width and height"),
    Ask("65537 pixels", flags=("--size", "65537x1"), code=2, says="must be at most 65536"),
    Ask("one pixel", flags=("--size", "1x1"), tau=8.0),
    Ask("one pixel of 4096 samples", flags=("--set", "camera.samples=4096", "--ortho", "1e-9"),
        tau=8.0),
]

LENSES = [
    Ask("a field of view of 1e-9 degrees", flags=("--fov", "1e-9"), tau=8.0),
    Ask("a field of view of 1e-300 degrees", flags=("--fov", "1e-300"), tau=8.0),
    Ask("a field of view of 179.9999 degrees", flags=("--fov", "179.9999"), tau=8.0),
    Ask("a picture 1e-300 wide", flags=("--ortho", "1e-300"), tau=8.0),
    Ask("a picture 1e300 wide", flags=("--ortho", "1e300"), tau=8.0),
    Ask("up that is 1e-300 long", flags=("--up", "0,1e-300,0"), tau=8.0),
    Ask("up that is 1e300 long", flags=("--up", "0,1e300,0"), tau=8.0),
    Ask("up a millionth beside the view", flags=("--up", "1,1e-6,0"), tau=8.0),
    Ask("up along the view", flags=("--up", "1,0,0"), code=2, says="choose another up"),
    Ask("an eye that is its target", flags=("--target", "-9,0,0"), code=2, says="the same point"),
    Ask("a target 1e300 away", flags=("--target", "1e300,0,0"), tau=8.0),
    Ask("an eye 1e12 away", flags=("--eye", "-1e12,0,0"), tau=8.0),
    Ask("an eye 1e14 away", flags=("--eye", "-1e14,0,0"), tau=8.0,
        says="rays are placed to 0.02 voxels only"),
    Ask("an eye 1e300 away", flags=("--eye", "-1e300,0,0"), says="nearer to the volume"),
]

# One step over the whole of [-1, 8] samples its middle, where density is 1.
STEPS = [
    Ask("a step of 1e-300", flags=("--step", "1e-300"), code=2, says="give at least"),
    Ask("a step of 1e-9", flags=("--step", "1e-9"), code=2, says="give at least"),
    Ask("a step as long as the volume", flags=("--step", "9"), tau=9.0),
    Ask("a step longer than the volume", flags=("--step", "1e3"), tau=9.0),
    Ask("a step of 1e300", flags=("--step", "1e300"), tau=9.0),
    Ask("a step of 9/2: two samples", flags=("--step", "4.5"), tau=9.0),
    Ask("an allowed error of 1", flags=("--max-error", "1"), code=2, says="must be below 1"),
    Ask("an allowed error of 1e-9", flags=("--max-error", "1e-9"), code=2,
        says="at least 1e-06"),
    Ask("an allowed error of 0 is none", flags=("--max-error", "0"), tau=8.0),
]

RESULTS = [
    Ask("an optical depth beyond float32", flags=("--density-scale", "1e38"), code=5,
        says="the first at x=0, y=0"),
    Ask("a scale beyond all", flags=("--density-scale", "1e308"), code=5, says="density.scale"),
    Ask("a scale of 0", flags=("--density-scale", "0"), code=2, says="there is nothing to see"),
    Ask("a scale below 0", flags=("--density-scale", "-1"), code=2, says="must be at least 0"),
    Ask("a colour beyond float32", flags=("--color", "1e39,0,0"), code=5, says="NaN or Inf"),
    Ask("a colour of 3e38", flags=("--color", "3e38,0,0"), tau=8.0),
    Ask("a colour of 1e-300", flags=("--color", "1e-300,0,0"), tau=8.0),
]
# fmt: on


@pytest.mark.parametrize("ask", [*VALUES, *SIZES, *LENSES, *STEPS, *RESULTS], ids=str)
def test_what_is_asked_for_is_answered(ask, tmp_path):
    path, out = written(tmp_path / "row.vdb", ask.value, ask.stored), tmp_path / "a.exr"
    flags = dict(zip(ROW[::2], ROW[1::2], strict=True))
    flags |= dict(zip(ask.flags[::2], ask.flags[1::2], strict=True))
    ran = volcli("render", path, "-o", out, "--quiet", *[x for pair in flags.items() for x in pair])
    assert ran.code == ask.code, ran.err
    if ask.says is None:
        assert ran.err == ""
    else:
        assert ask.says in ran.err
        assert ran.err.count("\n") == 1
    assert out.exists() == (ask.code == 0)
    if ask.tau is not None:
        channels, _ = read_exr(out)
        assert channels["optical_depth.Y"].shape == (1, 1)
        assert channels["optical_depth.Y"][0, 0] == pytest.approx(ask.tau, rel=1e-6)
        assert channels["A"][0, 0] == pytest.approx(-math.expm1(-ask.tau), rel=1e-6)
        assert channels["transmittance.Y"][0, 0] == pytest.approx(math.exp(-ask.tau), rel=1e-5)
        assert np.isfinite(channels["R"][0, 0])


@pytest.mark.parametrize("rows, columns", [(1, 200), (200, 1), (1, 1), (3, 65), (65, 3)])
def test_a_picture_of_any_shape_is_a_part_of_a_larger_one(rows, columns, tmp_path):
    """Pixels of the same size about the same middle see the same, to rounding of the camera."""
    path = write_blocks(tmp_path / "cube.vdb", [cube(8)], np.eye(4))
    taus = []
    for shape in ((rows, columns), (rows + 2, columns + 2)):
        out = tmp_path / "a.exr"
        ran = volcli(
            "render", path, "-o", out, "--eye", "3.5,3.5,40", "--target", "3.5,3.5,3.5",
            "--ortho", f"{0.1 * shape[1]}", "--size", f"{shape[1]}x{shape[0]}", "--quiet",
        )  # fmt: skip
        assert ran.code == 0, ran.err
        taus.append(read_exr(out)[0]["optical_depth.Y"])
    assert taus[0].shape == (rows, columns)
    np.testing.assert_allclose(taus[0], taus[1][1:-1, 1:-1], atol=1e-6)
    assert taus[0].max() == 8


NOTHING = {
    "no voxel": [],
    "a voxel of 0": [cube(1, 0.0)],
    "voxels of -1": [cube(8, -1.0)],
    "voxels of -0.0": [cube(8, -0.0)],
    "a tile of 0": [tile(4096, 0.0)],
    "a tile of -1": [tile(128, -1.0)],
}


@pytest.mark.parametrize("rule", [(), ("--step", "0.5"), ("--max-error", "0.1")], ids=str)
@pytest.mark.parametrize("which", NOTHING)
def test_a_volume_of_nothing_is_what_is_behind_it(which, rule, tmp_path):
    path = write_blocks(tmp_path / "nothing.vdb", NOTHING[which], np.eye(4))
    out = tmp_path / "a.exr"
    behind = ("--background", "0.25,0.5,1")
    ran = volcli("render", path, "-o", out, *ROW, "--density-scale", "1e30", *behind, *rule)
    assert ran.code == 0, ran.err
    seen = {name: float(values[0, 0]) for name, values in read_exr(out)[0].items()}
    assert [seen[c] for c in "RGBA"] == [0.25, 0.5, 1.0, 1.0]
    assert (seen["transmittance.Y"], seen["optical_depth.Y"], seen["Z"]) == (1, 0, np.inf)


@pytest.mark.needs_jit
@pytest.mark.parametrize(
    "blocks, step, tau",
    [
        pytest.param([tile(4096)], 4098e-6, 4096, id="through a tile"),
        pytest.param([cube(8), cube(8, at=(10**6 - 8, 0, 0))], 1.0, 16, id="from part to part"),
        pytest.param([Block((0, 0, 0), (999, 0, 0))], 1002e-6, 1000, id="through voxels"),
    ],
)
def test_a_million_steps_add_up_to_the_optical_depth(blocks, step, tau, tmp_path):
    """In float32 a sum of as many is off by 1e-2, and a product of (1 - alpha) by 5e-2."""
    path, out = write_blocks(tmp_path / "long.vdb", blocks, np.eye(4)), tmp_path / "a.exr"
    rule = ("--step", step, "--density-scale", 1 / tau)
    ran = volcli("render", path, "-o", out, *ROW, *rule, "--quiet")
    assert ran.code == 0, ran.err
    seen = read_exr(out)[0]
    assert seen["optical_depth.Y"][0, 0] == pytest.approx(1.0, rel=1e-6)
    assert seen["transmittance.Y"][0, 0] == pytest.approx(math.exp(-1), rel=1e-6)
