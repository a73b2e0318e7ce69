"""`--target-error`: the step that a pilot chooses, what it says of it, and how the picture is."""

import json
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commandline import SAMPLES, VOLUMES, volcli, write_ball
from vdbwriter import Grid, write_vdb

from volcli import calibrate as module
from volcli.batch.tiles import Canvas, windows
from volcli.calibrate import STEPS, Pilot, calibrate, pilot_rays
from volcli.camera import make_camera
from volcli.config import load_job, make_job
from volcli.errors import VolcliError
from volcli.images import read_exr
from volcli.run import load, prepare, render_loaded, run
from volcli.scene import scene_box

CLOUD = SAMPLES / "cloud.vdb"
SMOKE = VOLUMES / "real" / "smoke.vdb"
WDAS = VOLUMES / "real" / "wdas_cloud_sixteenth.vdb"
SMALL = ("--size", "24x16")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The user stands in a folder with a ball and nothing else."""
    monkeypatch.chdir(tmp_path)
    write_ball(tmp_path / "ball.npz")
    return tmp_path


def loaded(path, size=(24, 16), settings=()):
    job = load_job(path, [("camera.resolution", size)], settings)
    prepared = prepare(job, writes=False)
    return prepared, load(prepared)


def view(prepared, scene):
    return make_camera(prepared.job.camera, scene_box(scene.scene))


def chosen(path, error, size=(24, 16), settings=()):
    """The pilot of a picture."""
    prepared, scene = loaded(path, size, [*settings, f"quadrature.target_error={error}"])
    return calibrate(scene.scene, prepared.plan, view(prepared, scene))


def off_by(path, error, size, settings=()):
    """(h, w): the error of a calibrated picture, of all its pixels, as a certified one would be."""
    prepared, scene = loaded(path, size, settings)
    exact = render_loaded(prepared, scene).result
    prepared, _ = loaded(path, size, [*settings, f"quadrature.target_error={error}"])
    rendered = render_loaded(prepared, scene)
    result = rendered.result
    off = np.abs(result.transmittance.astype(np.float64) - exact.transmittance)
    light = np.abs(result.radiance.astype(np.float64) - exact.radiance).max(axis=-1)
    return rendered, np.maximum(off, light / module.brightest_light(scene.scene, False))


# -- what it promises -----------------------------------------------------------------------------


@pytest.mark.needs_jit
@pytest.mark.parametrize("error", [1e-1, 1e-2, 1 / 255, 1e-3])
@pytest.mark.parametrize("path", [CLOUD, SMOKE, WDAS], ids=lambda path: path.stem)
def test_fewer_than_one_pixel_in_a_thousand_is_above_the_target(path, error):
    if not path.exists():
        pytest.skip(f"{path} is not there")
    rendered, off = off_by(path, error, (600, 450))
    assert np.count_nonzero(off > error) < off.size / 1000
    if error >= 1e-2:
        assert rendered.pilot.step_voxels is not None, "a coarse target is met by a step"


@pytest.mark.needs_jit
def test_colour_that_varies_counts_as_well():
    path = SAMPLES / "colored_smoke.vdb"
    rendered, off = off_by(path, 1 / 255, (300, 200), ["color.grid=Cd"])
    assert rendered.pilot.step_voxels is not None
    assert np.count_nonzero(off > 1 / 255) < off.size / 1000


@pytest.mark.needs_jit
def test_the_next_longer_step_was_off_by_too_much():
    pilot = chosen(CLOUD, 0.01, (300, 200))
    *longer, last = pilot.trials
    assert last.step_voxels == pilot.step_voxels
    assert last.rays == pilot.rays
    assert last.above <= pilot.rays // module.SPARED
    assert [trial.step_voxels for trial in longer] == list(STEPS[: len(longer)])
    assert all(trial.largest > 0.9 * 0.01 for trial in longer)


@pytest.mark.needs_jit
def test_the_smaller_the_error_the_shorter_the_step_until_exact_is_faster():
    steps = [chosen(CLOUD, error, (300, 200)).step_voxels for error in (0.3, 0.1, 0.01, 1e-3)]
    assert None not in steps
    assert steps == sorted(steps, reverse=True)
    assert steps[0] > steps[-1]
    assert chosen(CLOUD, 1e-6, (300, 200)).step_voxels is None


@pytest.mark.needs_jit
def test_error_of_colour_alone_shortens_the_step(tmp_path):
    # Density is constant, so that any step gives its optical depth; colour comes and goes.
    x = np.indices((48, 48, 48))[2]
    stripes = np.repeat((0.5 + 0.5 * np.sin(1.3 * x))[..., None], 3, axis=-1)
    density = np.zeros((48, 48, 48), np.float32)
    density[4:-4, 4:-4, 4:-4] = 0.05
    np.savez(tmp_path / "a.npz", density=density, Cd=stripes.astype(np.float32))
    nearest = ["density.interpolation=nearest"]
    plain = chosen(tmp_path / "a.npz", 0.02, settings=nearest)
    coloured = chosen(tmp_path / "a.npz", 0.02, settings=[*nearest, "color.grid=Cd"])
    assert coloured.step_voxels is None or coloured.step_voxels < plain.step_voxels


def test_a_region_that_is_one_cell_is_rendered_exactly(tmp_path):
    # A constant of 128^3 voxels is one cell and many samples.
    write_vdb(tmp_path / "a.vdb", [Grid(tiles={((0, 0, 0), 128): (0.01, True)})])
    pilot = chosen(tmp_path / "a.vdb", 1e-4)
    assert pilot.step_voxels is None
    assert pilot.rays > 0


def test_what_is_not_a_number_is_above_any_target(folder, monkeypatch):
    def errors(result, truth, brightest):
        return np.full(len(result.radiance), np.nan)

    monkeypatch.setattr(module, "errors", errors)
    pilot = chosen(folder / "ball.npz", 0.1)
    assert pilot.step_voxels is None
    assert all(trial.above == trial.rays for trial in pilot.trials)


# -- its rays -------------------------------------------------------------------------------------


def test_a_small_picture_is_followed_through_every_pixel_that_meets_the_box(folder):
    prepared, scene = loaded(folder / "ball.npz")
    camera = view(prepared, scene)
    origins, directions = pilot_rays(scene.scene, camera)
    every = camera.rays(slice(None), slice(None))
    hit = module.meets(scene_box(scene.scene), *every)
    np.testing.assert_array_equal(directions, every[1][hit])
    assert 0 < len(origins) < 24 * 16


def test_the_rays_of_a_large_picture_are_spread_over_it_evenly(folder):
    prepared, scene = loaded(folder / "ball.npz", (2000, 1500))
    camera = view(prepared, scene)
    _, directions = pilot_rays(scene.scene, camera)
    assert module.RAYS * 0.8 < len(directions) < module.RAYS * 1.2
    assert len(np.unique(directions, axis=0)) > 0.99 * len(directions)
    # As many in each quarter of what is met.
    right, up = directions @ camera.right > 0, directions @ camera.upward > 0
    for quarter in (right & up, right & ~up, ~right & up, ~right & ~up):
        assert quarter.mean() == pytest.approx(0.25, abs=0.02)


def test_rays_meet_a_box_as_a_walk_along_them_does():
    rng = np.random.default_rng(3)
    box = np.array([[-1.0, -2.0, 0.5], [1.0, 0.0, 3.0]])
    origins = rng.uniform(-4, 4, (300, 3))
    directions = rng.normal(size=(300, 3))
    directions[:60, 0] = 0.0  # parallel to faces
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    along = np.linspace(0, 14, 20_001)[:, None, None]
    points = origins + along * directions
    walked = ((points >= box[0]) & (points <= box[1])).all(axis=-1).any(axis=0)
    found = module.meets(box, origins, directions)
    grazing = found & ~walked  # the walk steps over corners
    assert not (walked & ~found).any()
    assert np.count_nonzero(grazing) < 5


def test_where_nothing_is_met_there_is_nothing_to_choose(folder):
    pilot = chosen(
        folder / "ball.npz", 0.1, settings=["camera.eye=[0,0,50]", "camera.target=[0,0,90]"]
    )
    assert (pilot.rays, pilot.step_voxels) == (0, None)
    assert "no ray" in pilot.said


def test_an_empty_volume_is_rendered(folder):
    np.save("empty.npy", np.zeros((4, 4, 4), np.float32))
    ran = volcli("render", "empty.npy", "-o", "a.exr", *SMALL, "--target-error", "0.1", "--json")
    assert ran.code == 0, ran.err
    assert json.loads(ran.out)["rule"] == "calibrated 0.1: exact"


# -- the same every time --------------------------------------------------------------------------


@pytest.mark.needs_jit
def test_neither_threads_nor_a_part_of_the_picture_change_the_step():
    prepared, scene = loaded(CLOUD, (300, 200), ["quadrature.target_error=0.01"])
    camera = view(prepared, scene)
    one, three = (calibrate(scene.scene, prepared.plan, camera, n) for n in (1, 3))
    assert one == three
    part = render_loaded(prepared, scene, window=(280, 180, 20, 20))
    assert part.pilot == one


def test_tiles_of_one_picture_take_one_step_and_are_the_picture_to_the_bit(folder):
    prepared, scene = loaded(folder / "ball.npz", (24, 16), ["quadrature.target_error=0.05"])
    whole = render_loaded(prepared, scene)
    canvas = Canvas(prepared.job, 10)
    for window in windows(prepared.job, 10):
        canvas.put(window, render_loaded(prepared, scene, window=window))
    picture = canvas.picture()
    assert picture.rule == whole.rule
    assert picture.result.radiance.tobytes() == whole.result.radiance.tobytes()


def test_tiles_that_chose_different_rules_are_no_picture(folder):
    prepared, scene = loaded(folder / "ball.npz", (24, 16), ["quadrature.target_error=0.05"])
    canvas = Canvas(prepared.job, 16)
    first, second = windows(prepared.job, 16)
    part = render_loaded(prepared, scene, window=first)
    canvas.put(first, part)
    with pytest.raises(VolcliError, match=r"tiles chose different rules.*quadrature\.step"):
        canvas.put(second, replace(part, rule="calibrated 0.05: midpoint 0.1"))


def test_a_batch_calibrates_each_of_its_pictures(folder):
    (folder / "batch.toml").write_text(
        "[defaults.density]\nfile = 'ball.npz'\n"
        "[defaults.camera]\nresolution = [24, 16]\n"
        "[defaults.output]\nimage = 'e{quadrature.target_error}.exr'\n"
        "[sweep]\nquadrature.target_error = [0.2, 0.001]\n"
    )
    ran = volcli("batch", "batch.toml", "--workers", "1", "--tile", "16")
    assert ran.code == 0, ran.err
    rules = [read_exr(f"e{e}.exr")[1]["volcli:rule"] for e in ("0.2", "0.001")]
    assert rules[0].startswith("calibrated 0.2: midpoint")
    assert rules[1].startswith("calibrated 0.001: ")
    volcli("render", "ball.npz", "-o", "whole.exr", *SMALL, "--target-error", "0.2")
    whole, tiled = (read_exr(name) for name in ("whole.exr", "e0.2.exr"))
    assert whole[1]["volcli:rule"] == rules[0]
    assert whole[0]["A"].tobytes() == tiled[0]["A"].tobytes()


# -- what is said of it ---------------------------------------------------------------------------


def test_the_header_holds_the_step_what_was_asked_for_and_what_the_pilot_saw(folder):
    ran = volcli("render", "ball.npz", "-o", "a.exr", *SMALL, "--target-error", "0.1", "--json")
    printed = json.loads(ran.out)
    step = printed["pilot"]["step"]
    assert printed["rule"] == f"calibrated 0.1: midpoint {step:g}"
    assert set(printed["seconds"]) == {"load", "pilot", "compile", "render", "write"}
    channels, header = read_exr("a.exr")
    assert header["volcli:rule"] == printed["rule"]
    assert header["volcli:target_error"] == pytest.approx(0.1)
    assert header["volcli:pilot"] == f"an estimate: {printed['pilot']['said']}"
    job = tomllib.loads(str(header["volcli:job"]))
    assert job["quadrature"] == {"rule": "midpoint", "step": step}
    del job["output"]["image"]
    prepared = prepare(make_job(job, [("output.image", Path("b.exr"))]))
    run(prepared, load(prepared))
    assert {n: v.tobytes() for n, v in read_exr("b.exr")[0].items()} == {
        n: v.tobytes() for n, v in channels.items()
    }


def test_the_summary_calls_it_an_estimate(folder):
    ran = volcli("render", "ball.npz", "-o", "a.exr", *SMALL, "--target-error", "0.1")
    _, rule, estimate, seconds = ran.out.splitlines()
    assert rule.startswith("calibrated 0.1: midpoint")
    assert estimate.startswith("an estimate: ")
    assert "rays of this picture were off by" in estimate
    assert ", pilot " in seconds


def test_explain_says_that_a_pilot_will_choose(folder):
    ran = volcli("render", "ball.npz", "--explain", "--target-error", "0.1")
    assert "rule: calibrated 0.1" in ran.out
    assert "a pilot finds good enough" in " ".join(ran.out.split())


def test_a_target_of_0_is_exact(folder):
    ran = volcli("render", "ball.npz", "-o", "a.exr", *SMALL, "--target-error", "0", "--json")
    printed = json.loads(ran.out)
    assert printed["rule"] == "exact"
    assert "pilot" not in printed


def test_a_pilot_says_what_it_saw_whatever_that_was():
    trial = module.Trial
    seen = {
        (): "fewer cells than any step",
        (trial(8.0, 512, 0.2, 9),): "too much, and shorter steps are no faster than exact",
    }
    for trials, text in seen.items():
        assert text in Pilot(0.1, 900, trials, None).said
    said = Pilot(0.1, 8192, (trial(8.0, 512, 0.2, 9), trial(5.6, 8192, 0.12, 1)), 5.6).said
    assert said == (
        "8,192 rays of this picture were off by up to 0.12 at step 5.6 (1 of them by more than is "
        "wanted), by 0.2 or more at 8"
    )
