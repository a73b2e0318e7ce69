"""Maps, statistics and findings: each number is what NumPy makes of the pixels directly."""

import json
import subprocess
import sys

import numpy as np
import pytest
from commandline import SAMPLES, volcli, write_ball
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from pictures import RAMP, write_volcli_exr

from volcli import images
from volcli.errors import UsageError
from volcli.opacity.findings import better_scale, findings
from volcli.opacity.maps import read_maps
from volcli.opacity.statistics import PERCENTILES, statistics

pytestmark = pytest.mark.filterwarnings("error")


def numbers_of(path):
    found = statistics(read_maps(path))
    found["findings"] = findings(found)
    return json.loads(json.dumps(found, allow_nan=False))


def kinds(path):
    return [found["kind"] for found in numbers_of(path)["findings"]]


# -- maps -----------------------------------------------------------------------------------------


def test_an_exr_of_volcli_tells_opacity_transmittance_optical_depth_and_depth(tmp_path):
    maps = read_maps(write_volcli_exr(tmp_path / "a.exr", RAMP))
    np.testing.assert_allclose(maps.opacity, -np.expm1(-RAMP), rtol=1e-6)
    np.testing.assert_allclose(maps.transmittance, np.exp(-RAMP), rtol=1e-6)
    np.testing.assert_allclose(maps.optical_depth, RAMP, rtol=1e-6)
    assert maps.depth[0, 0] == np.inf
    assert (maps.depth[1:] == 5).all()


def test_before_a_background_opacity_is_that_of_the_volume_even_where_it_is_thin(tmp_path):
    maps = read_maps(write_volcli_exr(tmp_path / "a.exr", RAMP * 1e-9, behind=(0.2, 0.4, 0.7)))
    assert (images.read_exr(tmp_path / "a.exr")[0]["A"] > 0.999).all()
    np.testing.assert_allclose(maps.opacity, -np.expm1(-RAMP * 1e-9), rtol=1e-6)


def test_alpha_alone_tells_transmittance_and_optical_depth(tmp_path):
    alpha = np.array([[0, 0.25, 0.75, 1]], np.float32)
    images.write_exr(tmp_path / "a.exr", dict.fromkeys("RGBA", alpha), {})
    maps = read_maps(tmp_path / "a.exr")
    np.testing.assert_allclose(maps.transmittance, 1 - alpha)
    np.testing.assert_allclose(maps.optical_depth[0, :3], -np.log(1 - alpha[0, :3]), rtol=1e-6)
    assert maps.optical_depth[0, 3] == np.inf


@pytest.mark.parametrize("kind", ["exr", "png"])
@pytest.mark.parametrize("name", ["opacity", "transmittance", "optical_depth"])
def test_each_map_that_render_writes_is_read_as_what_it_is(tmp_path, name, kind):
    values = {"opacity": -np.expm1(-RAMP), "transmittance": np.exp(-RAMP), "optical_depth": RAMP}
    path = tmp_path / f"map.{kind}"
    images.write_map(path, values[name], {}, name=name)
    maps = read_maps(path)
    np.testing.assert_allclose(maps.layers[name], values[name], atol=3 / 65535, rtol=1e-6)
    np.testing.assert_allclose(maps.opacity, values["opacity"], atol=3 / 65535, rtol=1e-5)


def test_a_map_of_depth_tells_no_opacity_and_is_refused(tmp_path):
    images.write_map(tmp_path / "z.exr", RAMP, {}, name="depth")
    with pytest.raises(UsageError, match="does not tell the opacity"):
        read_maps(tmp_path / "z.exr")


def test_an_image_without_alpha_is_refused_and_an_opaque_png_is_opaque(tmp_path):
    images.write_exr(tmp_path / "a.exr", {"R": RAMP}, {})
    with pytest.raises(UsageError, match="no alpha"):
        read_maps(tmp_path / "a.exr")
    images.write_png(tmp_path / "a.png", np.ones((4, 4, 4)), {})
    assert (read_maps(tmp_path / "a.png").opacity == 1).all()


def test_a_tint_has_a_transmittance_for_each_channel_and_maps_are_their_means(tmp_path):
    through = np.exp(-RAMP[..., None] * [1.0, 0.5, 0.25])
    channels = {c: through[..., i] * 0 for i, c in enumerate("RGB")}
    channels["A"] = 1 - through.mean(axis=-1)
    channels |= {f"transmittance.{c}": through[..., i] for i, c in enumerate("RGB")}
    images.write_exr(tmp_path / "a.exr", channels, {})
    maps = read_maps(tmp_path / "a.exr")
    assert maps.through.shape == (32, 48, 3)
    np.testing.assert_allclose(maps.transmittance, through.mean(axis=-1), rtol=1e-6)
    assert numbers_of(tmp_path / "a.exr")["disagreement"]["alpha"] < 1e-6


# -- statistics -----------------------------------------------------------------------------------


@given(arrays(np.float32, (7, 9), elements=st.floats(0, 1, width=32)))
def test_numbers_of_an_alpha_are_those_that_numpy_finds(tmp_path_factory, alpha):
    path = tmp_path_factory.mktemp("alpha") / "a.exr"
    images.write_exr(path, dict.fromkeys("RGBA", alpha), {})
    found = numbers_of(path)
    shares = found["coverage"]
    assert shares["above_0"] == pytest.approx((alpha > 0).mean())
    assert shares["above_0.5"] == pytest.approx((alpha > 0.5).mean())
    assert shares["above_0.99"] == pytest.approx((alpha > np.float32(0.99)).mean())
    assert shares["saturated"] == pytest.approx((alpha == 1).mean())
    seen = alpha[alpha > 0]
    opacity = found["maps"]["opacity"]
    if not len(seen):
        assert opacity["percentiles"] is found["visible_box"] is None
        return
    assert opacity["mean"] == pytest.approx(seen.mean(dtype=float), rel=1e-6)
    assert (opacity["min"], opacity["max"]) == (seen.min(), seen.max())
    assert opacity["distinct"] == len(np.unique(seen))
    wanted = np.percentile(seen.astype(float), PERCENTILES)
    np.testing.assert_allclose(list(opacity["percentiles"].values()), wanted, rtol=1e-6)
    edges = np.float32(opacity["histogram"]["edges"])
    counts, _ = np.histogram(seen, edges) if edges[0] < edges[-1] else ([len(seen)], None)
    assert sum(opacity["histogram"]["counts"]) == len(seen)
    if edges[0] < edges[-1] and (np.diff(edges) > 0).all():
        assert opacity["histogram"]["counts"] == counts.tolist()
    rows, columns = np.nonzero(alpha > 0)
    assert found["visible_box"]["x"] == [columns.min(), columns.max()]
    assert found["visible_box"]["y"] == [rows.min(), rows.max()]


def test_nan_and_inf_are_counted_with_the_first_pixel_but_a_depth_of_nothing_is_neither(tmp_path):
    path = tmp_path / "a.exr"
    tau = np.ones((4, 5))
    tau[0] = 0  # there depth is +Inf, as it should be
    write_volcli_exr(path, tau)
    assert numbers_of(path)["nonfinite"] == []
    channels, header = images.read_exr(path)
    channels["R"][2, 3], channels["R"][3, 1], channels["Z"][3, 4] = np.nan, np.inf, np.inf
    images.write_exr(path, channels, {"volcli:job": header.get("volcli:job", "")})
    assert numbers_of(path)["nonfinite"] == [
        {"channel": "R", "nan": 1, "inf": 1, "first": [3, 2]},
        {"channel": "Z", "nan": 0, "inf": 1, "first": [4, 3]},
    ]
    assert kinds(path)[:2] == ["nonfinite", "nonfinite"]


def test_opacity_that_is_nan_or_infinite_does_not_stop_the_others(tmp_path):
    alpha = np.full((3, 3), 0.5, np.float32)
    alpha[0, 0], alpha[0, 1] = np.nan, np.inf
    images.write_exr(tmp_path / "a.exr", dict.fromkeys("RGBA", alpha), {})
    found = numbers_of(tmp_path / "a.exr")
    assert found["maps"]["opacity"]["max"] == 0.5
    assert found["maps"]["opacity"]["not_finite"] == 1


# -- findings -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "tau", "kind"),
    [
        ("nothing", np.zeros((40, 40)), "empty"),
        ("haze", np.pad(RAMP * 1e-3, 2), "thin"),
        ("block", np.pad(np.full((30, 30), 50.0), 5), "solid"),
        ("edge", RAMP, "cut"),
        ("speck", np.pad(np.ones((2, 2)), 40), "small"),
    ],
)
def test_a_picture_that_is_wrong_says_why(tmp_path, name, tau, kind):
    assert kind in kinds(write_volcli_exr(tmp_path / f"{name}.exr", tau))


def test_light_without_opacity_is_emission_and_not_nothing(tmp_path):
    nothing = np.zeros((8, 8))
    channels = {**dict.fromkeys("RGB", np.eye(8)), "A": nothing, "optical_depth.Y": nothing}
    images.write_exr(tmp_path / "a.exr", channels, {})
    assert kinds(tmp_path / "a.exr") == ["emission"]


def test_a_picture_that_is_right_says_nothing(tmp_path):
    y, x = np.mgrid[-1:1:60j, -1:1:60j]
    tau = 3 * np.clip(0.8 - x * x - y * y, 0, None)
    assert kinds(write_volcli_exr(tmp_path / "a.exr", tau)) == []


def test_a_volume_that_emits_nothing_is_called_black(tmp_path):
    path = write_volcli_exr(tmp_path / "a.exr", np.pad(RAMP, 3), colour=(0, 0, 0))
    assert "black" in kinds(path)


@pytest.mark.parametrize("behind", [None, (0.2, 0.4, 0.7)])
def test_colour_that_does_not_fade_with_opacity_is_called_straight(tmp_path, behind):
    tau = np.pad(np.linspace(0.01, 3, 900).reshape(30, 30), 3)
    path = write_volcli_exr(tmp_path / "a.exr", tau, behind=behind)
    assert "straight" not in kinds(path)
    if behind is not None:
        return
    channels, _ = images.read_exr(path)
    for c, value in zip("RGB", (0.5, 0.25, 1.0), strict=True):
        channels[c] = np.where(channels["A"] > 0, value, 0)
    images.write_exr(path, channels, {})
    assert "straight" in kinds(path)


def test_eight_bits_of_a_thin_medium_are_called_bands(tmp_path):
    opacity = np.pad(np.linspace(0, 0.1, 80 * 80).reshape(80, 80), 4)
    rgba = np.dstack([opacity] * 4)
    images.write_png(tmp_path / "a.png", rgba, {})
    (found,) = [f for f in numbers_of(tmp_path / "a.png")["findings"] if f["kind"] == "quantised"]
    assert "which shows as bands" in found["text"]
    images.write_png(tmp_path / "b.png", rgba, {}, bits=16)
    assert "quantised" not in kinds(tmp_path / "b.png")
    # An EXR that was made of 8 bits has no more in it.
    stored = read_maps(tmp_path / "a.png").opacity
    images.write_exr(tmp_path / "c.exr", {**dict.fromkeys("RGB", stored), "A": stored}, {})
    assert "quantised" in kinds(tmp_path / "c.exr")


def test_long_steps_of_midpoint_are_named_as_a_cause_of_bands(tmp_path):
    tau = np.pad(RAMP, 3)
    coarse = write_volcli_exr(tmp_path / "a.exr", tau, header={"volcli:rule": "midpoint 2"})
    fine = write_volcli_exr(tmp_path / "b.exr", tau, header={"volcli:rule": "midpoint 0.25"})
    assert "banded" in kinds(coarse)
    assert "banded" not in kinds(fine)


def test_colour_brighter_than_one_will_be_clipped(tmp_path):
    path = write_volcli_exr(tmp_path / "a.exr", np.pad(RAMP, 3), colour=(4, 4, 4))
    assert "clipped" in kinds(path)


def test_layers_that_were_changed_after_rendering_are_found(tmp_path):
    path = write_volcli_exr(tmp_path / "a.exr", np.pad(RAMP, 3))
    channels, _ = images.read_exr(path)
    channels["optical_depth.Y"] *= 2
    images.write_exr(path, channels, {})
    assert "disagreement" in kinds(path)


@given(st.floats(1e-6, 1e6), st.floats(1e-6, 1e6))
def test_the_scale_that_is_advised_brings_the_median_to_about_one(scale, median):
    wanted = better_scale(scale, median)
    assert 0.66 <= wanted / scale * median <= 1.51
    assert len(f"{wanted:.3g}".strip("0.").replace(".", "").split("e")[0].strip("0")) <= 1


@pytest.mark.needs_jit
def test_the_advice_on_a_thin_picture_makes_it_visible(tmp_path):
    write_ball(tmp_path / "ball.npz", peak=1e-3)
    volcli("render", tmp_path / "ball.npz", "-o", tmp_path / "thin.exr", "--size", "40x30")
    (thin,) = [f for f in numbers_of(tmp_path / "thin.exr")["findings"] if f["kind"] == "thin"]
    scale = thin["text"].split("--density-scale ")[1].split()[0]
    volcli("render", tmp_path / "ball.npz", "-o", tmp_path / "b.exr", "--size", "40x30",
           "--density-scale", scale)  # fmt: skip
    found = numbers_of(tmp_path / "b.exr")
    assert 0.3 < found["maps"]["optical_depth"]["percentiles"]["50"] < 3
    assert not {"thin", "solid", "empty"} & {f["kind"] for f in found["findings"]}


@pytest.mark.needs_jit
def test_numbers_of_a_homogeneous_slab_are_its_closed_form(tmp_path):
    np.save(tmp_path / "slab.npy", np.ones((40, 40, 11), np.float32))
    ran = volcli("render", tmp_path / "slab.npy", "-o", tmp_path / "a.exr", "--size", "16x16",
                 "--density-scale", "0.1", "--ortho", "20")  # fmt: skip
    assert ran.code == 0, ran.err
    tau = 0.1 * 11  # ten voxels between lattice points, and half a voxel's worth at each end
    found = numbers_of(tmp_path / "a.exr")["maps"]
    assert found["optical_depth"]["percentiles"]["50"] == pytest.approx(tau, rel=1e-6)
    assert found["transmittance"]["mean"] == pytest.approx(np.exp(-tau), rel=1e-6)
    assert found["opacity"]["min"] == pytest.approx(-np.expm1(-tau), rel=1e-6)


# -- the command ----------------------------------------------------------------------------------


def test_inspect_prints_one_object_for_one_image_and_a_list_for_several(tmp_path):
    path = write_volcli_exr(tmp_path / "a.exr", RAMP)
    one = json.loads(volcli("inspect", path, "--json").out)
    assert one["size"] == [48, 32]
    many = json.loads(volcli("inspect", path, path, "--json").out)
    assert many["images"] == [one, one]


def test_inspect_prints_its_numbers_and_findings(tmp_path):
    ran = volcli("inspect", write_volcli_exr(tmp_path / "a.exr", RAMP))
    assert ran.code == 0, ran.err
    for text in ("48x32", "> 0.99", "optical_depth", "50 %", "NaN and Inf: none", "cut: goes on"):
        assert text in ran.out
    assert "\x1b" not in ran.out  # no colours where nobody sees them


@pytest.mark.parametrize("kind", ["png", "svg", "pdf"])
def test_a_heat_map_is_drawn(tmp_path, kind):
    source = write_volcli_exr(tmp_path / "a.exr", RAMP)
    out = tmp_path / f"heat.{kind}"
    ran = volcli(
        "inspect", source, "--heatmap", out, "--contours", "0.1,0.5", "--colormap", "magma"
    )
    assert ran.code == 0, ran.err
    starts = {"png": b"\x89PNG", "svg": b"<?xml", "pdf": b"%PDF"}
    assert out.read_bytes().startswith(starts[kind])


def test_a_heat_map_shows_each_value_in_its_colour_and_only_a_thin_medium_on_logarithms(tmp_path):
    from volcli.opacity.colormap import limits, shades
    from volcli.opacity.heatmap import suits_logarithm

    thick = read_maps(write_volcli_exr(tmp_path / "a.exr", RAMP))
    thin = read_maps(write_volcli_exr(tmp_path / "b.exr", RAMP * 1e-3))
    assert not suits_logarithm(thick, "opacity")
    assert suits_logarithm(thin, "opacity")
    assert limits("opacity", thick.opacity, False) == (0, 1)
    assert limits("opacity", thin.opacity, True)[1] == thin.opacity.max()
    out = tmp_path / "heat.png"
    volcli("inspect", tmp_path / "a.exr", "--heatmap", out, "--colormap", "gray")
    pixels = images.read_background(out)[..., :3]
    drawn = (pixels == pixels[..., :1]).all(axis=-1)
    assert drawn.mean() > 0.9  # a grey figure, of a grey map
    np.testing.assert_array_equal(shades("gray")[[0, -1]], [[0] * 3, [255] * 3])


@pytest.mark.parametrize("shape", [(1, 1), (1, 50), (50, 1), (3, 4000)])
@pytest.mark.parametrize("value", [0.0, 0.5, 1.0, np.nan, np.inf])
def test_a_picture_of_any_shape_and_value_can_be_looked_at(tmp_path, shape, value):
    values = np.full(shape, value)
    values[0, 0] = 0.25
    images.write_exr(tmp_path / "a.exr", dict.fromkeys("RGBA", values), {})
    for options in (["--contours", "0.3"], ["--log"]):
        ran = volcli("inspect", tmp_path / "a.exr", "--heatmap", tmp_path / "h.png", *options)
        assert ran.code == 0, ran.err
    assert volcli("inspect", tmp_path / "a.exr", "--html", tmp_path / "p.html").code == 0
    json.loads(volcli("inspect", tmp_path / "a.exr", "--json").out)


@pytest.mark.parametrize("size", [(9, 7), (4000, 30), (33, 3201)])
def test_a_large_map_is_shown_by_means_of_squares(size):
    from volcli.opacity.heatmap import LARGEST, reduced

    values = np.arange(size[0] * size[1], dtype=np.float32).reshape(size)
    shown = reduced(values)
    assert max(shown.shape) <= LARGEST
    if max(size) <= LARGEST:
        np.testing.assert_array_equal(shown, values)
    else:
        factor = -(-max(size) // LARGEST)
        np.testing.assert_allclose(shown[0, 0], values[:factor, :factor].mean(), rtol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        ("gone.exr", 2, "gone.exr: no such file"),
        (".", 2, "is a folder"),
        ("a.exr --map no", 2, "--map no: must be one of"),
        ("a.exr --heatmap h.gif", 2, "unknown extension '.gif'"),
        ("a.exr --heatmap no/h.png", 4, "does not exist"),
        ("a.exr a.exr --heatmap h.png", 2, "one image"),
        ("a.exr --heatmap h.png --colormap viridid", 2, "did you mean 'viridis'"),
        ("a.exr --heatmap h.png --contours 0.5,2", 2, "between 0 and 1"),
        ("b.exr --heatmap h.png --map depth", 2, "has none"),
        ("a.exr --html p.txt", 2, "unknown extension '.txt'"),
        ("a.exr c.exr --html p.html", 2, "images of one size"),
        ("text.exr", 2, "not a readable image"),
    ],
)
def test_a_mistake_of_inspect_is_one_line(tmp_path, monkeypatch, arguments, code, message):
    monkeypatch.chdir(tmp_path)
    write_volcli_exr("a.exr", RAMP)
    write_volcli_exr("c.exr", RAMP[:5])
    images.write_exr("b.exr", dict.fromkeys("RGBA", RAMP), {})
    (tmp_path / "text.exr").write_text("no image")
    ran = volcli("inspect", *arguments.split())
    assert ran.code == code, ran.err
    assert message in ran.err
    assert ran.err.count("\n") == 1
    assert not list(tmp_path.glob("h.*")) + list(tmp_path.glob("p.*"))


def test_the_samples_of_the_repository_look_neither_empty_nor_solid():
    for path in SAMPLES.glob("*.vdb"):
        grids = json.loads(volcli("info", path, "--stats", "--json").out)["grids"]
        (density,) = [g for g in grids if g.get("optical_depth")]
        assert density["advice"] is None, path


@pytest.mark.needs_jit
def test_a_picture_of_4096_pixels_squared_is_read_in_less_than_a_gigabyte_and_a_half(tmp_path):
    tau = np.broadcast_to(np.linspace(0, 3, 4096, dtype=np.float32), (4096, 4096))
    opacity = -np.expm1(-tau)
    channels = {**dict.fromkeys("RGBA", opacity), "Z": np.where(opacity > 0, tau, np.inf)}
    channels |= {"transmittance.Y": np.exp(-tau), "optical_depth.Y": tau}
    images.write_exr(tmp_path / "large.exr", channels, {})
    code = (
        "import sys\nfrom volcli.cli.app import run_app\nfrom volcli.run import peak_memory_bytes\n"
        "run_app(sys.argv[1:])\nprint(peak_memory_bytes(), file=sys.stderr)"
    )
    ended = subprocess.run(
        [sys.executable, "-c", code, "inspect", tmp_path / "large.exr"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert "4096x4096" in ended.stdout
    assert int(ended.stderr.splitlines()[-1]) < 1.5e9
