"""Coloured extinction: each channel is the picture of its own extinction; and what maps become."""

import numpy as np
import pytest
from commandline import SAMPLES, volcli, write_ball
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import View, medium, plan_for, smooth_values

from volcli.images import read_exr
from volcli.render import Scene, over, render

TINT = (1.0, 0.5, 0.0)
COLOUR = (0.8, 0.6, 0.4)
BLOB = medium(smooth_values((9, 9, 9)))
VIEW = View(eye=(4, 4, 20), target=(4, 4, 4), fov=35, resolution=(12, 9))


def shoot(scale, tint=None, **plan):
    scene = Scene(BLOB.grid, scale, COLOUR, tint=tint)
    return render(scene, plan_for(**plan), VIEW.camera, threads=1)


@pytest.mark.parametrize("step", [None, 0.5])
def test_each_channel_is_the_picture_of_its_own_extinction(step):
    tinted = shoot(0.7, TINT, step=step)
    for c, factor in enumerate(TINT):
        alone = shoot(0.7 * factor, step=step)
        for name in ("optical_depth", "transmittance", "opacity", "radiance"):
            found, expected = getattr(tinted, name)[..., c], getattr(alone, name)
            expected = expected[..., c] if name == "radiance" else expected
            np.testing.assert_allclose(found, expected, rtol=2e-6, atol=1e-7, err_msg=name)


def test_alpha_is_1_minus_the_mean_transmittance():
    tinted = shoot(0.7, TINT)
    assert tinted.transmittance.shape == (9, 12, 3)
    expected = 1 - tinted.transmittance.astype(np.float64).mean(axis=-1)
    np.testing.assert_allclose(tinted.alpha, expected, atol=1e-7)


def test_opacity_under_a_tint_is_right_where_it_is_tiny():
    tinted = shoot(1e-9, TINT)
    np.testing.assert_allclose(
        tinted.opacity[..., 1], 0.5 * tinted.opacity[..., 0], rtol=1e-6, atol=0
    )
    assert tinted.opacity[..., 0].max() > 0


def test_a_tint_of_1_changes_nothing():
    plain, tinted = shoot(0.7), shoot(0.7, (1.0, 1.0, 1.0))
    np.testing.assert_array_equal(tinted.radiance, plain.radiance)
    np.testing.assert_array_equal(tinted.depth, plain.depth)
    np.testing.assert_array_equal(tinted.alpha, plain.alpha)
    for c in range(3):
        np.testing.assert_array_equal(tinted.transmittance[..., c], plain.transmittance)


@given(st.tuples(*[st.floats(0, 2)] * 3).filter(any))
@settings(max_examples=20, deadline=None)
def test_a_background_shines_through_each_channel_by_its_own_transmittance(tint):
    result = shoot(0.7, tint)
    picture = over(result, np.array([0.2, 0.4, 0.6, 1.0], np.float32))
    behind = result.transmittance * np.float32([0.2, 0.4, 0.6])
    np.testing.assert_allclose(picture[..., :3], result.radiance + behind, atol=1e-6)
    np.testing.assert_allclose(picture[..., 3], 1, atol=2e-7)


@pytest.mark.needs_jit
def test_the_layers_of_an_exr_are_by_channel(tmp_path):
    out = tmp_path / "a.exr"
    ran = volcli(
        *("render", SAMPLES / "rotated.vdb", "-o", out, "--size", "32x24", "--density-scale", "5"),
        *("--set", "density.tint=[1, 0.5, 0]", "--maps", "transmittance,opacity,optical_depth"),
    )
    assert ran.code == 0, ran.err
    channels, _ = read_exr(out)
    layers = [f"{layer}.{c}" for layer in ("optical_depth", "transmittance") for c in "BGR"]
    assert sorted(channels) == sorted([*"RGBAZ", *layers])
    T = np.stack([channels[f"transmittance.{c}"] for c in "RGB"], axis=-1)
    assert T[..., 2].min() == 1
    np.testing.assert_allclose(channels["A"], 1 - T.mean(axis=-1), atol=1e-6)
    for name, values in (("transmittance", T), ("opacity", 1 - T)):
        written, _ = read_exr(tmp_path / f"a.{name}.exr")
        assert sorted(written) == ["B", "G", "R"]
        for i, c in enumerate("RGB"):
            np.testing.assert_allclose(written[c], values[..., i], atol=1e-6)


def test_the_maps_of_a_png_are_in_colour(tmp_path, monkeypatch):
    import OpenImageIO as oiio

    monkeypatch.chdir(tmp_path)
    write_ball(tmp_path / "ball.npz")
    ran = volcli(
        *("render", "ball.npz", "-o", "a.png", "--size", "16x12", "--maps"),
        *("transmittance,optical_depth", "--set", "density.tint=[1, 0.5, 0]"),
    )
    assert ran.code == 0, ran.err
    for name, blue in (("transmittance", 1.0), ("optical_depth", 0.0)):
        pixels = oiio.ImageBuf(f"a.{name}.png").get_pixels(oiio.FLOAT)
        assert pixels.shape == (12, 16, 3)
        assert (pixels[..., 2] == blue).all()
        assert (pixels[6, 8, 0] - pixels[6, 8, 1]) * (1 - 2 * blue) > 0
