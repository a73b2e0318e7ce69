"""The samples and their jobs: what they hold, and that their pictures are right."""

import numpy as np
import pytest
from commandline import ROOT, SAMPLES

from benchmarks.accuracy import compare
from volcli.camera import make_camera
from volcli.config import load_job
from volcli.grids import open_volume
from volcli.probe.rules import seen_by
from volcli.probe.walk import walk
from volcli.run import load, prepare

BY_VALUE = ["fire", "temperature"]
PLAIN = sorted({path.stem for path in (ROOT / "configs").glob("*.toml")} - set(BY_VALUE))


@pytest.mark.needs_jit
@pytest.mark.parametrize("name", BY_VALUE)
def test_the_picture_of_a_job_by_value_agrees_with_the_walk_of_its_rays(name, tmp_path):
    """Ramps, blackbodies, emission and transfer functions, which the reference does not know.

    Light by value bends where a table does, and there four nodes a cell are off.
    """
    out = [("output.image", tmp_path / "out.exr")]  # the job's own folder need not be there
    prepared = prepare(load_job(ROOT / "configs" / f"{name}.toml", out), writes=False)
    scene = load(prepared).scene
    camera = make_camera(prepared.job.camera, scene.density.world_box())
    origins, directions = camera.rays(slice(None), slice(None))
    chosen = np.random.default_rng(1).choice(len(origins), 60, replace=False)
    walked = [walk(scene, False, origins[n], directions[n]) for n in chosen]
    seen = [seen_by(scene, prepared.plan, origins[n], directions[n]) for n in chosen]
    met = [(a, b) for a, b in zip(walked, seen, strict=True) if a is not None]
    assert len(met) > 20
    assert max(a.light.sum(axis=0).max() for a, _ in met) > 0.1
    for a, b in met:
        light = a.light.sum(axis=0)
        assert b.tau == pytest.approx(a.optical_depth, rel=1e-10, abs=1e-14)
        assert np.abs(b.radiance - light).max() <= 3e-4 * light.max()


@pytest.mark.needs_jit
@pytest.mark.parametrize("name", PLAIN)
def test_the_picture_of_each_other_job_agrees_with_the_reference(name):
    """OpenVDB's own files, colour on the same lattice and on a coarser one, a rotated lattice."""
    errors = compare(ROOT / "configs" / f"{name}.toml", rays=40, steps=())["exact"]
    assert errors["transmittance"] < 1e-12
    assert errors["optical_depth_relative"] < 1e-10
    assert errors["distance_relative"] < 1e-7
    assert errors.get("radiance_relative_to_max", 0) < 1e-5


@pytest.mark.parametrize(
    "name, grids",
    [
        ("cloud", ["density", "Cd"]),
        ("explosion", ["density", "temperature", "flame", "Cd"]),
        ("colored_smoke", ["density", "Cd"]),
        ("rotated", ["density"]),
    ],
)
def test_each_sample_holds_the_grids_that_it_is_there_to_show(name, grids):
    volume = open_volume(SAMPLES / f"{name}.vdb")
    assert [header.label for header in volume.headers] == grids
    assert all(header.refusal is None for header in volume.headers)


def test_the_samples_stay_small():
    assert sum(path.stat().st_size for path in SAMPLES.glob("*.vdb")) < 3.3e6
