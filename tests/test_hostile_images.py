"""Images that are made to do harm: headers that lie, jobs in them that are none, names that are no
text.
"""

import json

import numpy as np
import pytest
from commandline import SAMPLES, volcli

from volcli.images import write_exr

JOBS = {
    "no tables": "background = 3\ncamera = 'x'\ndensity = [1]",
    "a word for a colour": "[background]\ncolor = 'red'",
    "a colour of two": "[background]\ncolor = [1, 2]",
    "a colour that is not finite": "[background]\ncolor = [nan, 0, inf]",
    "a number for a colour": "[background]\ncolor = 7",
    "a number for an image": "[background]\nimage = 7",
    "an image that is not there": "[background]\nimage = 'gone\\u0000.png'",
    "samples that are no number": "[camera]\nsamples = [1]",
    "a scale beyond all": "[density]\nscale = " + "9" * 4000,
    "a scale that is no number": "[density]\nscale = nan",
    "nesting": "a = " + "[" * 5000,
    "no TOML": "\x1b[2J = = =",
}


@pytest.fixture
def picture(tmp_path):
    def make(job, **header):
        planes = {name: np.linspace(0, 1, 192, dtype=np.float32).reshape(12, 16) for name in "RGBA"}
        path = tmp_path / "a.exr"
        write_exr(path, planes, {"volcli:job": job, **header})
        return path

    return make


@pytest.mark.parametrize("case", JOBS)
def test_a_header_that_holds_another_job_than_volcli_writes_is_no_defect(case, picture, tmp_path):
    path = picture(JOBS[case])
    for command in (
        ("inspect", path),
        ("inspect", path, "--json"),
        ("inspect", path, "--html", tmp_path / "a.html"),
        ("compare", path, path, "--background", "1,1,1"),
        ("recomposite", path, "--background", "1,0,0", "-o", tmp_path / "b.exr"),
        ("probe", path, "--pixel", "1,1"),
        ("render", SAMPLES / "rotated.vdb", "--explain", "--background", path),
    ):
        ran = volcli(*command)
        assert ran.code in (0, 2, 3), f"{command}: {ran.err}"
        assert "Traceback" not in ran.err
        if ran.code:
            assert ran.err.count("\n") == 1
            assert len(ran.err) < 1100


def test_a_header_cannot_give_orders_to_a_terminal(picture):
    path = picture("[density]\nscale = 2.0", **{"volcli:rule": "exact\x1b]0;owned\x07"})
    for options in ((), ("--json",)):
        ran = volcli("inspect", path, *options)
        assert ran.code == 0
        assert "\x1b]" not in ran.out + ran.err
        assert "\x07" not in ran.out + ran.err


def test_a_name_of_an_array_cannot_give_orders_to_a_terminal(tmp_path):
    path = tmp_path / "a.npz"
    names = ["\x1b[2J", "\x1b[3J", "x" * 300]
    np.savez(path, **dict.fromkeys(names, np.ones((3, 3, 3), np.float32)))
    ran = volcli("info", path, "--json")
    labels = [grid["grid"] for grid in json.loads(ran.out)["grids"]]
    assert labels == ["�[2J", "�[3J", "x" * 200]
    assert "\x1b" not in volcli("info", path, "--stats").out
    refused = volcli("render", path, "--grid", "\x1b[4J", "-o", tmp_path / "a.exr")
    assert refused.code in (2, 3)
    assert "\x1b" not in refused.err
    assert volcli("render", path, "--grid", labels[0], "--explain").code == 0


def test_channels_whose_names_are_no_text_are_refused(picture, tmp_path):
    path = picture("")
    raw = path.read_bytes().replace(b"G\0\2\0\0\0", b"\xff\0\2\0\0\0", 1)
    path.write_bytes(raw)
    for command in ("inspect", "recomposite"):
        options = (
            ("--background", "1,1,1", "-o", tmp_path / "b.exr") if command != "inspect" else ()
        )
        ran = volcli(command, path, *options)
        assert ran.code == 2, ran.err
        assert "the names of its channels are no text" in ran.err


def test_an_image_that_says_to_be_larger_than_the_memory_is_refused(picture):
    path = picture("")
    window = np.array([0, 0, 15, 11], "<i4").tobytes()
    huge = np.array([0, 0, 149_999, 149_999], "<i4").tobytes()
    path.write_bytes(path.read_bytes().replace(window, huge))
    ran = volcli("inspect", path)
    assert ran.code == 2, ran.err
    assert "150000x150000 image: its pixels need about 360.0 GB of memory" in ran.err or (
        "not a readable image" in ran.err
    )
