"""Terminals that are narrow, and names that are made to fill them or to give them orders."""

import re

import pytest
from commandline import SAMPLES, volcli, write_grid

from volcli.cli.table import in_short, table

BALL, CLOUD = SAMPLES / "rotated.vdb", SAMPLES / "colored_smoke.vdb"
VIEW = ("--size", "32x24", "--density-scale", 20)


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    """Two pictures, and a batch."""
    folder = tmp_path_factory.mktemp("pictures")
    for name, options in (("a", ()), ("b", ("--step", 2))):
        assert volcli("render", BALL, "-o", folder / f"{name}.exr", *VIEW, *options).code == 0
    long = "a_name_that_is_longer_than_half_a_terminal"
    (folder / "batch.toml").write_text(
        f'defaults = {{density.file = "{BALL}", output.image = "{long}_{{density.scale}}.exr"}}\n'
        "sweep = {density.scale = [1.0, 2.0]}\n"
    )
    return folder


@pytest.mark.parametrize(
    "command",
    [
        ("info", CLOUD),
        ("info", CLOUD, "--stats"),
        ("render", CLOUD, "--explain", "--color-grid", "Cd"),
        ("probe", BALL, "--pixel", "16,12", *VIEW, "--step", 2),
        ("inspect", "a.exr"),
        ("inspect", "a.exr", "b.exr"),
        ("compare", "a.exr", "b.exr"),
        ("batch", "batch.toml", "--dry-run"),
    ],
    ids=lambda command: " ".join(str(word) for word in command if "/" not in str(word)),
)
@pytest.mark.parametrize("columns", [40, 60])
def test_tables_fit_a_narrow_terminal(command, columns, pictures, monkeypatch):
    monkeypatch.chdir(pictures)
    monkeypatch.setenv("COLUMNS", str(columns))
    ran = volcli(*command)
    assert ran.code == 0, ran.err
    # Sentences are for the terminal to break; the columns of tables are two blanks apart.
    rows = [line for line in ran.out.splitlines() if "  " in line.strip()]
    rows = [line for line in rows if not re.match(r"\S+\.(vdb|exr)  |pixel \d", line)]
    assert rows
    assert [line for line in rows if len(line) > columns] == []


def test_text_that_does_not_fit_beside_the_first_column_goes_on_below():
    rows = [("a", "one two three four five six"), ("b", "")]
    wrapped = table(("name", "why it is so"), rows, 20)
    assert wrapped.splitlines() == [
        "name  why it is so",
        "a     one two three",
        "      four five six",
        "b",
    ]
    assert table(("name", "why it is so"), rows).count("\n") == 2


def test_wide_letters_take_two_columns():
    lines = table(("name", "what"), [("雲" * 30, "x")], 40).splitlines()
    assert all(len(line) + line.count("雲") <= 40 for line in lines)
    assert sum(line.count("雲") for line in lines) == 30


@pytest.mark.parametrize("name", ["x" * 5000, "x " * 2500, "雲" * 5000, "\x1b[2J" * 1000])
def test_a_name_of_5000_letters_does_not_fill_the_screen(name, tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "40")
    path = write_grid(tmp_path / "a.vdb", name=name)
    for options in ((), ("--stats",)):
        ran = volcli("info", path, *options)
        assert ran.code == 0
        assert len(ran.out) < 4000
        assert ran.out.count("\n") < 80
    for command in ("render", "probe --pixel 0,0"):
        word, *options = command.split()
        ran = volcli(word, path, "--grid", "no", *options, "-o" if word == "render" else "--csv",
                     tmp_path / "out.exr")  # fmt: skip
        assert ran.code in (2, 3)
        assert len(ran.err) < 1000
        assert "\x1b" not in ran.err + ran.out


def test_the_middle_of_a_long_text_is_left_out():
    assert in_short("x" * 40) == "x" * 40
    assert in_short("a" * 40 + "b" * 40) == "a" * 18 + "..." + "b" * 18
