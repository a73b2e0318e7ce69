"""`volcli compare` and `volcli recomposite`: differences are those of the pixels."""

import json

import numpy as np
import pytest
from commandline import ROOT, volcli, write_ball
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from pictures import RAMP, write_volcli_exr

from volcli import images
from volcli.srgb import srgb_from_linear

FINITE = st.floats(-4, 4, width=32)


def compared(a, b, *options):
    ran = volcli("compare", a, b, "--json", *options)
    return ran.code, json.loads(ran.out) if ran.out else None, ran.err


@given(
    a=arrays(np.float32, (5, 6), elements=FINITE),
    b=arrays(np.float32, (5, 6), elements=FINITE),
)
def test_differences_are_those_that_numpy_finds(tmp_path_factory, a, b):
    folder = tmp_path_factory.mktemp("pair")
    images.write_exr(folder / "a.exr", {"Y": a}, {})
    images.write_exr(folder / "b.exr", {"Y": b}, {})
    code, found, _ = compared(folder / "a.exr", folder / "b.exr")
    assert code == 0
    channel = found["channels"]["Y"]
    away = np.abs(b.astype(float) - a)
    assert channel["max"] == pytest.approx(away.max(), rel=1e-6)
    assert channel["mean"] == pytest.approx(away.mean(), rel=1e-6)
    assert channel["rmse"] == pytest.approx(np.sqrt((away**2).mean()), rel=1e-6)
    x, y = channel["at"]
    assert away[y, x] == away.max()
    assert (channel["a"], channel["b"]) == (a[y, x], b[y, x])
    if away.any() and channel["rmse"] > 0:
        peak = max(1.0, float(np.abs(a).max()))
        assert channel["psnr"] == pytest.approx(20 * np.log10(peak / channel["rmse"]))
    else:
        assert channel["psnr"] is None


def test_images_that_are_the_same_differ_by_nothing(tmp_path):
    path = write_volcli_exr(tmp_path / "a.exr", RAMP)
    code, found, _ = compared(path, path, "--max-error", "0", "--rmse", "0")
    assert code == 0
    assert {channel["max"] for channel in found["channels"].values()} == {0}
    assert found["flip"]["max"] == 0
    assert "same" in volcli("compare", path, path).out


@pytest.mark.parametrize(
    ("limit", "code"),
    [
        (["--max-error", "0.24"], 1),
        (["--max-error", "0.26"], 0),
        (["--rmse", "0.02"], 1),
        (["--rmse", "0.04"], 0),
        (["--max-error", "1", "--rmse", "0.02"], 1),
        ([], 0),
    ],
)
def test_limits_decide_the_exit_code(tmp_path, limit, code):
    a = np.zeros((8, 8), np.float32)
    b = a.copy()
    b[3, 5] = 0.25
    for name, values in (("a", a), ("b", b)):
        images.write_exr(tmp_path / f"{name}.exr", {"A": values}, {})
    ran = volcli("compare", tmp_path / "a.exr", tmp_path / "b.exr", *limit)
    assert ran.code == code
    assert "5,3" in ran.out
    assert bool(ran.err) == bool(code)
    assert ran.err.count("\n") == code


def test_a_pixel_that_is_finite_in_one_alone_exceeds_every_limit(tmp_path):
    a = np.ones((4, 4), np.float32)
    b = a.copy()
    b[1, 2] = np.inf
    for name, values in (("a", a), ("b", b)):
        images.write_exr(tmp_path / f"{name}.exr", {"Z": values}, {})
    code, found, err = compared(tmp_path / "a.exr", tmp_path / "b.exr", "--max-error", "100")
    assert code == 1
    assert found["channels"]["Z"]["unmatched"] == 1
    assert found["channels"]["Z"]["at"] == [2, 1]
    assert found["channels"]["Z"]["b"] == "inf"
    assert "finite in one alone" in err
    code, found, _ = compared(tmp_path / "b.exr", tmp_path / "b.exr", "--max-error", "0")
    assert code == 0


def test_channels_can_be_chosen_and_those_of_one_image_alone_are_left_out(tmp_path):
    whole = write_volcli_exr(tmp_path / "a.exr", RAMP)
    images.write_exr(tmp_path / "b.exr", dict.fromkeys("RGB", RAMP), {})
    _, found, _ = compared(whole, tmp_path / "b.exr")
    assert list(found["channels"]) == ["R", "G", "B"]
    _, found, _ = compared(whole, tmp_path / "b.exr", "--channels", "G")
    assert list(found["channels"]) == ["G"]
    ran = volcli("compare", whole, tmp_path / "b.exr", "--channels", "Z")
    assert ran.code == 2
    assert "both have R, G, B" in ran.err


def test_a_png_is_made_linear_before_it_is_compared_with_an_exr(tmp_path):
    path = write_volcli_exr(tmp_path / "a.exr", RAMP)
    channels, _ = images.read_exr(path)
    rgba = np.dstack([channels[c] for c in "RGBA"])
    images.write_png(tmp_path / "a.png", rgba, {}, bits=16)
    _, found, _ = compared(path, tmp_path / "a.png")
    assert found["encoding"] == "linear, premultiplied"
    assert max(channel["max"] for channel in found["channels"].values()) < 1e-4
    images.write_png(tmp_path / "b.png", rgba * 0.5, {}, bits=16)
    _, found, _ = compared(tmp_path / "a.png", tmp_path / "b.png")
    assert found["encoding"] == "as stored"
    assert found["channels"]["A"]["max"] == pytest.approx(rgba[..., 3].max() / 2, abs=1e-4)


def test_maps_scaled_apart_are_compared_by_their_values(tmp_path):
    images.write_map(tmp_path / "a.png", RAMP, {}, name="optical_depth")
    images.write_map(tmp_path / "b.png", RAMP * 2, {}, name="optical_depth")
    images.write_map(tmp_path / "c.exr", RAMP, {}, name="optical_depth")
    _, found, _ = compared(tmp_path / "a.png", tmp_path / "b.png")
    assert found["channels"]["optical_depth"]["max"] == pytest.approx(3, abs=1e-3)
    _, found, _ = compared(tmp_path / "a.png", tmp_path / "c.exr")
    assert found["channels"]["optical_depth"]["max"] < 1e-4


def test_images_over_different_backgrounds_are_the_same_before_one(tmp_path):
    a = write_volcli_exr(tmp_path / "a.exr", RAMP, behind=(0.2, 0.4, 0.7))
    b = write_volcli_exr(tmp_path / "b.exr", RAMP, behind=(0.9, 0.1, 0.0))
    assert compared(a, b, "--channels", "R", "--max-error", "0.1")[0] == 1
    for background in ("transparent", "0,0,0", "1,2,3", str(ROOT / "docs/gallery/cloud.png")):
        code, found, err = compared(a, b, "--background", background, "--max-error", "1e-6")
        assert code == 0, err
        assert found["encoding"] == "before one background"


def test_flip_is_that_of_its_authors_between_black_and_white_and_grows_with_the_difference(
    tmp_path,
):
    grey = {n: np.full((64, 64), v, np.float32) for n, v in (("k", 0), ("g", 0.2), ("w", 1))}
    for name, values in grey.items():
        images.write_exr(tmp_path / f"{name}.exr", dict.fromkeys("RGB", values), {})
    near, far = (
        compared(tmp_path / "k.exr", tmp_path / f"{n}.exr")[1]["flip"]["mean"] for n in "gw"
    )
    assert far == pytest.approx(0.9674, abs=1e-3)  # as flip-evaluator 1.7 finds
    assert 0 < near < far


@pytest.mark.parametrize("kind", ["exr", "png", "svg"])
def test_the_difference_is_written(tmp_path, kind):
    a = write_volcli_exr(tmp_path / "a.exr", RAMP)
    b = write_volcli_exr(tmp_path / "b.exr", RAMP * 1.01)
    out = tmp_path / f"d.{kind}"
    ran = volcli("compare", a, b, "--difference", out)
    assert ran.code == 0, ran.err
    assert out.stat().st_size > 0
    if kind == "exr":
        found, _ = images.read_exr(out)
        np.testing.assert_allclose(found["optical_depth.Y"], RAMP * 0.01, atol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        ("a.exr gone.exr", 2, "gone.exr: no such file"),
        ("a.exr small.exr", 2, "compare images of one size"),
        ("a.exr other.exr", 2, "share no channel"),
        ("a.exr a.exr --background 1,2", 2, "--background 1,2"),
        ("a.exr a.exr --background -1,0,0", 2, "at least 0"),
        ("a.exr a.exr --background gone.png", 2, "gone.png: no such file"),
        ("a.exr a.exr --difference d.gif", 2, "unknown extension"),
        ("a.exr a.exr --max-error -1", 2, "--max-error"),
    ],
)
def test_a_mistake_of_compare_is_one_line(tmp_path, monkeypatch, arguments, code, message):
    monkeypatch.chdir(tmp_path)
    write_volcli_exr("a.exr", RAMP)
    write_volcli_exr("small.exr", RAMP[:4])
    images.write_exr("other.exr", {"velocity.X": RAMP}, {})
    ran = volcli("compare", *arguments.split())
    assert (ran.code, ran.out) == (code, "")
    assert message in ran.err
    assert ran.err.count("\n") == 1


# -- recomposite ----------------------------------------------------------------------------------


@pytest.mark.needs_jit
@pytest.mark.parametrize("first", ["transparent", "0.2,0.4,0.7", "IMAGE"])
@pytest.mark.parametrize("second", ["transparent", "0.9,0.1,0", "IMAGE"])
def test_another_background_gives_what_a_render_over_it_gives(tmp_path, first, second):
    image = ROOT / "docs/gallery/explosion.png"
    first, second = (image if b == "IMAGE" else b for b in (first, second))
    write_ball(tmp_path / "ball.npz")
    scene = [tmp_path / "ball.npz", "--size", "40x30", "--color-grid", "Cd"]
    for out, background in (("a", first), ("wanted", second)):
        volcli("render", *scene, "-o", tmp_path / f"{out}.exr", "--background", background)
    ran = volcli("recomposite", tmp_path / "a.exr", "--background", second,
                 "-o", tmp_path / "b.exr")  # fmt: skip
    assert ran.code == 0, ran.err
    code, _, err = compared(tmp_path / "wanted.exr", tmp_path / "b.exr", "--max-error", "1e-6")
    assert code == 0, err
    # And again, from what was written.
    volcli("recomposite", tmp_path / "b.exr", "--background", first, "-o", tmp_path / "c.exr")
    code, _, err = compared(tmp_path / "a.exr", tmp_path / "c.exr", "--max-error", "1e-6")
    assert code == 0, err


def test_recomposite_writes_a_png(tmp_path):
    path = write_volcli_exr(tmp_path / "a.exr", RAMP)
    out = tmp_path / "b.png"
    ran = volcli("recomposite", path, "--background", "0,0,1", "-o", out, "--bits", "16")
    assert ran.code == 0, ran.err
    light = -np.expm1(-RAMP)[..., None] * [0.5, 0.25, 1] + np.exp(-RAMP)[..., None] * [0, 0, 1]
    found = images.read_channels(out)
    for i, c in enumerate("RGB"):
        np.testing.assert_allclose(found.planes[c], srgb_from_linear(light[..., i]), atol=2e-5)


def test_an_image_with_alpha_alone_can_be_put_before_a_background(tmp_path):
    rgba = np.dstack([RAMP * 0.1, RAMP * 0.2, RAMP * 0.3, RAMP / 3])
    images.write_exr(tmp_path / "a.exr", {c: rgba[..., i] for i, c in enumerate("RGBA")}, {})
    volcli("recomposite", tmp_path / "a.exr", "--background", "1,1,1", "-o", tmp_path / "b.exr")
    found, _ = images.read_exr(tmp_path / "b.exr")
    np.testing.assert_allclose(found["R"], RAMP * 0.1 + (1 - RAMP / 3), atol=1e-6)
    volcli("recomposite", tmp_path / "b.exr", "--background", "transparent", "-o",
           tmp_path / "c.exr")  # fmt: skip
    found, _ = images.read_exr(tmp_path / "c.exr")
    np.testing.assert_allclose(found["R"], RAMP * 0.1, atol=1e-6)
    np.testing.assert_allclose(found["A"], RAMP / 3, atol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        ("a.exr -o b.exr", 2, "--background"),
        ("a.exr --background 1,1,1", 2, "-o"),
        ("gone.exr --background 1,1,1 -o b.exr", 2, "no such file"),
        ("opaque.png --background 1,1,1 -o b.exr", 2, "has no alpha"),
        ("a.exr --background 1,1,1 -o b.jpg", 2, "unknown image format"),
        ("a.exr --background 1,1,1 -o a.exr --no-overwrite", 4, "already exists"),
        ("lost.exr --background 1,1,1 -o b.exr", 2, "was rendered over /nowhere/sky.png"),
    ],
)
def test_a_mistake_of_recomposite_is_one_line(tmp_path, monkeypatch, arguments, code, message):
    monkeypatch.chdir(tmp_path)
    write_volcli_exr("a.exr", RAMP)
    images.write_png("opaque.png", np.ones((4, 4, 4)), {})
    header = {"volcli:job": '[background]\nimage = "/nowhere/sky.png"\n'}
    write_volcli_exr("lost.exr", RAMP, header=header)
    ran = volcli("recomposite", *arguments.split())
    assert (ran.code, ran.out) == (code, "")
    assert message in ran.err
    assert ran.err.count("\n") == 1
    assert not (tmp_path / "b.exr").exists()
