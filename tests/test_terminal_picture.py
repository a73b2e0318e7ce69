"""The picture in a terminal, in a real pseudo-terminal: half blocks in the colours of the image."""

import os
import pty
import re
import select
import subprocess
import sys

import numpy as np
import pytest
from pictures import RAMP, write_volcli_exr

from volcli.opacity.blocks import averaged, half_blocks, picture_and_map
from volcli.opacity.colormap import shades
from volcli.opacity.maps import read_maps

CELL = re.compile(r"\x1b\[38;2;(\d+);(\d+);(\d+);48;2;(\d+);(\d+);(\d+)m|(\u2580)")


def pixels_of(line):
    """(2, n, 3): the two rows of pixels that a line of half blocks shows."""
    now, cells = None, []
    for match in CELL.finditer(line):
        if match[7]:
            cells.append(now)
        else:
            now = [int(v) for v in match.groups()[:6]]
    return np.array(cells).reshape(-1, 2, 3).swapaxes(0, 1)


def in_terminal(*arguments, columns=80, **variables):
    """What ``volcli ARGUMENTS`` writes to a terminal."""
    leader, follower = pty.openpty()
    environment = {k: v for k, v in os.environ.items() if k not in ("NO_COLOR", "COLUMNS")}
    environment |= {"TERM": "xterm-256color", "COLUMNS": str(columns), "PYTHONUTF8": "1"}
    command = [sys.executable, "-c", "from volcli.cli import main; main()", *map(str, arguments)]
    process = subprocess.Popen(command, stdout=follower, env=environment | variables)
    os.close(follower)
    written = b""
    while select.select([leader], [], [], 60)[0]:
        try:
            part = os.read(leader, 65536)
        except OSError:  # how Linux says that the other end is closed
            break
        if not part:
            break
        written += part
    os.close(leader)
    assert process.wait() == 0
    return written.decode()


def test_half_blocks_show_two_rows_a_line():
    rng = np.random.default_rng(1)
    pixels = rng.integers(0, 256, (6, 5, 3)).astype(np.uint8)
    pixels[:, 2] = pixels[:, 1]  # colours that stay are not written again
    lines = half_blocks(pixels)
    assert len(lines) == 3
    found = np.concatenate([pixels_of(line) for line in lines])
    np.testing.assert_array_equal(found, pixels)
    assert all(line.endswith("\x1b[0m") for line in lines)


@pytest.mark.parametrize("size", [(3, 5), (1, 1), (8, 2)])
def test_a_small_picture_is_made_of_means(size):
    values = np.arange(24 * 10, dtype=np.float32).reshape(24, 10)
    values[0, 0] = np.nan
    found = averaged(values, size)
    rows, columns = (np.array_split(np.arange(n), m) for n, m in zip((24, 10), size, strict=True))
    assert found.shape == size
    if 24 % size[0] == 10 % size[1] == 0:
        wanted = [[np.nanmean(values[np.ix_(r, c)]) for c in columns] for r in rows]
        np.testing.assert_allclose(found, wanted, rtol=1e-6)


def test_the_map_beside_the_picture_has_its_colours(tmp_path):
    maps = read_maps(
        write_volcli_exr(tmp_path / "a.exr", np.repeat([[0.0], [3.0]], 40, 1)[[0] * 20 + [1] * 20])
    )
    text = picture_and_map(maps, "optical_depth", 80, colormap="magma", logarithmic=False)
    head, *lines = text.splitlines()
    assert head.split() == ["picture", "optical_depth"]
    shown = np.concatenate([pixels_of(line) for line in lines])
    half = shown.shape[1] // 2
    np.testing.assert_array_equal(shown[0, half:], np.tile(shades("magma")[0], (half, 1)))
    np.testing.assert_array_equal(shown[-1, half:], np.tile(shades("magma")[-1], (half, 1)))


@pytest.mark.parametrize("columns", [40, 80, 200])
def test_a_terminal_shows_the_picture_and_no_line_is_wider_than_it(tmp_path, columns):
    path = write_volcli_exr(tmp_path / "a.exr", np.tile(RAMP, (4, 4)))
    written = in_terminal("inspect", path, columns=columns)
    lines = written.replace("\r\n", "\n").splitlines()
    assert any("\u2580" in line for line in lines)
    for line in lines:
        if "\u2580" in line:
            assert len(re.sub(r"\x1b\[[^m]*m", "", line)) <= columns
    assert "of what is visible" in written


@pytest.mark.parametrize("variables", [{"NO_COLOR": "1"}, {"TERM": "dumb"}])
def test_a_terminal_without_colours_gets_the_numbers_alone(tmp_path, variables):
    written = in_terminal("inspect", write_volcli_exr(tmp_path / "a.exr", RAMP), **variables)
    assert "\x1b" not in written
    assert "of what is visible" in written
