"""The benchmarks' own arithmetic, and what they make of a renderer that is not there."""

import json

import numpy as np
import pytest

from benchmarks import common, peers, report, scaling, workers


def test_a_line_is_found_and_how_far_measurements_lie_from_it():
    x = [1e3, 1e4, 1e6]
    line = scaling.fit(x, [5 + 2 * v for v in x])
    assert line["at_zero"] == pytest.approx(5)
    assert line["slope"] == pytest.approx(2)
    assert line["worst"] < 1e-12
    off = scaling.fit(x, [2e3, 2e4, 3e6])
    assert off["worst"] > 0.05


def test_a_line_costs_nothing_at_zero_rather_than_less_than_nothing():
    line = scaling.fit([1.0, 2.0, 3.0], [0.9, 2.1, 3.6])
    assert line["at_zero"] == 0.0
    assert line["slope"] == pytest.approx(1.1, rel=0.1)


def test_given_rays_are_those_of_volclis_camera():
    from volcli import schema
    from volcli.camera import make_camera

    eye, target = common.view_of(np.array([[0.0, 0.0, 0.0], [10.0, 20.0, 30.0]]), 30.0)
    scene = {"eye": eye, "target": target, "fov": 30.0, "size": 5}
    camera = make_camera(
        schema.Camera(eye=tuple(eye), target=tuple(target), fov=30.0, resolution=(5, 5)),
        np.zeros((2, 3)),
    )
    expected = camera.rays(slice(None), slice(None))[1]
    np.testing.assert_allclose(workers._directions(scene).T, expected, atol=1e-15)


def test_a_renderer_that_is_not_installed_is_listed_as_such(tmp_path, monkeypatch):
    scene = tmp_path / "scene.json"
    scene.write_text(json.dumps({}))
    monkeypatch.setenv("PATH", "")
    with pytest.raises(peers.GoneError, match="not installed: no vdb_render"):
        peers.Process("vdb_render", scene, tmp_path)


def test_a_renderer_that_fails_is_listed_with_its_last_words(tmp_path):
    scene = tmp_path / "scene.json"
    scene.write_text(json.dumps({"threads": 1, "vdb": str(tmp_path / "none.vdb")}))
    with pytest.raises(peers.GoneError, match=r"failed: .*no such file"):
        peers.Process("volcli", scene, tmp_path)


@pytest.mark.parametrize(
    "make", [report.accuracy, report.peers, report.render, report.load, report.scaling]
)
def test_the_readme_holds_what_the_results_say(make):
    results = json.loads((common.RESULTS / f"{make.__name__}.json").read_text(encoding="utf-8"))
    name = make.__name__
    assert f"<!-- {name} -->\n{make(results)}\n<!-- /{name} -->" in report.README.read_text(
        encoding="utf-8"
    )
