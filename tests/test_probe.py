"""The walk of one ray: its numbers are those of the reference, closed forms and the kernels."""

import csv
import io
import json

import numpy as np
import pytest
import reference
from commandline import ROOT, SAMPLES, volcli, write_ball, write_grid
from hypothesis import given
from hypothesis import strategies as st
from scenes import (
    TRANSFORMS,
    Medium,
    affine,
    header,
    joined,
    medium,
    plan_for,
    random_colours,
    random_values,
    rotation,
    tree_of,
)

from volcli.grids import empty_grid
from volcli.images import read_exr
from volcli.probe.field import cuts, field_along, make_line
from volcli.probe.report import COLUMNS, report, table
from volcli.probe.rules import sample_distances, seen_by, with_step
from volcli.probe.walk import walk
from volcli.render import Scene, Source
from volcli.tables import ColorTable, TransferTable

WHITE = (1.0, 1.0, 1.0)
LINE = ColorTable(np.array([0.0, 1.0]), np.array([[0, 0, 0], [1, 0.5, 0.25]], float))


def rays_at(medium, count=5, seed=0, away=40.0):
    """Rays from all sides through points of a medium of 9 voxels."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        through = medium.world(rng.uniform(0, 8, 3))
        origin = through + away * rng.normal(size=3)
        direction = through - origin
        yield origin, direction / np.linalg.norm(direction)


MEDIA = {
    name: medium(random_values(n, (9, 9, 9)), world_from_index=matrix)
    for n, (name, matrix) in enumerate(TRANSFORMS.items())
}
MEDIA["with tiles"] = Medium(
    joined(
        tree_of(random_values(3, (20, 9, 12)), origin=(-7, 3, -2)),
        tree_of(
            np.empty((0, 0, 0)), tiles=[((32, 0, 0), 8, 0.7, True), ((128, 0, 0), 128, 0.1, True)]
        ),
    )
)


@pytest.mark.parametrize("nearest", [False, True])
@pytest.mark.parametrize("name", MEDIA)
def test_a_walk_sees_what_the_reference_sees(name, nearest):
    of = MEDIA[name]
    scene = Scene(of.grid, 0.8, WHITE)
    for origin, direction in rays_at(of):
        walked = walk(scene, nearest, origin, direction)
        wanted = reference.trace(origin, direction, of.lattice(nearest), 0.8)
        tau = walked.optical_depth if walked else 0.0
        assert tau == pytest.approx(wanted.tau, rel=1e-11, abs=1e-14)
        if wanted.tau > 0:
            assert walked.distance == pytest.approx(wanted.distance, rel=1e-9)


@pytest.mark.parametrize("nearest", [False, True])
@pytest.mark.parametrize("turn", [0.0, 37.0])
def test_a_walk_sees_the_colours_that_the_reference_sees(turn, nearest):
    of = MEDIA["rotated"]
    lattice = of.world_from_index @ affine(0.7 * rotation((3, 1, 2), turn), (0.3, 1.0, 0.2))
    colour = medium(random_colours(7, (14, 14, 14)), (-2, -2, -2), lattice, (0.25, 0.5, 0.75))
    scene = Scene(of.grid, 3.0, Source(colour.grid))
    for origin, direction in rays_at(of):
        walked = walk(scene, nearest, origin, direction)
        wanted = reference.trace(
            origin, direction, of.lattice(nearest), 3.0, colour.lattice(nearest)
        )
        np.testing.assert_allclose(walked.light.sum(axis=0), wanted.radiance, rtol=1e-9)


@pytest.mark.parametrize("nearest", [False, True])
@pytest.mark.parametrize("name", MEDIA)
def test_the_kernels_see_what_a_walk_sees_to_1e_12(name, nearest):
    of = MEDIA[name]
    scene, plan = Scene(of.grid, 0.8, (0.2, 0.4, 0.8)), plan_for(nearest=nearest)
    for origin, direction in rays_at(of, seed=1):
        walked = walk(scene, nearest, origin, direction)
        seen = seen_by(scene, plan, origin, direction)
        if walked is None:
            assert seen.tau == 0
            continue
        assert walked.optical_depth == pytest.approx(seen.tau, rel=1e-12, abs=1e-15)
        np.testing.assert_allclose(walked.light.sum(axis=0), seen.radiance, rtol=1e-12, atol=1e-15)
        assert walked.weight.sum() == pytest.approx(-np.expm1(-seen.tau), rel=1e-12)


@given(st.floats(0.01, 100), st.integers(0, 10_000))
def test_weights_and_transmittance_are_parts_of_one(scale, seed):
    of = MEDIA["all at once"]
    ((origin, direction),) = rays_at(of, 1, seed)
    walked = walk(Scene(of.grid, scale, WHITE), False, origin, direction)
    if walked is None:
        return
    through = np.exp(-walked.optical_depth)
    assert walked.weight.sum() + through == pytest.approx(1, rel=1e-12)
    np.testing.assert_allclose(walked.light.sum(axis=0), 1 - through, rtol=1e-10, atol=1e-14)
    rows = table(walked)
    assert (np.diff(rows[:, 3]) >= 0).all()
    np.testing.assert_allclose(rows[1:, 0], rows[:-1, 1])


# -- closed forms ---------------------------------------------------------------------------------

SLAB = medium(np.ones((9, 9, 9)))
"""Along +z through the middle: rises from 0 to 1 over a voxel, 8 voxels of 1, and falls again."""
ALONG = (np.array([4.0, 4.0, -6.0]), np.array([0.0, 0.0, 1.0]))


@pytest.mark.parametrize("scale", [1e-9, 0.1, 1.0, 50.0])
def test_a_slab_is_its_closed_form(scale):
    walked = walk(Scene(SLAB.grid, scale, WHITE), False, *ALONG)
    assert walked.optical_depth == pytest.approx(9 * scale, rel=1e-14)
    assert (walked.begin[0], walked.end[-1]) == (5, 15)
    np.testing.assert_allclose(walked.light.sum(axis=0), -np.expm1(-9 * scale), rtol=1e-12)


@pytest.mark.parametrize("T", [0.95, 0.5, 0.05])
def test_transmittance_falls_where_the_closed_form_says(T):
    walked = walk(Scene(SLAB.grid, 1.0, WHITE), False, *ALONG)
    tau = -np.log(T)
    wanted = 5 + np.sqrt(2 * tau) if tau < 0.5 else 6 + (tau - 0.5)
    assert walked.fall(T) == pytest.approx(wanted, rel=1e-12)
    assert walk(Scene(SLAB.grid, 1e-3, WHITE), False, *ALONG).fall(T) is None


def test_sigma_along_the_ray_is_the_field():
    walked = walk(Scene(SLAB.grid, 2.0, WHITE), False, *ALONG)
    t = np.array([4.0, 5.0, 5.25, 6.0, 10.0, 14.5, 15.0, 16.0])
    np.testing.assert_allclose(walked.sigma(t), [0, 0, 0.5, 2, 2, 1, 0, 0], atol=1e-12)


@pytest.mark.parametrize("scale", [1e-12, 1e-3, 1.0, 30.0])
def test_emission_in_proportion_to_density_is_e_over_sigma_times_opacity(scale):
    scene = Scene(SLAB.grid, scale, (0.0,) * 3, Source(SLAB.grid, LINE))
    walked = walk(scene, False, *ALONG)
    wanted = -np.expm1(-9 * scale) / scale * np.array([1, 0.5, 0.25])
    np.testing.assert_allclose(walked.light.sum(axis=0), wanted, rtol=1e-9)


def test_emission_alone_is_its_integral_and_ends_with_its_box():
    nothing = medium(np.zeros((9, 9, 9)))
    glow = medium(np.ones((5, 5, 5, 3)), (2, 2, 2), background=(1.0, 1.0, 1.0))
    scene = Scene(nothing.grid, 1.0, WHITE, Source(glow.grid, scale=0.3))
    walked = walk(scene, False, *ALONG)
    np.testing.assert_allclose(walked.light.sum(axis=0), 0.3 * 6, rtol=1e-12)
    assert walked.distance is None
    assert walked.optical_depth == 0


@pytest.mark.parametrize("tint", [(1.0, 0.5, 0.25), (0.0, 1.0, 2.0)])
def test_a_tint_is_an_extinction_of_each_channel(tint):
    scene = Scene(SLAB.grid, 0.3, (0.2, 0.4, 0.8), tint=tint)
    walked = walk(scene, False, *ALONG)
    wanted = -np.expm1(-2.7 * np.array(tint)) * (0.2, 0.4, 0.8)
    np.testing.assert_allclose(walked.light.sum(axis=0), wanted, rtol=1e-12)
    varying = Scene(SLAB.grid, 0.3, Source(SLAB.grid, ColorTable(np.array([0.0]), np.ones((1, 3)))),
                    tint=tint)  # fmt: skip
    walked = walk(varying, False, *ALONG)
    np.testing.assert_allclose(
        walked.light.sum(axis=0), -np.expm1(-2.7 * np.array(tint)), rtol=1e-9
    )


def test_a_transfer_function_bends_within_a_cell():
    """Shown from .25 to .75 alone, as 2: half a voxel on each side of the slab."""
    steep = TransferTable(
        np.array([0.25, 0.25 + 1e-9, 0.75, 0.75 + 1e-9]), np.array([0.0, 2, 2, 0])
    )
    walked = walk(Scene(SLAB.grid, 1.0, WHITE, transfer=steep), False, *ALONG)
    assert walked.optical_depth == pytest.approx(2 * 0.5 * 2, rel=1e-6)
    bent = TransferTable(np.array([0.0, 0.3, 1.0]), np.array([0.0, 3.0, 1.0]))
    walked = walk(Scene(SLAB.grid, 1.0, WHITE, transfer=bent), False, *ALONG)
    wanted = 2 * (0.3 * 1.5 + 0.7 * 2) + 8
    assert walked.optical_depth == pytest.approx(wanted, rel=1e-12)


# -- extremes -------------------------------------------------------------------------------------


@pytest.mark.parametrize("away", [1.0, 1e3, 1e7, 1e9])
def test_a_far_camera_sees_the_same(away):
    origin = np.array([4.3, 4.2, -6.0 - away])
    near = walk(Scene(SLAB.grid, 1.0, WHITE), False, np.array([4.3, 4.2, -6.0]), ALONG[1])
    far = walk(Scene(SLAB.grid, 1.0, WHITE), False, origin, ALONG[1])
    assert far.optical_depth == pytest.approx(near.optical_depth, rel=1e-12)


def test_two_blocks_a_hundred_million_voxels_apart_are_both_met_and_nothing_between_is_cut():
    far = 100_000_000
    tree = joined(tree_of(np.ones((8, 8, 8))), tree_of(np.ones((8, 8, 8)), origin=(0, 0, far)))
    of = Medium(tree)
    origin, direction = np.array([4.0, 4.0, -3.0]), np.array([0.0, 0, 1])
    walked = walk(Scene(of.grid, 1.0, WHITE), False, origin, direction)
    assert walked.optical_depth == pytest.approx(16, rel=1e-9)
    assert len(walked.tau) < 200


@pytest.mark.parametrize(
    ("origin", "direction", "tau"),
    [
        ((4, 4, 4), (0, 0, 1), 4.5),  # from within
        ((4, 4, 30), (0, 0, 1), None),  # behind
        ((20, 4, -6), (0, 0, 1), None),  # beside
        ((0, 0, -6), (0, 0, 1), 9),  # along lattice lines
        ((-1, 4, -6), (0, 0, 1), 0),  # along the rim
        ((-6, -6, -6), (3**-0.5,) * 3, 3**0.5 * 9 - 3**0.5 / 2 * 2 + 3**0.5 * 0.5),  # corners
    ],
)
def test_rays_that_start_within_or_run_along_planes(origin, direction, tau):
    walked = walk(
        Scene(SLAB.grid, 1.0, WHITE), False, np.array(origin, float), np.array(direction, float)
    )
    if tau is None:
        assert walked is None
    else:
        assert walked.optical_depth == pytest.approx(tau, rel=1e-12, abs=1e-12)


def test_every_cell_on_the_ray_is_an_interval_of_its_own():
    line = make_line(
        MEDIA["uniform"].grid, False, np.array([-3.0, 0.7, 1.1]), np.array([1.0, 0, 0])
    )
    near, far = line.span
    found = cuts(line.moved(near), 0.0, far - near)
    np.testing.assert_allclose(np.diff(found), 0.5, rtol=1e-12)  # voxels of .5, along an axis
    field = field_along(line.moved(near), found)
    assert field.corners.shape == (len(found) - 1, 8)


# -- rules ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("step", [0.25, 1.0, 3.7])
def test_midpoint_is_the_sum_over_the_samples_that_are_drawn(step):
    of = MEDIA["all at once"]
    scene, plan = Scene(of.grid, 0.8, WHITE), plan_for(step=step)
    for origin, direction in rays_at(of, seed=2):
        walked = walk(scene, False, origin, direction)
        seen = seen_by(scene, plan, origin, direction)
        if walked is None:
            continue
        at = seen.samples
        length = step / np.linalg.norm(make_line(of.grid, False, origin, direction).d)
        lengths = np.full(len(at), length)
        lengths[-1] = 2 * (walked.end[-1] - at[-1])
        assert (walked.sigma(at) * lengths).sum() == pytest.approx(seen.tau, rel=1e-9, abs=1e-12)


def test_without_a_step_there_are_no_samples_and_a_step_is_a_plan_of_its_own():
    plan = plan_for(step=2.0)
    assert with_step(plan, None).rule == "exact"
    scene = Scene(SLAB.grid, 1.0, WHITE)
    np.testing.assert_allclose(sample_distances(scene, plan, *ALONG), [6, 8, 10, 12, 14])
    assert len(seen_by(scene, with_step(plan, None), *ALONG).samples) == 0


@pytest.mark.parametrize(
    ("density", "first"), [(SLAB.grid, 6), (empty_grid(header(np.eye(4))), 18)]
)
def test_steps_begin_where_the_first_box_does_that_absorbs_or_emits(density, first):
    """A slab from 5 to 15, or nothing; and light from 17 to 23."""
    glow = medium(np.ones((5, 5, 5, 3)), (2, 2, 12), background=(1.0, 1.0, 1.0))
    scene = Scene(density, 1e-9, (0.0,) * 3, Source(glow.grid, scale=0.3))
    seen = seen_by(scene, plan_for(step=2.0), *ALONG)
    np.testing.assert_allclose(seen.samples, np.arange(first, 23, 2))
    np.testing.assert_allclose(seen.radiance, 0.3 * 6, rtol=1e-7)


def test_a_ray_too_long_for_the_default_step_is_shown_without_and_a_step_that_is_asked_for_refused(
    tmp_path,
):
    far = ((0, 0, 0), (0, 0, 400_000_000))
    leaves = {o: (np.ones((8, 8, 8)), np.ones((8, 8, 8), bool)) for o in far}
    path = write_grid(tmp_path / "far.vdb", leaves=leaves)
    (ray,) = probed(path, "--ray", "2,2,-5,0,0,1")
    assert [rule["rule"] for rule in ray["rules"]] == ["exact", "exact, nearest"]
    ran = volcli("probe", path, "--ray", "2,2,-5,0,0,1", "--step", "1")
    assert ran.code == 2
    assert "samples of one ray" in ran.err


# -- the report and the command -------------------------------------------------------------------


def test_the_report_of_a_ray_that_misses_is_empty_and_is_json():
    origin, direction = np.array([50.0, 0, 0]), np.array([1.0, 0, 0])
    found = report(None, [], origin, direction)
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert (found["range"], found["opacity"], found["bricks"]) == (None, 0, [])


def test_bricks_that_are_met_are_told_in_order_with_their_range():
    values = np.zeros((8, 8, 24), np.float32)
    values[..., :8], values[..., 16:] = 1.0, 3.0
    tiled = joined(
        tree_of(values), tree_of(np.empty((0, 0, 0)), tiles=[((0, 0, 24), 8, 5.0, True)])
    )
    of = Medium(tiled)
    walked = walk(Scene(of.grid, 1.0, WHITE), False, np.array([4.0, 4.0, -6.0]), ALONG[1])
    found = report(walked, [], *ALONG)["bricks"]
    begins = [brick["begin"] for brick in found]
    assert begins == sorted(begins)
    tops = [brick["density"][1] for brick in found if brick["optical_depth"] > 0]
    assert tops[0] == 1 or tops[:2] == [1, 1]
    assert 3 in tops
    assert 5 in tops
    assert sum(brick["optical_depth"] for brick in found) == pytest.approx(walked.optical_depth)
    assert {brick["kind"] for brick in found} <= {"brick", "tile"}
    assert all(brick["index"][2] % 8 == 0 for brick in found if brick["index"])


def probed(*arguments):
    ran = volcli("probe", *arguments, "--json")
    assert ran.code == 0, ran.err
    return json.loads(ran.out, parse_constant=lambda c: pytest.fail(f"{c} is not JSON"))["rays"]


@pytest.mark.needs_jit
def test_a_probe_of_a_pixel_is_what_the_picture_holds_there(tmp_path):
    scene = [SAMPLES / "cloud.vdb", "--size", "80x60", "--color-grid", "Cd", "--density-scale", "8"]
    out = tmp_path / "cloud.exr"
    assert volcli("render", *scene, "-o", out).code == 0
    channels, _ = read_exr(out)
    pixels = [(40, 35), (25, 40), (12, 42), (0, 0)]
    asked = [text for x, y in pixels for text in ("--pixel", f"{x},{y}")]
    for source in (scene, [out]):  # the picture knows the job that made it
        for (x, y), ray in zip(pixels, probed(*source, *asked), strict=True):
            assert ray["pixel"] == [x, y]
            wanted = {name: float(plane[y, x]) for name, plane in channels.items()}
            assert ray["optical_depth"] == pytest.approx(wanted["optical_depth.Y"], rel=1e-6)
            assert ray["transmittance"] == pytest.approx(wanted["transmittance.Y"], rel=1e-6)
            assert ray["opacity"] == pytest.approx(wanted["A"], rel=1e-6)
            np.testing.assert_allclose(
                ray["radiance"], [wanted[c] for c in "RGB"], rtol=1e-6, atol=1e-9
            )
            if wanted["A"] > 0:
                assert ray["depth"] == pytest.approx(wanted["Z"], rel=1e-6)
            else:
                assert ray["depth"] is None
            exact = ray["rules"][0]
            assert exact["rule"] == "exact"
            assert exact["error"] < 1e-14


@pytest.mark.needs_jit
@pytest.mark.parametrize(
    ("job", "pixels"), [("fire", [(40, 40), (30, 52), (47, 25)]), ("temperature", [(38, 44)])]
)
def test_a_probe_sees_the_light_of_a_job_by_value_as_its_picture_does(job, pixels, tmp_path):
    source = [ROOT / "configs" / f"{job}.toml", "--size", "80x80", "--background", "transparent"]
    out = tmp_path / "a.exr"
    ran = volcli("render", *source, "-o", out)
    assert ran.code == 0, ran.err
    channels, _ = read_exr(out)
    asked = [text for x, y in pixels for text in ("--pixel", f"{x},{y}")]
    for (x, y), ray in zip(pixels, probed(out, *asked), strict=True):
        rgb = [float(channels[c][y, x]) for c in "RGB"]
        assert max(rgb) > 0.02, "there is something to see"
        np.testing.assert_allclose(ray["radiance"], rgb, rtol=0, atol=3e-4 * max(rgb))
        np.testing.assert_allclose(ray["rules"][0]["radiance"], rgb, rtol=1e-6)
        assert ray["optical_depth"] == pytest.approx(channels["optical_depth.Y"][y, x], rel=1e-6)
        assert ray["rules"][0]["error"] < 1e-10


@pytest.mark.needs_jit
def test_a_ray_is_followed_from_any_point_in_any_direction(tmp_path):
    np.save(tmp_path / "slab.npy", np.ones((9, 9, 9), np.float32))
    (ray,) = probed(tmp_path / "slab.npy", "--ray", "4,4,-6,0,0,20", "--step", "2", "--step", "4")
    assert ray["optical_depth"] == pytest.approx(9, rel=1e-12)
    assert ray["direction"] == [0, 0, 1]
    assert [rule["rule"] for rule in ray["rules"]] == [
        "exact",
        "midpoint 2",
        "midpoint 4",
        "exact, nearest",
    ]
    assert ray["rules"][1]["samples"]["t"] == pytest.approx([6, 8, 10, 12, 14])


@pytest.mark.needs_jit
def test_the_tables_are_printed_and_written(tmp_path):
    write_ball(tmp_path / "ball.npz")
    out = tmp_path / "ray.csv"
    plot = tmp_path / "ray.png"
    ran = volcli("probe", tmp_path / "ball.npz", "--pixel", "400,300", "--pixel", "0,0",
                 "--csv", out, "--plot", plot)  # fmt: skip
    assert ran.code == 0, ran.err
    for text in ("pixel 400,300", "T falls to 0.95 at", "weight", "met", "midpoint 1", "meets no"):
        assert text in ran.out
    assert plot.read_bytes().startswith(b"\x89PNG")
    rows = list(csv.DictReader(io.StringIO(out.read_text())))
    assert list(rows[0]) == ["ray", *COLUMNS]
    (ray, _) = probed(tmp_path / "ball.npz", "--pixel", "400,300", "--pixel", "0,0")
    assert [float(row["tau"]) for row in rows if row["ray"] == "0"] == ray["cells"]["tau"]
    assert ray["cells"]["T"][-1] == pytest.approx(ray["transmittance"], rel=1e-12)


@pytest.mark.needs_jit
def test_a_pixel_of_several_samples_is_told_to_be_their_mean(tmp_path):
    write_ball(tmp_path / "ball.npz")
    ran = volcli("probe", tmp_path / "ball.npz", "--pixel", "4,3", "--set", "camera.samples=4",
                 "--size", "8x6")  # fmt: skip
    assert ran.code == 0
    assert "mean of 4 rays" in ran.err


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        ("ball.npz", 2, "which ray"),
        ("ball.npz --pixel 1", 2, "--pixel 1: give 2 numbers"),
        ("ball.npz --pixel 1.5,2", 2, "whole numbers"),
        ("ball.npz --pixel 800,2", 2, "the picture is 800x600"),
        ("ball.npz --ray 0,0,0,0,0,0", 2, "no direction"),
        ("ball.npz --ray 0,0,0,1", 2, "give 6 numbers"),
        ("ball.npz --pixel 1,1 --step 0", 2, "--step"),
        ("ball.npz --pixel 1,1 --plot p.gif", 2, "unknown extension"),
        ("ball.npz --pixel 1,1 --csv no/p.csv", 4, "does not exist"),
        ("ball.npz --pixel 1,1 --eye 1,2", 2, "--eye 1,2"),
        ("ball.npz --pixel 1,1 --set no.no=1", 2, "unknown key 'no'"),
        ("gone.vdb --pixel 1,1", 3, "no such file"),
        ("plain.exr --pixel 1,1", 2, "holds no job"),
    ],
)
def test_a_mistake_of_probe_is_one_line(tmp_path, monkeypatch, arguments, code, message):
    from volcli.images import write_exr

    monkeypatch.chdir(tmp_path)
    write_ball(tmp_path / "ball.npz")
    write_exr("plain.exr", {"A": np.ones((2, 2))}, {})
    ran = volcli("probe", *arguments.split())
    assert (ran.code, ran.out) == (code, "")
    assert message in ran.err
    assert ran.err.count("\n") == 1
