"""Jobs of volumes that are not ours: their pictures are right where the files are at hand."""

import numpy as np
import pytest
from commandline import ROOT, VOLUMES, volcli

from volcli.config import load_job
from volcli.images import read_exr

REAL = VOLUMES / "real"
FILES = {
    "density_and_heat": {"density.file": "density_and_heat.vdb"},
    "oiio_sphere_Cd": {"density.file": "oiio_sphere.vdb", "color.file": "oiio_sphere_Cd.vdb"},
}


def test_each_job_says_in_its_comment_which_files_it_needs():
    jobs = {path.stem: path for path in (ROOT / "configs" / "elsewhere").glob("*.toml")}
    assert set(jobs) == set(FILES)
    for name, files in FILES.items():
        text = jobs[name].read_text(encoding="utf-8")
        assert all(f"--set {key}={file}" in text for key, file in files.items())


@pytest.fixture
def picture(tmp_path):
    """A function of a job's name to the channels of its picture, at a sixth of its size."""

    def render(name):
        if not REAL.is_dir():
            pytest.skip("the files of other programs are not here")
        job = ROOT / "configs" / "elsewhere" / f"{name}.toml"
        settings = [f"{key}={REAL / file}" for key, file in FILES[name].items()]
        width, height = load_job(job, settings=settings).camera.size
        ran = volcli(
            *("render", job, "-o", tmp_path / "a.exr", "--size", f"{width // 6}x{height // 6}"),
            *(word for setting in settings for word in ("--set", setting)),
        )
        assert ran.code == 0, ran.err
        return read_exr(tmp_path / "a.exr")[0]

    return render


@pytest.mark.needs_jit
def test_the_flame_is_yellow_below_grey_smoke(picture):
    channels = picture("density_and_heat")
    rgb = np.stack([channels[c] for c in "RGB"], axis=-1)
    y, x = np.unravel_index(rgb[..., 0].argmax(), rgb.shape[:2])
    height, width = rgb.shape[:2]
    assert 0.7 * height < y < 0.95 * height
    assert 0.4 * width < x < 0.6 * width
    assert rgb[y, x, 0] > 1 > rgb[y, x, 2]
    assert rgb[y, x, 0] > 2 * rgb[y, x, 1] > 4 * rgb[y, x, 2]
    above = slice(height // 2, 2 * height // 3)
    smoke = rgb[above][channels["transmittance.Y"][above] < 0.3]
    assert len(smoke) > 200
    np.testing.assert_allclose(smoke[:, 0] / smoke[:, 1], 1.0, atol=0.15)


@pytest.mark.needs_jit
def test_the_ball_is_coloured_by_its_place(picture):
    """Seen from where X, Y and Z are above 0: the middle is grey, and red is to the right."""
    channels = picture("oiio_sphere_Cd")
    rgb = np.stack([channels[c] for c in "RGB"], axis=-1)
    height, width = rgb.shape[:2]
    inside = channels["transmittance.Y"] < 0.01
    assert 0.2 < inside.mean() < 0.6
    columns, rows = np.meshgrid(np.arange(width), np.arange(height))
    for c, along in ((0, columns), (1, -rows)):
        assert np.corrcoef(along[inside], rgb[inside][:, c])[0, 1] > 0.9
    assert np.ptp(rgb[height // 2, width // 2]) < 0.6
    assert rgb.min() < -0.5, "negative colours are kept"
