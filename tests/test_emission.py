"""Light of its own, colour by value, transfer functions and tints: closed forms, and a fine march.

The march samples every field at a great many points of a ray, and knows nothing of cells.
"""

import numpy as np
import pytest
import reference
from commandline import volcli
from scenes import (
    IDENTITY,
    SHEAR,
    View,
    affine,
    medium,
    plan_for,
    rotation,
    smooth_values,
)

from volcli.errors import UsageError
from volcli.images import read_exr
from volcli.render import Scene, Source, render
from volcli.tables import ColorTable, TransferTable

VIEW = View(eye=(14, 11, 20), target=(4, 4, 4), fov=30, resolution=(5, 4))
RAMP = ColorTable(
    np.array([0.0, 0.1, 0.35, 0.6, 0.9]),  # black outside: a march is off where light begins
    np.array([[0, 0, 0], [0.1, 0, 0.5], [1, 0.2, 0.1], [0.4, 1, 0], [2, 2, 1]], float),
)
SHOW = TransferTable(np.array([0.2, 0.3, 0.5, 0.6]), np.array([0.0, 2.0, 1.0, 0.0]))
LINE = ColorTable(np.array([0.0, 2.0]), np.array([[0, 0, 0], [2, 1, 0.5]], float))

DENSITY = medium(smooth_values((9, 9, 9)))
OTHER = {
    "the same lattice": IDENTITY,
    "finer": affine(0.37 * np.eye(3), (0.4, 0.2, 0.3)),
    "coarser": affine(2.1 * np.eye(3), (-4.0, -5.0, -3.3)),
    "shifted": affine(np.eye(3), (0.5, -0.25, 1.75)),
    "rotated": affine(0.8 * rotation((1, 2, 3), 37.0), (1.0, 0.5, -0.5)),
    "sheared": affine(0.9 * SHEAR, (0.0, 0.7, 0.2)),
    "aside": affine(np.eye(3), (7.0, 0.0, 0.0)),
}


def scalar(world_from_index=IDENTITY, seed=3):
    """A rough field between -0.2 and 0.9 on a lattice, 0 outside."""
    values = np.random.default_rng(seed).uniform(-0.2, 0.9, (9, 9, 9)).astype(np.float32)
    return medium(values, world_from_index=world_from_index)


def vectors(world_from_index=IDENTITY, seed=4):
    values = np.random.default_rng(seed).random((9, 9, 9, 3)).astype(np.float32)
    return medium(values, world_from_index=world_from_index, background=(0, 0, 0))


class Field:
    """A source, or what a march sees of it."""

    def __init__(self, of, table=None, scale=1.0):
        self.of, self.table, self.scale = of, table, scale

    @property
    def source(self):
        return Source(self.of.grid, self.table, self.scale)

    def at(self, points, cut):
        found = self.scale * reference.sample(points, self.of.lattice())
        if self.table is not None:
            found = self.table.at(found)
        return found * inside(points, self.of)[:, None] if cut else found


def inside(points, of):
    lattice = of.lattice()
    m = np.linalg.inv(lattice.world_from_index)
    p = points @ m[:3, :3].T + m[:3, 3]
    return ((p >= lattice.box[0] - 1) & (p <= lattice.box[1] + 1)).all(axis=1)


def march(scene, steps=8_000):
    """(tau, radiance) of the view's rays, each in ``steps`` steps."""
    origins, directions = VIEW.rays
    shape = origins.shape[:2]
    taus, lights = [], []
    for o, d in zip(origins.reshape(-1, 3), directions.reshape(-1, 3), strict=True):
        middle = float((np.array([4.0, 4, 4]) - o) @ d)
        ends = np.linspace(middle - 24, middle + 24, steps + 1)
        points = o + (ends[:-1, None] + np.diff(ends)[:, None] / 2) * d
        step = np.diff(ends)
        value = reference.sample(points, DENSITY.lattice())
        value = SHOW.at(value) if scene["transfer"] else np.maximum(value, 0)
        part = scene["scale"] * value * inside(points, DENSITY) * step
        tint = np.array(scene["tint"] or (1, 1, 1))
        before = np.cumsum(part) - part
        T = np.exp(-before[:, None] * tint)
        light = np.zeros(3)
        color, emission = scene["color"], scene["emission"]
        c = color.at(points, cut=False) if isinstance(color, Field) else np.array(color)
        light = light + (T * -np.expm1(-part[:, None] * tint) * c).sum(axis=0)
        if emission is not None:
            half = np.exp(-(before + part / 2)[:, None] * tint)
            light = light + (half * emission.at(points, cut=True) * step[:, None]).sum(axis=0)
        taus.append(part.sum())
        lights.append(light)
    return np.reshape(taus, shape), np.reshape(lights, (*shape, 3))


def shoot(step=None, **scene):
    color, emission = scene["color"], scene["emission"]
    made = Scene(
        DENSITY.grid,
        scene["scale"],
        color.source if isinstance(color, Field) else color,
        None if emission is None else emission.source,
        scene["tint"],
        SHOW if scene["transfer"] else None,
    )
    return render(made, plan_for(step=step), VIEW.camera, threads=1)


def checked(tolerance, **scene):
    scene = {
        "scale": 0.6,
        "color": (0.3, 0.2, 0.1),
        "emission": None,
        "tint": None,
        "transfer": False,
        **scene,
    }
    tau, light = march(scene)
    seen = shoot(**scene)
    first = seen.optical_depth if scene["tint"] is None else seen.optical_depth[..., 0]
    factor = 1.0 if scene["tint"] is None else scene["tint"][0]
    np.testing.assert_allclose(first, factor * tau, rtol=1e-5, atol=1e-6)
    assert np.abs(seen.radiance - light).max() < tolerance * np.abs(light).max()


@pytest.mark.parametrize("lattice", OTHER)
@pytest.mark.parametrize("kind", ["ramp", "vectors"])
def test_emission_on_any_lattice_is_that_of_a_fine_march(lattice, kind):
    of = Field(scalar(OTHER[lattice]), RAMP) if kind == "ramp" else Field(vectors(OTHER[lattice]))
    checked(2e-4, emission=of)


@pytest.mark.parametrize("lattice", OTHER)
def test_a_ramp_of_colour_on_any_lattice_is_that_of_a_fine_march(lattice):
    checked(2e-4, color=Field(scalar(OTHER[lattice]), RAMP))


@pytest.mark.parametrize("lattice", ["the same lattice", "rotated"])
def test_everything_at_once_is_that_of_a_fine_march(lattice):
    checked(
        1e-3,
        color=Field(scalar(OTHER[lattice]), RAMP),
        emission=Field(vectors(OTHER["shifted"]), scale=0.2),
        tint=(1.0, 0.4, 0.0),
        transfer=True,
    )


def test_a_transfer_function_is_that_of_a_fine_march():
    checked(1e-5, transfer=True)


def test_a_strength_is_a_factor_of_a_vec3_grid():
    checked(2e-4, color=Field(vectors(), scale=3.0), emission=Field(vectors(seed=5), scale=0.5))


@pytest.mark.parametrize("tint", [(1.0, 0.5, 0.25), (0.0, 1.0, 2.0)])
def test_a_tint_of_sources_is_that_of_a_fine_march(tint):
    checked(2e-4, color=Field(vectors()), emission=Field(scalar(), LINE), tint=tint)


# -- closed forms ---------------------------------------------------------------------------------


@pytest.mark.parametrize("scale", [1e-30, 1e-12, 1e-6, 1e-3, 0.1, 1.0, 10.0, 100.0, 1e3, 1e4])
def test_grey_emission_in_proportion_to_density_is_e_over_sigma_times_opacity(scale):
    """C = e (1 - T) / sigma, which becomes e L as sigma goes to 0.

    In cells of an optical depth of tens the four nodes are off by more than rounding.
    """
    tolerance = 1e-6 if scale <= 10 else 1e-5 if scale <= 100 else 1e-4
    scene = Scene(DENSITY.grid, scale, (0.0, 0.0, 0.0), Source(DENSITY.grid, LINE))
    seen = render(scene, plan_for(), VIEW.camera, threads=1)
    unit = render(Scene(DENSITY.grid, 1.0, (0.0,) * 3), plan_for(), VIEW.camera, threads=1)
    length = unit.optical_depth.astype(np.float64)
    expected = -np.expm1(-scale * length) / scale
    hit = length > 0
    for c, e in enumerate((1, 0.5, 0.25)):
        np.testing.assert_allclose(seen.radiance[hit, c], e * expected[hit], rtol=tolerance)
    assert (seen.radiance[~hit] == 0).all()


@pytest.mark.parametrize("step", [None, 0.5])
@pytest.mark.parametrize("sigma", [0.0, 1e-30, 1e-15, 1e-9, 1e-4, 0.1, 1.0, 20.0, 300.0])
def test_grey_emission_of_a_homogeneous_slab_is_its_closed_form(sigma, step):
    """C = e (1 - T) / sigma, and e L without density: no cancellation on the way there."""
    slab = medium(np.ones((9, 9, 9)), background=1.0)
    glow = medium(np.full((9, 9, 9, 3), 0.25), background=(0.25, 0.25, 0.25))
    scene = Scene(slab.grid, sigma, (0.0, 0.0, 0.0), Source(glow.grid))
    view = View((4, 4, 40), (4, 4, 4), width=6.0, resolution=(4, 4))
    seen = render(scene, plan_for(step=step), view.camera, threads=1)
    length = 10.0  # the active box is 8 wide, and reaches a voxel further to each side
    expected = 0.25 * (length if sigma == 0 else -np.expm1(-sigma * length) / sigma)
    np.testing.assert_allclose(seen.radiance, expected, rtol=1e-6)


def test_emission_without_any_density_is_its_integral():
    empty = medium(np.zeros((9, 9, 9)))
    assert empty.grid.arrays.atlas.max(initial=0) == 0
    scene = Scene(empty.grid, 1.0, (1.0, 1.0, 1.0), Source(DENSITY.grid, LINE))
    seen = render(scene, plan_for(), VIEW.camera, threads=1)
    unit = render(Scene(DENSITY.grid, 1.0, (0.0,) * 3), plan_for(), VIEW.camera, threads=1)
    np.testing.assert_allclose(seen.radiance[..., 0], unit.optical_depth, rtol=1e-6)
    assert (seen.opacity == 0).all()
    assert np.isposinf(seen.depth).all()


def test_emission_changes_nothing_but_light():
    dark = Scene(DENSITY.grid, 0.7, (0.1, 0.2, 0.3))
    lit = Scene(DENSITY.grid, 0.7, (0.1, 0.2, 0.3), Source(scalar().grid, RAMP))
    seen = [render(scene, plan_for(), VIEW.camera, threads=1) for scene in (dark, lit)]
    np.testing.assert_array_equal(seen[0].optical_depth, seen[1].optical_depth)
    np.testing.assert_allclose(seen[0].depth, seen[1].depth, rtol=1e-6)
    assert (seen[1].radiance > seen[0].radiance).any()


def test_steps_are_counted_to_the_end_of_what_emits():
    far = medium(np.ones((9, 9, 9, 3)), world_from_index=affine(np.eye(3), (4e7, 0.0, 0.0)))
    scene = Scene(DENSITY.grid, 1.0, (1.0, 1.0, 1.0), Source(far.grid))
    with pytest.raises(UsageError, match=r"--step 1: up to 4e\+07 samples a ray"):
        render(scene, plan_for(step=1.0), VIEW.camera)


# -- from the command line ------------------------------------------------------------------------


@pytest.fixture
def fire(tmp_path, monkeypatch):
    """Smoke on the left, and a flame on the right of it."""
    axes = np.indices((24, 9, 9)) - 4.0
    away = np.sqrt((axes**2).sum(axis=0))
    aside = np.sqrt(((axes - np.array([14, 0, 0]).reshape(3, 1, 1, 1)) ** 2).sum(axis=0))
    np.savez(
        tmp_path / "fire.npz",
        density=np.clip(1 - away / 3.5, 0, None).astype(np.float32),
        flame=np.clip(1 - aside / 3.5, 0, None).astype(np.float32),
    )
    monkeypatch.chdir(tmp_path)
    return tmp_path


FLAME = ("--set", "emission.grid=flame", "--set", "emission.constant=[1, 0.4, 0.1]")


def test_fire_without_smoke_shows_and_is_kept_in_an_exr(fire):
    ran = volcli("render", "fire.npz", "-o", "a.exr", "--size", "48x24", *FLAME)
    assert ran.code == 0, ran.err
    channels, _ = read_exr(fire / "a.exr")
    alone = (channels["A"] == 0) & (channels["R"] > 0.5)
    assert alone.sum() > 20, "light where opacity is 0"
    np.testing.assert_allclose(channels["G"][alone], 0.4 * channels["R"][alone], rtol=1e-5)
    both = channels["A"] > 0.5
    assert both.any() and np.argwhere(both)[:, 1].max() < np.argwhere(alone)[:, 1].min()


def test_a_png_says_how_much_fire_it_lost_unless_there_is_a_background(fire):
    ran = volcli("render", "fire.npz", "-o", "a.png", "--size", "48x24", *FLAME)
    assert ran.code == 0
    lines = [line for line in ran.err.splitlines() if "where opacity is 0" in line]
    assert len(lines) == 1
    assert "% of the picture's light)" in lines[0]
    flags = ("--background", "0,0,0", "--set", "emission.strength=0.2")
    ran = volcli("render", "fire.npz", "-o", "a.png", "--size", "48x24", *FLAME, *flags)
    assert "opacity is 0" not in ran.err


def test_emission_alone_renders_without_a_density(fire):
    both = volcli("render", "fire.npz", "-o", "a.exr", "--size", "48x24", *FLAME)
    flags = ("--set", "density.scale=0", *both.err.split(": ", 2)[2].split())
    ran = volcli("render", "fire.npz", "-o", "b.exr", "--size", "48x24", *FLAME, *flags)
    assert ran.code == 0, ran.err
    with_smoke, alone = (read_exr(fire / name)[0] for name in ("a.exr", "b.exr"))
    assert alone["A"].max() == 0
    flame = (with_smoke["A"] == 0) & (with_smoke["R"] > 0.5)
    np.testing.assert_allclose(alone["R"][flame], with_smoke["R"][flame], rtol=1e-4)
