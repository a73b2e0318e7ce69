r"""Numbered files: ranges of frames, and patterns such as ``smoke.####.vdb``.

A frame's place in a path is ``####`` (as many digits), ``%04d`` or ``$F4``. ``*``, ``?``, ``[...]``
and ``**`` in a path stand for many files, as in a shell. A path that exists as it is written is
taken as it is written.
"""

from __future__ import annotations

import glob
import itertools
import math
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

from volcli.errors import UsageError

MOST_FRAMES = 1_000_000
"""Frames of a range at most: more is a slip of the keyboard."""

_PLACE = re.compile(r"#+|%0?(\d*)d|\$F(\d?)")
_WILD = re.compile(r"\*\*/|\*|\?|\[[^\]/]+\]")
_RANGE = re.compile(r"(-?\d+)(?:-(-?\d+)(?:x(\d+))?)?")


def parse_frames(text: str, where: str = "frames") -> list[int]:
    """``1-100x2,150`` to frame numbers, in the order they are written, each once.

    Raises
    ------
    UsageError
        Naming ``where`` and the part that is wrong.
    """
    frames: dict[int, None] = {}
    for part in text.split(","):
        found = _RANGE.fullmatch(part.strip())
        if found is None:
            raise UsageError(
                f"{where}: '{part.strip()}' is no range of frames; write 7, 1-100 or 1-100x2"
            )
        first = int(found[1])
        last = first if found[2] is None else int(found[2])
        step = int(found[3] or 1)
        if last < first:
            raise UsageError(f"{where}: {part.strip()} ends before it begins; write {last}-{first}")
        if step == 0:
            raise UsageError(f"{where}: {part.strip()} has a step of 0; give at least 1")
        if (last - first) // step + len(frames) >= MOST_FRAMES:
            raise UsageError(f"{where}: {part.strip()} is more than {MOST_FRAMES:,} frames")
        frames |= dict.fromkeys(range(first, last + 1, step))
    return list(frames)


def as_ranges(frames: Iterable[int]) -> str:
    """Frame numbers for people: ``1-3, 7``."""
    runs: list[list[int]] = []
    for frame in sorted(frames):
        if runs and frame == runs[-1][-1] + 1:
            runs[-1].append(frame)
        else:
            runs.append([frame])
    return ", ".join(str(r[0]) if len(r) == 1 else f"{r[0]}-{r[-1]}" for r in runs)


def has_place(path: Path) -> bool:
    """Whether a path has a place for a frame number."""
    return _PLACE.search(str(path)) is not None


def is_wild(path: Path) -> bool:
    """Whether a path stands for many files."""
    return _WILD.search(str(path)) is not None and not path.exists()


def with_frame(path: Path, frame: int) -> Path:
    """The path of one frame."""
    return Path(_PLACE.sub(lambda place: f"{frame:0{_digits(place)}d}", str(path)))


def matches(path: Path) -> list[Path]:
    """The paths that a wild one stands for, in natural order; places of frames stay as they are."""
    found: set[str] = set()
    pattern = _regex(str(path))
    for name in glob.iglob(_glob(str(path)), recursive=True):  # noqa: PTH207 - keeps './x' as it is
        match = pattern.fullmatch(name)
        if match is None:
            continue
        # What stood where a frame goes becomes its place again.
        for number in range(match.re.groups, 0, -1):
            start, end = match.span(number)
            name = name[:start] + _places(str(path))[number - 1] + name[end:]
        found.add(name)
    return [Path(name) for name in sorted(found, key=_natural)]


def frames_on_disk(path: Path) -> list[int]:
    """The frames that there are files of, in order; ``path`` has a place and nothing wild."""
    found = set()
    pattern = _regex(glob.escape(str(path)))
    for name in glob.iglob(_glob(glob.escape(str(path)))):  # noqa: PTH207
        match = pattern.fullmatch(name)
        if match is not None and with_frame(path, int(match[1])) == Path(name):
            found.add(int(match[1]))
    return sorted(found)


def gaps(frames: Sequence[int]) -> list[int]:
    """Frames that seem to be missing between the first and the last, going by their usual step."""
    if len(frames) < 3:
        return []
    step = math.gcd(*(b - a for a, b in itertools.pairwise(frames)))
    return sorted(set(range(frames[0], frames[-1] + 1, step)) - set(frames))


def _digits(place: re.Match[str]) -> int:
    if place[0].startswith("#"):
        return len(place[0])
    return int(place[1] or place[2] or 0)


def _places(path: str) -> list[str]:
    return [place[0] for place in _PLACE.finditer(path)]


def _glob(path: str) -> str:
    return _PLACE.sub("*", path)


def _regex(path: str) -> re.Pattern[str]:
    """What a path with places and wild parts matches; a group for each place."""
    kinds = {"**/": "(?:.*/)?", "*": "[^/]*", "?": "[^/]"}
    text, at = "", 0
    for part in re.finditer(f"(?P<place>{_PLACE.pattern})|(?P<wild>{_WILD.pattern})", path):
        text += re.escape(path[at : part.start()])
        if part["place"] is not None:
            text += r"(-?\d+)"
        else:
            inner = part["wild"]
            text += kinds.get(inner, inner.replace("[!", "[^"))
        at = part.end()
    return re.compile(text + re.escape(path[at:]))


def _natural(name: str) -> list[tuple[bool, int, str]]:
    """Sorts ``a2`` before ``a10``."""
    return [
        (part.isdigit(), int(part) if part.isdigit() else 0, part)
        for part in re.split(r"(\d+)", name)
    ]
