"""Progress: on a terminal only, one bar at a time, and gone from the screen when it is done."""

import contextlib
import io

import pytest

from volcli.cli.progress import Bars


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture(autouse=True)
def bars_show_at_once(monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.setattr("volcli.cli.progress._WAIT_SECONDS", 0)


def drawn(screen, *reports, quiet=False):
    """What a screen holds after these reports of progress, and an error if one is raised."""
    with contextlib.redirect_stderr(screen), Bars(quiet=quiet) as bars:
        for report in reports:
            if isinstance(report, Exception):
                raise report
            bars(*report)


def left_on(screen):
    """What is seen at the end: of each line what was written last."""
    return [line.split("\r")[-1].strip() for line in screen.getvalue().split("\n")]


def test_a_bar_names_the_grid_that_is_read():
    screen = Terminal()
    drawn(screen, *((f"reading {grid}", n, 10) for grid in ("density", "Cd") for n in (0, 5, 10)))
    assert "reading density:" in screen.getvalue()
    assert "reading Cd:" in screen.getvalue()
    assert left_on(screen) == [""]


def test_compiling_is_announced_before_it_starts():
    screen = Terminal()
    with contextlib.redirect_stderr(screen):
        bars = Bars(quiet=False)
        bars("compiling", 0, 1)
        assert "compiling kernels (first run" in screen.getvalue()
        bars("compiling", 1, 1)
    assert left_on(screen) == [""]


def test_an_error_takes_the_bar_off_the_screen():
    screen = Terminal()
    with pytest.raises(ValueError, match="broken"):
        drawn(screen, ("rendering", 3, 10), ValueError("broken"))
    assert "rendering" in screen.getvalue()
    assert left_on(screen) == [""]


def test_nothing_is_drawn_for_nobody_or_for_who_wants_quiet():
    screen, file = Terminal(), io.StringIO()
    drawn(screen, ("rendering", 3, 10), quiet=True)
    drawn(file, ("rendering", 3, 10))
    assert screen.getvalue() == file.getvalue() == ""
