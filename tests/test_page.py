"""The page of `volcli inspect --html`, in a real browser: what it shows is what the image holds."""

import re
import shutil

import numpy as np
import pytest
from commandline import volcli
from pictures import RAMP, write_volcli_exr

from volcli import images
from volcli.srgb import srgb_from_linear

CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
WIDTH, HEIGHT = 48, 32


@pytest.fixture(scope="module")
def browser():
    playwright = pytest.importorskip("playwright.sync_api", reason="no playwright")
    if CHROMIUM is None:
        pytest.skip("no chromium to show the page in")
    with playwright.sync_playwright() as started:
        launched = started.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield launched
        launched.close()


@pytest.fixture
def opened(browser, tmp_path):
    """Opens the page of some images; every script error fails the test."""
    errors = []
    pages = []

    def open_page(*names, at="", scheme="light", size=(1200, 900)):
        out = tmp_path / "page.html"
        ran = volcli("inspect", *(tmp_path / name for name in names), "--html", out)
        assert ran.code == 0, ran.err
        viewport = {"width": size[0], "height": size[1]}
        page = browser.new_page(viewport=viewport, color_scheme=scheme)
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("request", lambda request: errors.append(request.url) if out.name not in request.url
                and not request.url.startswith(("data:", "blob:")) else None)  # fmt: skip
        page.goto(f"{out.as_uri()}{at}")
        page.wait_for_selector("body[data-ready]")
        pages.append(page)
        return page

    yield open_page
    for page in pages:
        page.close()
    assert not errors


def settled(page):
    """Wait for what was asked for to be drawn."""
    page.evaluate("() => new Promise(d => requestAnimationFrame(() => requestAnimationFrame(d)))")
    return page


def on_screen(page, x, y):
    """Where the middle of a pixel of the image is in the window."""
    box = page.locator("#canvas").bounding_box()
    zoom = min(box["width"] / WIDTH, box["height"] / HEIGHT)
    return (
        box["x"] + box["width"] / 2 + (x + 0.5 - WIDTH / 2) * zoom,
        box["y"] + box["height"] / 2 + (y + 0.5 - HEIGHT / 2) * zoom,
    )


def hover(page, x, y):
    page.mouse.move(*on_screen(page, x, y))
    return settled(page)


def values(page):
    """The cells under the cursor, as text, of each row."""
    rows = page.locator("#rows tr").all()
    return [[cell.inner_text() for cell in row.locator("td").all()] for row in rows]


def colour_at(page, x, y):
    """The colour of the canvas at a pixel of the image."""
    left, top = on_screen(settled(page), x, y)
    box = page.locator("#canvas").bounding_box()
    script = "([x, y]) => [...document.getElementById('canvas').getContext('2d')"
    script += ".getImageData(x * devicePixelRatio, y * devicePixelRatio, 1, 1).data]"
    return page.evaluate(script, [left - box["x"], top - box["y"]])[:3]


def shown(light):
    """Linear light as the codes of a screen."""
    return np.rint(255 * srgb_from_linear(np.clip(light, 0, 1)))


def test_the_values_under_the_cursor_are_those_of_the_file(opened, tmp_path):
    write_volcli_exr(tmp_path / "a.exr", RAMP)
    page = opened("a.exr")
    for x, y in ((0, 0), (47, 0), (20, 15), (47, 31)):
        hover(page, x, y)
        assert page.locator("#where").inner_text() == f"x {x}, y {y}"
        ((opacity, through, tau, depth, rgb),) = values(page)
        assert float(tau) == pytest.approx(RAMP[y, x], rel=1e-5)
        assert float(opacity) == pytest.approx(-np.expm1(-RAMP[y, x]), rel=1e-5)
        assert float(through) == pytest.approx(np.exp(-RAMP[y, x]), rel=1e-5)
        assert depth == ("infinite" if RAMP[y, x] == 0 else "5")
        wanted = -np.expm1(-RAMP[y, x]) * np.array([0.5, 0.25, 1])
        np.testing.assert_allclose([float(c) for c in rgb.split(",")], wanted, rtol=5e-3)


def test_arrow_keys_move_the_cursor_and_read_the_values(opened, tmp_path):
    write_volcli_exr(tmp_path / "a.exr", RAMP)
    page = opened("a.exr")
    page.locator("#canvas").focus()
    for key in ("ArrowRight", "ArrowDown", "Shift+ArrowLeft"):
        page.keyboard.press(key)
    settled(page)
    assert page.locator("#where").inner_text() == f"x {24 + 1 - 10}, y {16 + 1}"
    assert float(values(page)[0][2]) == pytest.approx(RAMP[17, 15], rel=1e-5)
    assert page.locator("#cross").is_visible()


@pytest.mark.parametrize("behind", [None, (0.2, 0.4, 0.7)])
def test_the_picture_is_put_before_the_background_that_is_chosen(opened, tmp_path, behind):
    # Whatever it was rendered over: that is taken away.
    write_volcli_exr(tmp_path / "a.exr", RAMP, behind=behind)
    page = opened("a.exr")
    x, y = 30, 10
    light = -np.expm1(-RAMP[y, x]) * np.array([0.5, 0.25, 1])
    for name, colour in (("000000", 0.0), ("ffffff", 1.0)):
        page.select_option("#background", name)
        found = colour_at(page, x, y)
        np.testing.assert_allclose(found, shown(light + np.exp(-RAMP[y, x]) * colour), atol=1.01)
    page.locator("#colour").fill("#ff0000")
    found = colour_at(page, x, y)
    np.testing.assert_allclose(
        found, shown(light + np.exp(-RAMP[y, x]) * np.array([1.0, 0, 0])), atol=1.01
    )
    page.select_option("#background", "checks")
    found = [colour_at(page, 1, y), colour_at(page, 3, y), colour_at(page, 5, y)]
    assert len({tuple(c) for c in found}) > 1


@pytest.mark.parametrize(("key", "layer"), [("2", "opacity"), ("3", "transmittance"),
                                            ("4", "optical_depth")])  # fmt: skip
def test_a_layer_is_shown_in_the_colours_of_its_map(opened, tmp_path, key, layer):
    from volcli.opacity.colormap import shades

    write_volcli_exr(tmp_path / "a.exr", RAMP)
    page = opened("a.exr")
    page.keyboard.press(key)
    page.select_option("#colormap", "magma")
    assert page.locator(f"#layer-{layer}").is_checked()
    unit = {"opacity": -np.expm1(-RAMP), "transmittance": np.exp(-RAMP), "optical_depth": RAMP / 3}
    for x, y in ((0, 0), (10, 20), (47, 31)):
        found = np.array(colour_at(page, x, y))
        wanted = shades("magma")[min(int(255.999 * unit[layer][y, x]), 255)].astype(int)
        assert np.abs(found - wanted).max() <= 4, (found, wanted)  # one entry of the map


def test_range_sliders_stretch_the_colours(opened, tmp_path):
    write_volcli_exr(tmp_path / "a.exr", RAMP)
    page = opened("a.exr", at="#layer=optical_depth&colormap=gray")
    page.locator("#high").fill("0.5")
    assert page.locator("#high-value").inner_text() == "1.5"
    y, x = np.argwhere(RAMP > 1.5)[0]
    assert colour_at(page, x + 1, y) == [255, 255, 255]
    page.locator("#low").fill("0.4")
    y, x = np.argwhere(RAMP > 1.2)[0]
    assert colour_at(page, x - 2, y) == [0, 0, 0]


def test_brushing_the_histogram_dims_all_other_pixels(opened, tmp_path):
    write_volcli_exr(tmp_path / "a.exr", RAMP)
    page = opened("a.exr", at="#layer=optical_depth")
    inside, outside = colour_at(page, 24, 16), colour_at(page, 24, 2)
    box = page.locator("#histogram").bounding_box()
    page.mouse.move(box["x"] + 0.4 * box["width"], box["y"] + 40)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.6 * box["width"], box["y"] + 40, steps=5)
    page.mouse.up()
    assert colour_at(page, 24, 16) == inside
    assert colour_at(page, 24, 2) == [((c & 0xFC) >> 2) + 0x30 for c in outside]
    low, high = (float(page.locator(f"#{end}").input_value()) for end in ("from", "to"))
    assert (low, high) == (pytest.approx(1.2, abs=0.03), pytest.approx(1.8, abs=0.03))
    told = int(page.locator("#brushed").inner_text().split()[0].replace(",", ""))
    assert told == pytest.approx(np.count_nonzero((low <= RAMP) & (high >= RAMP)), abs=2)
    page.keyboard.press("x")
    assert colour_at(page, 24, 2) == outside


def test_the_line_of_equal_opacity_lies_where_opacity_is_that(opened, tmp_path):
    tau = np.broadcast_to(np.linspace(0, 3, WIDTH), (HEIGHT, WIDTH))
    write_volcli_exr(tmp_path / "a.exr", tau)
    page = opened("a.exr", at="#layer=opacity&colormap=gray&line=1&iso=0.5")
    settled(page)
    script = """() => { const c = document.getElementById('canvas');
        return [...c.getContext('2d').getImageData(0, c.height >> 1, c.width, 1).data] }"""
    row = np.array(page.evaluate(script)).reshape(-1, 4)[:, :3].astype(int)
    jumps = np.flatnonzero(np.abs(np.diff(row[:, 1])) > 60)
    box = page.locator("#canvas").bounding_box()
    zoom = min(box["width"] / WIDTH, box["height"] / HEIGHT)
    column = (jumps - box["width"] / 2) / zoom + WIDTH / 2
    crossing = int(np.argmax(-np.expm1(-tau[0]) >= 0.5))
    assert np.any(np.abs(column - crossing) < 0.2), (column, crossing)


def test_the_line_reaches_as_far_as_the_opacity_of_a_thin_medium(opened, tmp_path):
    write_volcli_exr(tmp_path / "a.exr", RAMP * 1e-3)
    page = settled(opened("a.exr", at="#layer=opacity&line=1"))
    most = -np.expm1(-RAMP.max() * 1e-3)
    assert float(page.locator("#iso").get_attribute("max")) == pytest.approx(most, rel=1e-6)
    assert float(page.locator("#iso-value").inner_text()) == pytest.approx(most / 2, rel=0.01)


def test_two_images_are_wiped_between(opened, tmp_path):
    write_volcli_exr(tmp_path / "a.exr", np.full((HEIGHT, WIDTH), 0.5))
    write_volcli_exr(tmp_path / "b.exr", np.full((HEIGHT, WIDTH), 2.5))
    page = opened("a.exr", "b.exr", at="#layer=optical_depth&wipe=0.5")
    a, b = colour_at(page, 2, 16), colour_at(page, 45, 16)
    assert a != b
    page.locator("#wipe").fill("1")
    assert colour_at(page, 45, 16) == a
    page.locator("#wipe").fill("0")
    assert colour_at(page, 2, 16) == b
    hover(page, 5, 5)
    assert [float(row[2]) for row in values(page)] == [0.5, 2.5]


def test_a_link_keeps_the_view(opened, tmp_path, browser):
    write_volcli_exr(tmp_path / "a.exr", RAMP)
    page = opened("a.exr")
    page.keyboard.press("4")
    page.keyboard.press("l")
    page.keyboard.press("+")
    page.locator("#high").fill("0.9")
    page.wait_for_function("location.hash.includes('high=0.9')")
    url = page.url
    assert re.search(r"#layer=optical_depth&log=1&high=0\.9&zoom=", url)
    other = browser.new_page(viewport={"width": 1200, "height": 900})
    other.goto(url)
    other.wait_for_selector("body[data-ready]")
    grab = "() => document.getElementById('canvas').toDataURL()"
    settled(page), settled(other)
    assert other.evaluate(grab) == page.evaluate(grab)
    assert other.locator("#log").is_checked()
    other.close()


def test_a_link_that_asks_for_what_there_is_not_is_passed_over(opened, tmp_path):
    write_volcli_exr(tmp_path / "a.exr", RAMP)
    page = opened(
        "a.exr", at="#layer=no&colormap=no&left=7&zoom=x&low=a&nothing=1&from=1&colour=no"
    )
    assert page.locator("#layer-picture").is_checked()


def test_the_page_is_dark_where_the_reader_wants_it_so_and_can_be_switched(opened, tmp_path):
    write_volcli_exr(tmp_path / "a.exr", RAMP)
    page = settled(opened("a.exr", scheme="dark"))
    ground = "() => getComputedStyle(document.body).backgroundColor"
    dark = page.evaluate(ground)
    page.locator("#theme").click()
    light = settled(page).evaluate(ground)
    assert sum(map(int, re.findall(r"\d+", dark)[:3])) < 200
    assert sum(map(int, re.findall(r"\d+", light)[:3])) > 650


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_stands_out_from_its_ground(opened, tmp_path, scheme):
    """WCAG 2 asks for a contrast of 4.5."""
    write_volcli_exr(tmp_path / "a.exr", RAMP)
    page = settled(opened("a.exr", scheme=scheme))
    script = """() => ['--ink', '--faint', '--ground', '--panel'].map(
        n => getComputedStyle(document.documentElement).getPropertyValue(n).trim())"""
    ink, faint, ground, panel = (
        [int(c[i : i + 2], 16) / 255 for i in (1, 3, 5)] for c in page.evaluate(script)
    )

    def luminance(colour):
        linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in colour]
        return np.dot(linear, [0.2126, 0.7152, 0.0722])

    for text in (ink, faint):
        for behind in (ground, panel):
            low, high = sorted([luminance(text), luminance(behind)])
            assert (high + 0.05) / (low + 0.05) >= 4.5


def test_every_control_has_a_name(opened, tmp_path):
    write_volcli_exr(tmp_path / "a.exr", RAMP)
    write_volcli_exr(tmp_path / "b.exr", RAMP)
    page = opened("a.exr", "b.exr")
    nameless = page.evaluate(
        """() => [...document.querySelectorAll('input, select, button, canvas, fieldset')].filter(
        e => !(e.labels?.length && [...e.labels].some(l => l.textContent.trim()))
          && !e.textContent.trim() && !e.getAttribute('aria-label')
          && !e.hasAttribute('aria-hidden')).map(e => e.id)"""
    )
    assert nameless == []


@pytest.mark.parametrize("width", [360, 800, 1600])
def test_nothing_sticks_out_of_a_window_of_any_width(opened, tmp_path, width):
    write_volcli_exr(tmp_path / "a.exr", RAMP)
    page = settled(opened("a.exr", size=(width, 800)))
    assert page.evaluate("() => document.documentElement.scrollWidth") <= width


def test_an_image_of_alpha_alone_has_no_depth_and_one_of_a_map_no_picture(opened, tmp_path):
    alpha = -np.expm1(-RAMP)
    images.write_exr(tmp_path / "a.exr", dict.fromkeys("RGBA", alpha), {})
    page = opened("a.exr")
    assert page.locator("#layer-depth").count() == 0
    images.write_map(tmp_path / "m.exr", RAMP, {}, name="optical_depth")
    page = opened("m.exr")
    assert page.locator("#layer-picture").count() == 0
    assert page.locator("#layer-opacity").is_checked()


def test_of_pixels_with_several_samples_each_layer_is_the_mean_that_the_file_holds(
    opened, tmp_path
):
    path = write_volcli_exr(tmp_path / "a.exr", RAMP)
    channels, _ = images.read_exr(path)
    channels["transmittance.Y"][5, 5], channels["A"][5, 5] = 0.75, 0.25
    images.write_exr(path, channels, {"volcli:job": "[camera]\nsamples = 4\n"})
    page = hover(opened("a.exr"), 5, 5)
    assert values(page)[0][:3] == ["0.25", "0.75", str(float(f"{RAMP[5, 5]:.6g}"))]


def test_a_tint_lets_each_channel_of_the_background_through(opened, tmp_path):
    through = np.exp(-RAMP[..., None] * [1.0, 0.5, 0.25])
    channels = dict.fromkeys("RGB", np.zeros_like(RAMP)) | {"A": 1 - through.mean(axis=-1)}
    channels |= {f"transmittance.{c}": through[..., i] for i, c in enumerate("RGB")}
    images.write_exr(tmp_path / "a.exr", channels, {})
    page = opened("a.exr", at="#background=ffffff")
    np.testing.assert_allclose(colour_at(page, 30, 20), shown(through[20, 30]), atol=1.01)


@pytest.mark.parametrize(
    "name", ['a <b> & "c" \'.exr', "</script><script>boom.exr".replace("/", "")]
)
def test_the_name_of_a_file_is_text(opened, tmp_path, name):
    write_volcli_exr(tmp_path / name, RAMP)
    page = opened(name)
    assert page.locator("h1").inner_text() == re.sub(r"\s+", " ", name)
    assert page.title() == f"{name} - volcli"


def test_packed_planes_are_what_they_were():
    """The Python side of what the page unpacks."""
    import base64
    import zlib

    from volcli.opacity.page import packed

    plane = np.random.default_rng(1).normal(size=(5, 7)).astype(np.float32)
    plane[0, :3] = np.inf, np.nan, -0.0
    deltas = np.frombuffer(zlib.decompress(base64.b64decode(packed(plane))), np.uint8)
    by_order = np.cumsum(deltas, dtype=np.uint8).reshape(4, -1)
    found = np.ascontiguousarray(by_order.T).view("<f4").reshape(5, 7)
    assert found.tobytes() == plane.tobytes()
