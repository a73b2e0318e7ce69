"""The samples and their jobs: what they hold, and that their pictures are right."""

import pytest
from commandline import ROOT, SAMPLES

from benchmarks.accuracy import compare
from volcli.grids import open_volume

JOBS = sorted((ROOT / "configs").glob("*.toml"))


@pytest.mark.needs_jit
@pytest.mark.parametrize("job", JOBS, ids=lambda path: path.stem)
def test_the_picture_of_each_job_agrees_with_the_reference(job):
    """OpenVDB's own files, colour on the same lattice and on a coarser one, a rotated lattice."""
    errors = compare(job, rays=40, steps=())["exact"]
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
