"""How exact the light of sources is by default, and how its estimate stands to the truth."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import reference
import test_bounded_rays as bounded
from commandline import volcli
from scenes import (
    EVERYTHING,
    Medium,
    View,
    medium,
    plan_for,
    random_colours,
    random_values,
    smooth_values,
)

from volcli.grids import open_volume
from volcli.images import read_exr
from volcli.render import PIXEL_ERROR, Scene, Source, make_integrator, render

SAMPLES = Path(__file__).parents[1] / "samples"
SHAPE = (17, 17, 17)
VIEW = View(eye=(24, 21, 30), target=(8, 8, 8), fov=30, resolution=(7, 6))
DENSITIES = {"smooth": smooth_values(SHAPE), "rough": random_values(3, SHAPE)}
COLOURS = medium(random_colours(1, SHAPE), background=(0, 0, 0))


def off_by_default(density, colour, view, scale):
    """(n,), (n,): the errors of radiance by the exact rule, and what it estimates them to be; both
    as shares of the brightest."""
    origins, directions = (np.ascontiguousarray(p.reshape(-1, 3)) for p in view.rays)
    scene = Scene(density.grid, scale, Source(colour.grid))
    traced = make_integrator(scene, plan_for(), estimate=True)(origins, directions)
    truth = reference.trace_all(origins, directions, density.lattice(), scale, colour.lattice())[1]
    brightest = colour.grid.brightest
    return np.abs(traced.radiance - truth).max(axis=1) / brightest, traced.error / brightest


@pytest.mark.parametrize("name", DENSITIES)
def test_a_grid_of_colour_is_exact_to_a_millionth_and_to_1e_4_where_it_is_very_dense(name):
    density = medium(DENSITIES[name])
    noisy = 10 if name == "rough" else 1  # is no ordinary density
    for scale, allowed in ((0.05, 1e-6), (0.5, noisy * 1e-6), (5.0, 1e-4), (50.0, 1e-4)):
        off, estimate = off_by_default(density, COLOURS, VIEW, scale)
        print(f"{name}, scale {scale}: off {off.max():.1e}, estimated {estimate.max():.1e}")
        assert off.max() < allowed
        assert (off <= estimate + 1e-15).all()


@pytest.mark.parametrize(
    ("file", "scale", "eye", "target"),
    [
        ("colored_smoke.vdb", 9.0, (0.0, 3.4, 13.0), (0.0, 3.1, 0.0)),
        ("explosion.vdb", 14.0, (0.0, 0.8, 11.0), (0.0, 0.35, 0.0)),
    ],
)
def test_so_it_is_in_files(file, scale, eye, target):
    volume = open_volume(SAMPLES / file)
    density, colour = (
        Medium(volume.read_tree(header), header.world_from_index)
        for name in ("density", "Cd")
        for header in volume.headers
        if header.name == name
    )
    view = View(eye=eye, target=target, fov=24, resolution=(6, 7))
    for denser, allowed in ((1, 1e-6), (100, 1e-4)):
        off, estimate = off_by_default(density, colour, view, denser * scale)
        print(f"{file}, {denser} x: off {off.max():.1e}, estimated {estimate.max():.1e}")
        assert off.max() < allowed
        assert (off <= estimate + 1e-15).all()


ROUGHLY = {
    "colour by value, with kinks": 0.02,
    "colour by value, a curve": 0.1,
    "emission on another lattice": 0.1,
    "a tint": 0.0,
    "a tint that lets green pass": 0.0,
}
"""Of how many rays the estimate may be too small."""


@pytest.mark.parametrize("name", ROUGHLY)
def test_an_estimate_is_seldom_below_the_error(name, monkeypatch):
    if bounded.COMPILED and name == "emission on another lattice":
        pytest.skip("another kernel to compile; runs uncompiled")
    if not bounded.COMPILED and name == "a tint that lets green pass":
        pytest.skip("too few rays, uncompiled, to see an error in")
    rays, below, ratios = bounded.rays_of(bounded.VIEW), [], []
    for scale in (0.1, 1.0, 10.0):
        scene = bounded.scene_of(bounded.SCENES[name], scale)
        traced = make_integrator(scene, plan_for(), estimate=True)(*rays)
        T = np.exp(-traced.tau[:, None] * np.array(scene.tint or (1, 1, 1)))
        light = traced.radiance
        if isinstance(scene.color, tuple):
            light = light + (1 - T) * np.array(scene.color)
        off = np.abs(light - bounded.truth(scene, False, rays, monkeypatch)[1]).max(axis=1)
        seen = off > 1e-8 * scene.bounds.brightest  # the truth is hardly better
        below.append((off > traced.error)[seen])
        ratios.append((traced.error / np.maximum(off, 1e-30))[seen])
    share, ratio = np.concatenate(below).mean(), np.median(np.concatenate(ratios))
    print(f"{name}: too small in {100 * share:.1f} %, {ratio:.1g} times the error in the middle")
    assert share <= ROUGHLY[name]


def test_a_constant_colour_is_off_by_rounding_alone():
    plan = replace(plan_for(), estimate=True)
    result = render(Scene(medium(DENSITIES["rough"]).grid, 0.5, (1, 1, 1)), plan, VIEW.camera)
    assert (result.error_estimate == np.float32(PIXEL_ERROR)).all()


def test_nothing_is_estimated_unless_it_is_asked_for():
    scene = Scene(medium(DENSITIES["rough"]).grid, 0.5, Source(COLOURS.grid))
    assert render(scene, plan_for(EVERYTHING), VIEW.camera).error_estimate is None


def test_an_estimate_changes_no_pixel_and_is_a_layer_a_map_and_a_number(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    job = ["render", str(SAMPLES / "colored_smoke.vdb"), "--color-grid", "Cd", "--size", "16x12"]
    job += ["--density-scale", "9", "--json", "-o"]
    ran = volcli(*job, "with.exr", "--maps", "error_estimate")
    assert ran.code == 0, ran.err
    assert volcli(*job, "without.exr").code == 0
    with_it, header = read_exr("with.exr")
    without, _ = read_exr("without.exr")
    layer = with_it.pop("error_estimate.Y")
    assert with_it.keys() == without.keys()
    for name, pixels in without.items():
        np.testing.assert_allclose(with_it[name], pixels, rtol=3e-7, atol=1e-9, err_msg=name)
    largest = json.loads(ran.out)["error_estimate"]
    assert largest == header["volcli:error_estimate"] == layer.max()
    assert PIXEL_ERROR < largest < 1e-4
    np.testing.assert_array_equal(read_exr("with.error_estimate.exr")[0]["Y"], layer)


@pytest.mark.parametrize(
    "rule", [("--max-error", "0.01"), ("--target-error", "0.01"), ("--step", "1")]
)
def test_an_estimate_of_another_rule_is_refused(rule, tmp_path):
    cloud = str(SAMPLES / "cloud.vdb")
    out = str(tmp_path / "a.exr")
    ran = volcli("render", cloud, "-o", out, *rule, "--maps", "error_estimate")
    assert ran.code == 2
    assert "error_estimate is of the exact rule" in ran.err
