"""Packets that see colour give the numbers of rays one by one, on every kind of grid."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import scenes
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import TRANSFORMS, Medium, joined, medium, plan_for, tree_of
from test_packets import random_rays

from volcli.kernels import integrator, packets
from volcli.kernels.lanes import LANES
from volcli.kernels.packet_light import light_buffer
from volcli.render import Scene, Source, make_integrator
from volcli.tables import ColorTable

pytestmark = [
    pytest.mark.needs_jit,
    pytest.mark.skipif(LANES == 1, reason="no registers of four numbers here: no packets"),
]

DEPTH = frozenset({"picture", "transmittance", "depth"})
FLAT = frozenset({"picture", "transmittance"})
FADED_TWICE = 2.0**-23
"""What a rule may leave away of a ray's brightest channel, and another need not (`light.faded`)."""

RAMP = ColorTable(np.array([0.0, 1.0]), np.array([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]]))


def both(scene, monkeypatch, layers=DEPTH, nearest=False):
    """(packets, ray by ray) for a scene; it is one that packets take."""
    plan = plan_for(layers, nearest=nearest)
    made, taken = integrator.make_integrator, []

    def noted():
        taken.append(True)
        return light_buffer()

    with monkeypatch.context() as patch:
        patch.setattr(packets, "light_buffer", noted)
        together = make_integrator(scene, plan)
        together(np.empty((0, 3)), np.empty((0, 3)))
        assert taken, "packets were not taken"
        patch.setattr(integrator, "make_integrator", partial(made, packets=False))
        return together, make_integrator(scene, plan)


def assert_same(scene, monkeypatch, layers=DEPTH, nearest=False, rays=None):
    together, single = both(scene, monkeypatch, layers, nearest)
    rays = random_rays(scene.density, 201) if rays is None else rays
    ours, theirs = together(*rays), single(*rays)
    assert theirs.radiance.max() > 0, "no ray sees anything"
    bright = np.abs(theirs.radiance).max(axis=1, keepdims=True)
    np.testing.assert_allclose(ours.tau, theirs.tau, rtol=1e-13, atol=1e-13 * theirs.tau.max())
    off = np.abs(ours.radiance - theirs.radiance)
    assert (off <= FADED_TWICE * bright).all()
    assert ours.evaluated == theirs.evaluated
    if "depth" in layers:
        np.testing.assert_array_equal(np.isinf(ours.distance), np.isinf(theirs.distance))
        np.testing.assert_allclose(ours.distance, theirs.distance, rtol=1e-7)


def noise(shape=(19, 30, 25), origin=(-7, 3, -12), m=None):
    m = scenes.IDENTITY if m is None else m
    return (
        medium(scenes.random_values(3, shape), origin, m),
        medium(scenes.random_colours(4, shape), origin, m),
    )


@pytest.mark.parametrize("scale", [1e-6, 0.3, 30.0, 1e6])
@pytest.mark.parametrize("nearest", [False, True])
@pytest.mark.parametrize("layers", [DEPTH, FLAT], ids=["depth", "no depth"])
def test_a_colour_grid_on_the_lattice_of_the_density(layers, nearest, scale, monkeypatch):
    density, colour = noise(m=TRANSFORMS["all at once"])
    scene = Scene(density.grid, scale, Source(colour.grid, scale=2.5))
    assert_same(scene, monkeypatch, layers, nearest)


@pytest.mark.parametrize("origin", [(1, -5, 3), (-4100, 0, 0), (8, 8, 8)])
def test_a_colour_grid_that_covers_other_bricks(origin, monkeypatch):
    density, _ = noise()
    colour = medium(scenes.random_colours(4, (30, 30, 30)), origin, background=0.5)
    assert_same(Scene(density.grid, 0.3, Source(colour.grid)), monkeypatch)


def test_tiles_of_either_grid(monkeypatch):
    density = Medium(
        joined(
            tree_of(scenes.random_values(5, (16, 9, 8)), (-8, 0, 4090)),
            tree_of(np.ones((1, 1, 1)), (0, 0, 0), tiles=[((128, 0, 0), 128, 0.5, True)]),
            tree_of(np.ones((1, 1, 1)), (16, 0, 0), tiles=[((256, 128, 0), 128, 0.25, True)]),
        )
    ).grid
    colour = Medium(
        joined(
            tree_of(scenes.random_colours(6, (20, 20, 20)), (120, 60, 60)),
            tree_of(
                scenes.random_colours(7, (8, 8, 8)),
                (0, 0, 0),
                tiles=[((256, 128, 0), 128, (1, 2, 3), True), ((128, 8, 8), 8, (3, 2, 1), True)],
            ),
        )
    ).grid
    scene = Scene(density, 1e-2, Source(colour))
    assert len(density.arrays.constants) == 3
    rng = np.random.default_rng(2)
    targets = rng.uniform((120, 0, 0), (390, 260, 130), (300, 3))
    directions = rng.normal(size=(300, 3))
    directions[:30] = np.eye(3)[rng.integers(0, 3, 30)] * rng.choice([-1.0, 1.0], (30, 1))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    assert_same(scene, monkeypatch, rays=(targets - 700 * directions, directions))


def test_what_is_bright_behind_what_is_dark_and_thick_is_seen(monkeypatch):
    depth = 80  # 40 bricks of optical depth 8 each, the first 30 of them black
    values = np.ones((8, 8, 8 * depth // 2), np.float32)
    colours = np.zeros((*values.shape, 3), np.float32)
    colours[..., 240:, :] = (1.0, 2.0, 3e9)
    scene = Scene(medium(values).grid, 1.0, Source(medium(colours).grid))
    rays = (np.array([[4.2, 3.7, -5.0]]), np.array([[0.0, 0.0, 1.0]]))
    together, single = both(scene, monkeypatch)
    ours, theirs = together(*rays), single(*rays)
    assert 0 < theirs.radiance.max() < 1e-80
    np.testing.assert_allclose(ours.radiance, theirs.radiance, rtol=1e-6)


def test_a_ray_with_colour_does_not_depend_on_its_packet(monkeypatch):
    density, colour = noise()
    together, _ = both(Scene(density.grid, 0.5, Source(colour.grid)), monkeypatch)
    origins, directions = random_rays(density.grid, 200)
    whole = together(origins, directions)
    order = np.random.default_rng(0).permutation(len(origins))
    for some in (order, order[:77], order[100:101]):
        again = together(origins[some], directions[some])
        np.testing.assert_array_equal(again.radiance, whole.radiance[some])
        np.testing.assert_array_equal(again.distance, whole.distance[some])


@pytest.mark.parametrize("change", ["another lattice", "tint", "table", "step"])
def test_what_packets_cannot_see_goes_ray_by_ray(change, monkeypatch):
    density, colour = noise()
    scene, plan = Scene(density.grid, 0.5, Source(colour.grid)), plan_for(DEPTH)
    if change == "another lattice":
        other = medium(scenes.random_colours(4, (9, 9, 9)), (0, 0, 0), TRANSFORMS["rotated"])
        scene = replace(scene, color=Source(other.grid))
    elif change == "tint":
        scene = replace(scene, tint=(0.5, 1.0, 2.0))
    elif change == "table":
        scene = replace(scene, color=Source(density.grid, RAMP))
    elif change == "step":
        plan = plan_for(DEPTH, step=0.5)
    monkeypatch.setattr(packets, "light_buffer", lambda: 1 / 0)
    make_integrator(scene, plan)(*random_rays(density.grid, 3))


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000), scale=st.floats(-5, 5).map(lambda x: 10.0**x))
def test_whatever_the_field_and_the_extinction(seed, scale):
    shape = (11, 17, 9)
    values = np.maximum(scenes.random_values(seed, shape) - 0.5, 0)
    density, colour = medium(values), medium(scenes.random_colours(seed + 1, shape))
    with pytest.MonkeyPatch.context() as patch:
        assert_same(
            Scene(density.grid, scale, Source(colour.grid)),
            patch,
            rays=random_rays(density.grid, 31, seed),
        )
