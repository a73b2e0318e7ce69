"""Work in threads: in order, in no more threads than were asked for, and with the same result to
the bit for any number of them, however the picture is cut into tiles."""

import functools
import threading
import time

import numpy as np
import pytest
from commandline import SAMPLES, volcli
from scenes import affine, bounded, medium, plan_for, random_colours, random_values

from volcli import render as rendering
from volcli.camera import make_camera
from volcli.grids import threads
from volcli.grids.threads import in_threads, threads_limited_to
from volcli.images import read_exr
from volcli.render import Scene, Source, render
from volcli.schema import Camera
from volcli.tables import ColorTable, TransferTable


def where(item):
    """The thread that worked on it; long enough that a second one takes the next."""
    time.sleep(0.01)
    return threading.get_ident()


@pytest.mark.parametrize("count", [1, 2, 5])
def test_no_more_threads_are_taken_than_asked_for(count):
    with threads_limited_to(count):
        used = set(in_threads(where, range(20)))
    assert len(used) == count
    if count == 1:
        assert used == {threading.get_ident()}


def test_a_limit_ends_with_its_block():
    with threads_limited_to(1), threads_limited_to(3):
        pass
    with threads_limited_to(1):
        with threads_limited_to(None), threads_limited_to(2):
            assert len(set(in_threads(where, range(8)))) == 2
        assert set(in_threads(where, range(3))) == {threading.get_ident()}


@pytest.mark.parametrize("count", [1, 4])
def test_results_and_errors_come_in_the_order_of_the_items(count):
    def slower_first(item):
        time.sleep(0.002 * (4 - item))
        return 1 / (3 - item)

    results = []
    with threads_limited_to(count), pytest.raises(ZeroDivisionError):
        for result in in_threads(slower_first, range(6)):
            results.append(result)
    assert results == [1 / 3, 1 / 2, 1]


def test_one_thread_renders_a_picture_without_a_pool_to_load_it(tmp_path, monkeypatch):
    def refuse(*_):
        raise AssertionError("a pool of threads")

    monkeypatch.setattr(threads, "ThreadPoolExecutor", refuse)
    # Of the stand-in that the kernels are made ready on in a thread of its own.
    monkeypatch.setattr("volcli.run._use_kernels", lambda prepared: None)
    arguments = ["render", SAMPLES / "rotated.vdb", "--size", "8x6", "-o", tmp_path / "a.exr"]
    assert volcli(*arguments, "--threads", "1").code == 0
    assert volcli(*arguments, "--threads", "2").code == 1


# --- pictures -------------------------------------------------------------------------------------

LAYERS = ("radiance", "optical_depth", "transmittance", "opacity", "depth", "error_bound")

RULES = {
    "exact": {},
    "midpoint": {"step": 0.7},
    "certified": {"max_error": 0.01},
    "nearest": {"nearest": True},
}

CAMERAS = {
    "perspective": {"type": "perspective", "fov": 30.0},
    "orthographic": {"type": "orthographic", "width": 12.0},
    "panorama": {"type": "panorama"},
    "several samples": {"type": "perspective", "fov": 30.0, "samples": 3},
}

TILES_AND_THREADS = [(16, 1), (16, 2), (16, 3), (64, 2), (5, 3), (1, 2)]


def scene_of(terms):
    """A rough volume, and what the scene makes of it."""
    values = random_values(8, (9, 8, 10))
    density = medium(values)
    if terms == "one colour":
        return Scene(density.grid, 0.5, (0.25, 0.5, 1.0))
    elsewhere = affine(0.7 * np.eye(3), (1.0, 0.5, 0.25))
    colours = medium(random_colours(9, (9, 8, 10)), world_from_index=elsewhere)
    if terms == "a colour grid":
        return Scene(density.grid, 0.5, Source(medium(random_colours(9, (9, 8, 10))).grid))
    if terms == "a colour grid elsewhere":
        return Scene(density.grid, 0.5, Source(colours.grid))
    by_value = ColorTable(np.array([0.0, 0.5, 1.0]), np.eye(3))
    return Scene(
        density.grid,
        0.5,
        Source(density.grid, by_value),
        Source(colours.grid, scale=0.1),
        tint=(0.5, 1.0, 2.0),
        transfer=TransferTable(np.array([0.0, 0.5, 1.0]), np.array([0.0, 2.0, 1.0])),
    )


def prepared(terms, rule):
    """(scene, plan) of terms under a rule."""
    return bounded(scene_of(terms), plan_for(**RULES[rule]))


def camera_of(kind):
    return make_camera(
        Camera(eye=(14, 11, 20), target=(4, 4, 4), resolution=(41, 37), **CAMERAS[kind]),
        np.array([[-1.0] * 3, [9.0] * 3]),
    )


def layers_of(result):
    found = {name: getattr(result, name) for name in LAYERS}
    return {name: values for name, values in found.items() if values is not None}


def assert_identical(one, other):
    """To the bit, in every layer."""
    assert one.keys() == other.keys()
    for name in one:
        assert one[name].tobytes() == other[name].tobytes(), name


@pytest.fixture(params=["packets", "ray by ray"])
def ways(request, monkeypatch):
    """Both forms of the loop over rays; terms that packets do not know are ray by ray in each."""
    if request.param == "ray by ray":
        from volcli.kernels import integrator

        one_by_one = functools.partial(integrator.make_integrator, packets=False)
        monkeypatch.setattr(integrator, "make_integrator", one_by_one)
    return request.param


def assert_pictures_are_identical(scene, plan, camera, monkeypatch):
    pictures = []
    for tile, count in TILES_AND_THREADS:
        monkeypatch.setattr(rendering, "TILE", tile)
        pictures.append(render(scene, plan, camera, threads=count))
    first, *others = map(layers_of, pictures)
    assert (first["opacity"] > 0.1).any()
    for other in others:
        assert_identical(first, other)
    assert len({picture.evaluations for picture in pictures}) == 1


@pytest.mark.needs_jit
@pytest.mark.parametrize("rule", RULES)
def test_a_picture_is_the_same_to_the_bit_for_any_threads_and_tiles(rule, ways, monkeypatch):
    scene, plan = prepared("one colour", rule)
    assert_pictures_are_identical(scene, plan, camera_of("perspective"), monkeypatch)


@pytest.mark.needs_jit
@pytest.mark.parametrize("terms", ["a colour grid", "a colour grid elsewhere", "all that there is"])
@pytest.mark.parametrize("rule", RULES)
def test_so_it_is_whatever_shines(rule, terms, monkeypatch):
    scene, plan = prepared(terms, rule)
    assert_pictures_are_identical(scene, plan, camera_of("perspective"), monkeypatch)


@pytest.mark.needs_jit
@pytest.mark.parametrize("kind", CAMERAS)
def test_so_it_is_for_every_camera(kind, monkeypatch):
    scene, plan = prepared("one colour", "exact")
    assert_pictures_are_identical(scene, plan, camera_of(kind), monkeypatch)


@pytest.mark.needs_jit
@pytest.mark.parametrize("kind", CAMERAS)
@pytest.mark.parametrize("rule", RULES)
def test_windows_are_parts_of_the_whole_to_the_bit(rule, kind):
    scene, plan = prepared("one colour", rule)
    camera = camera_of(kind)
    whole = layers_of(render(scene, plan, camera, threads=1))
    for left, top, width, height in [(0, 0, 41, 1), (7, 5, 1, 1), (3, 30, 38, 7), (40, 0, 1, 37)]:
        part = render(scene, plan, camera, threads=1, window=(left, top, width, height))
        cut = {k: v[top : top + height, left : left + width] for k, v in whole.items()}
        assert_identical(layers_of(part), cut)


@pytest.mark.parametrize("kind", CAMERAS)
def test_a_ray_is_the_same_in_float64_in_whatever_rectangle_it_is_asked_for(kind):
    """What float32 would hide in most pixels, and not in all."""
    camera = camera_of(kind)
    samples = camera.samples

    def rays(rows, columns):
        origins, directions = camera.rays(rows, columns, samples)
        depths = camera.depth_per_distance(directions)
        shape = (len(samples), rows.stop - rows.start, columns.stop - columns.start)
        return [x.reshape(*shape, -1) for x in (origins, directions, depths)]

    whole = rays(slice(0, 37), slice(0, 41))
    for top, left in np.ndindex(37, 41):
        for height, width in ((1, 1), (5, 3)):
            rows = slice(top, min(top + height, 37))
            columns = slice(left, min(left + width, 41))
            for one, other in zip(rays(rows, columns), whole, strict=True):
                assert one.tobytes() == other[:, rows, columns].tobytes()


@pytest.mark.needs_jit
@pytest.mark.parametrize("rule", [(), ("--step", "0.5"), ("--max-error", "0.01")], ids=str)
def test_a_file_holds_the_same_pixels_for_any_number_of_threads(rule, tmp_path):
    seen = []
    for count in (1, 2, 3):
        out = tmp_path / f"{count}.exr"
        flags = ("--size", "130x70", "--color-grid", "Cd", "--density-scale", "0.5")
        ran = volcli("render", SAMPLES / "cloud.vdb", "-o", out, *flags, *rule, "--threads", count)
        assert ran.code == 0, ran.err
        seen.append(read_exr(out)[0])
    assert_identical(seen[0], seen[1])
    assert_identical(seen[0], seen[2])
