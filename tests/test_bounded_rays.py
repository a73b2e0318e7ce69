"""Ray by ray, no light is farther from the truth than its certificate, and no certificate above
what was allowed.

The truth is that of `volcli.probe`, whose intervals are cut so finely that tables bend in none.
"""

from dataclasses import replace

import numpy as np
import pytest
from scenes import (
    IDENTITY,
    View,
    affine,
    medium,
    plan_for,
    random_colours,
    random_values,
    rotation,
    smooth_values,
)

import volcli.probe.walk
from volcli.bounds import scene_bounds
from volcli.probe.field import cuts
from volcli.render import PIXEL_ERROR, Scene, Source, make_integrator
from volcli.tables import ColorTable, TransferTable

ALLOWED = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5)
VIEW = View(eye=(24, 21, 30), target=(8, 8, 8), fov=30, resolution=(7, 6))
SHAPE = (17, 17, 17)
TURNED = affine(0.8 * rotation((1, 2, 3), 37.0), (1.0, 0.5, -0.5))

KINKS = ColorTable(
    np.array([0.0, 0.1, 0.35, 0.6, 0.9]),
    np.array([[0, 0, 0], [0.1, 0, 0.5], [1, 0.2, 0.1], [0.4, 1, 0], [2, 2, 1]], float),
)
AT = np.linspace(0, 1, 200)
CURVE = ColorTable(AT, np.stack([AT**3, np.sin(6 * AT) ** 2, np.exp(-AT)], axis=-1))
SHOW = TransferTable(np.array([0.2, 0.3, 0.5, 0.6]), np.array([0.0, 2.0, 1.0, 0.0]))

SMOOTH = medium(smooth_values(SHAPE))
ROUGH = medium(random_values(3, SHAPE))
ROUGH_ELSEWHERE = medium(random_values(5, SHAPE), world_from_index=TURNED)


def colours(world_from_index=IDENTITY, less=0.0):
    values = random_colours(1, SHAPE) - less
    return Source(medium(values, world_from_index=world_from_index, background=(0, 0, 0)).grid)


SCENES = {
    "a transfer function": {"density": SMOOTH, "transfer": SHOW},
    "a grid of colour": {"density": SMOOTH, "color": colours()},
    "a grid of colour, rough density": {"density": ROUGH, "color": colours()},
    "colours below 0": {"density": ROUGH, "color": colours(less=0.5)},
    "colour on another lattice": {"density": SMOOTH, "color": colours(TURNED)},
    "colour by value, with kinks": {"density": SMOOTH, "color": Source(SMOOTH.grid, KINKS)},
    "colour by value, a curve": {"density": ROUGH, "color": Source(ROUGH.grid, CURVE)},
    "emission": {"density": SMOOTH, "emission": Source(SMOOTH.grid, KINKS)},
    "emission on another lattice": {
        "density": SMOOTH,
        "color": colours(),
        "emission": Source(ROUGH_ELSEWHERE.grid, CURVE),
    },
    "a tint": {"density": SMOOTH, "color": colours(), "tint": (1.0, 0.5, 0.1)},
    "a tint that lets green pass": {
        "density": ROUGH,
        "emission": colours(),
        "tint": (1.0, 0.0, 3.0),
    },
    "all at once": {
        "density": SMOOTH,
        "color": colours(TURNED),
        "emission": Source(ROUGH_ELSEWHERE.grid, CURVE),
        "tint": (0.3, 0.5, 2.0),
        "transfer": SHOW,
    },
}


def scene_of(parts, scale, nearest=False):
    parts = {"color": (0.3, 0.2, 0.1), **parts, "density": parts["density"].grid}
    made = Scene(scale=scale, **parts)
    return replace(made, bounds=scene_bounds(made, nearest, threads=1))


def rays_of(view):
    return tuple(np.ascontiguousarray(part.reshape(-1, 3)) for part in view.rays)


def truth(scene, nearest, rays, monkeypatch, pieces=24):
    """(n, 3), (n, 3): transmittances and radiances."""

    def fine(line, t0, t1):
        t = cuts(line, t0, t1)
        share = np.linspace(0, 1, pieces, endpoint=False)
        between = t[:-1, None] + np.diff(t)[:, None] * share
        return np.append(between, t[-1])

    with monkeypatch.context() as patch:
        patch.setattr(volcli.probe.walk, "cuts", fine)
        walks = [volcli.probe.walk.walk(scene, nearest, o, d) for o, d in zip(*rays, strict=True)]
    tau = np.array([0.0 if walk is None else walk.optical_depth for walk in walks])
    light = [np.zeros(3) if walk is None else walk.light.sum(axis=0) for walk in walks]
    return np.exp(-tau[:, None] * np.array(scene.tint or (1, 1, 1))), np.array(light)


def seen(scene, nearest, rays, max_error):
    """As `truth` by the rule, with the certificates and the evaluations."""
    plan = replace(plan_for(nearest=nearest), max_error=max_error)
    traced = make_integrator(scene, plan)(*rays)
    T = np.exp(-traced.tau[:, None] * np.array(scene.tint or (1, 1, 1)))
    light = traced.radiance
    if isinstance(scene.color, tuple):
        light = light + (1 - T) * np.array(scene.color)
    return T, light, traced.error, traced.evaluated


def off_by(scene, found, true):
    """(n,): by how much transmittance, and radiance as a share of the brightest, are off."""
    T, light = (np.abs(a - b).max(axis=1) for a, b in zip(found[:2], true, strict=True))
    return np.maximum(T, light / scene.bounds.brightest)


def check(scene, nearest, rays, monkeypatch, allowed=ALLOWED):
    true = truth(scene, nearest, rays, monkeypatch)
    evaluated = [np.inf]
    for max_error in allowed:
        found = seen(scene, nearest, rays, max_error)
        certified = found[2] + PIXEL_ERROR
        assert (certified <= max_error).all()
        assert (off_by(scene, found, true) <= certified).all()
        evaluated.append(found[3])
    return evaluated[1:]


@pytest.mark.parametrize("scale", [0.1, 10.0])
@pytest.mark.parametrize("name", SCENES)
def test_no_ray_is_farther_from_the_truth_than_certified(name, scale, monkeypatch):
    scene = scene_of(SCENES[name], scale)
    evaluated = check(scene, False, rays_of(VIEW), monkeypatch)
    steps = zip(evaluated[:-1], evaluated[1:], strict=True)
    assert all(more <= 1.01 * less for more, less in steps)  # what is allowed saves work
    assert evaluated[0] < evaluated[-1]
