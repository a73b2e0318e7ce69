"""Texts that are made to do harm: job files, batch files, cameras, and files that are none."""

import json
import os
import time

import pytest
from commandline import SAMPLES, volcli, write_ball

from volcli.texts import DEEPEST, LARGEST, parse_json, parse_toml, read_text

HARMFUL = {
    "arrays in arrays": ("[density]\nscale = " + "[" * 100_000, "nested deeper than 32"),
    "tables in tables": ("[density]\nscale = " + "{a=" * 100_000, "nested deeper than 32"),
    "a key of many parts": ("a" + ".a" * 200_000 + " = 1", "nested deeper than 32"),
    "the same with spaces": ("a" + " . a" * 200_000 + " = 1", "nested deeper than 32"),
    "a heading of many parts": ("[" + "a." * 200_000 + "a]", "nested deeper than 32"),
    "keys that add up": ("[a" + ".a" * 30 + "]\na" + ".a" * 30 + " = 1", "nested deeper than 32"),
    "a number of many digits": ("[density]\nscale = " + "9" * 100_000, "4300 digits"),
    "much of nothing": ("#" * (LARGEST + 1), "cannot be read: larger than the 4 MiB"),
    "no text": ("\0\1\2" * 1000, "is not TOML"),
}


@pytest.mark.parametrize("command", [("render",), ("probe", "--pixel", "0,0"), ("batch",)])
@pytest.mark.parametrize("case", HARMFUL)
def test_a_job_or_batch_that_is_made_to_do_harm_is_refused_in_one_line(tmp_path, case, command):
    text, message = HARMFUL[case]
    path = tmp_path / "a.toml"
    path.write_text(text)
    begin = time.process_time()
    ran = volcli(command[0], path, *command[1:])
    assert time.process_time() - begin < 10
    assert ran.code == 2
    assert ran.err.startswith(f"volcli: {path}: ")
    assert message in ran.err
    assert ran.err.count("\n") == 1


def test_a_setting_is_parsed_with_no_more_faith():
    ran = volcli("render", "a.vdb", "--set", "density.scale=" + "[" * 100_000)
    assert ran.code == 2
    assert ran.err.count("\n") == 1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"frames": ' + "[" * 200_000, "nested deeper than 32"),
        ('{"frames": ' + '[{"a": ' * 40 + "1" + "}]" * 40 + "}", "nested deeper than 32"),
        ('{"frames": [], "w": ' + "9" * 10_000 + "}", "4300 digits"),
    ],
)
def test_cameras_that_are_made_to_do_harm_are_refused_in_one_line(tmp_path, text, message):
    path = tmp_path / "cameras.json"
    path.write_text(text)
    ran = volcli(
        "render", SAMPLES / "rotated.vdb", "-o", tmp_path / "a.exr",
        "--set", f"camera.transforms={json.dumps(str(path))}",
    )  # fmt: skip
    assert ran.code == 2
    assert ran.err.startswith(f"volcli: {path}: is not JSON: ")
    assert message in ran.err


def test_texts_are_nested_as_deep_as_they_may_be_and_keys_are_as_long():
    toml = "a = " + "[" * (DEEPEST - 1) + "]" * (DEEPEST - 1)
    assert parse_toml(toml)
    with pytest.raises(ValueError, match="nested"):
        parse_toml(toml.replace("[", "[[").replace("]", "]]"))
    assert parse_json(toml.removeprefix("a = ")) == parse_toml(toml)["a"]
    assert parse_toml(".".join("a" * (DEEPEST - 1)) + " = 1")
    numbers = f"a = [{', '.join(['0.25'] * 1000)}]\nb = '{'../' * 100}x.vdb'"
    assert len(parse_toml(numbers)["a"]) == 1000


def test_a_byte_order_mark_is_no_part_of_a_text(tmp_path):
    path = tmp_path / "a.toml"
    path.write_bytes(b"\xef\xbb\xbfa = 1")
    assert parse_toml(read_text(path)) == {"a": 1}


@pytest.fixture(params=["a pipe", "a device"])
def endless(request, tmp_path):
    """Makes what has no end under a name."""

    def make(name):
        path = tmp_path / name
        if request.param == "a pipe":
            os.mkfifo(path)
        else:
            path.symlink_to("/dev/zero")
        return path

    return make


READERS = {
    "a volume": ("render {}.vdb -o out.exr", 3),
    "an array": ("render {}.npy -o out.exr", 3),
    "an archive": ("render {}.npz -o out.exr", 3),
    "a volume of info": ("info {}.vdb", 3),
    "a volume of OpenVDB": ("info {}.vdb --reader openvdb", 3),
    "a job": ("render {}.toml -o out.exr", 2),
    "a batch": ("batch {}.toml", 2),
    "cameras": ('render ball.npz -o out.exr --set camera.transforms="{}.json"', 2),
    "a background": ("render ball.npz -o out.exr --background {}.png", 2),
    "an image": ("inspect {}.exr", 2),
    "two images": ("compare {}.exr {}.exr", 2),
    "a picture": ("recomposite {}.exr --background 1,1,1 -o out.exr", 2),
    "a picture's job": ("probe {}.exr --pixel 0,0", 2),
}


@pytest.mark.parametrize("case", READERS)
def test_a_file_that_has_no_end_is_refused_and_not_waited_for(tmp_path, monkeypatch, endless, case):
    monkeypatch.chdir(tmp_path)
    write_ball(tmp_path / "ball.npz")
    command, code = READERS[case]
    words = command.split()
    (suffix,) = {word.split("{}")[1].rstrip('"') for word in words if "{}" in word}
    endless(f"a{suffix}")
    ran = volcli(*(word.replace("{}", "a") for word in words))
    assert ran.code == code, ran.err
    assert "regular file" in ran.err
    assert ran.err.count("\n") == 1
    assert not (tmp_path / "out.exr").exists()
