"""Memory: what there is, what a process holds, and how much this one may take.

Whoever is about to allocate what a file asks for calls `reserve` first. The limit is that of
`memory_limited_to`, by default `SHARE` of what is free, so that it also holds for those who never
heard of it.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path

from volcli.errors import UsageError, VolumeError

SHARE = 0.75
"""The part of the memory that is free that is taken, if nobody says how much."""

_UNCHECKED = 16_000_000
"""Bytes that are not worth asking the system about."""

_CGROUPS = Path("/sys/fs/cgroup")
_UNITS = {"": 1, "k": 10**3, "m": 10**6, "g": 10**9, "t": 10**12}

_LIMIT: ContextVar[int | None] = ContextVar("memory", default=None)


class MemoryLimit(MemoryError):
    """Something was not allocated, because it would have been more than the limit."""


@contextmanager
def memory_limited_to(count: int | None) -> Iterator[None]:
    """Within, `reserve` allows this process so many bytes in all; None: the default."""
    before = _LIMIT.set(count)
    try:
        yield
    finally:
        _LIMIT.reset(before)


def memory_left() -> int:
    """Bytes that may still be allocated."""
    limit = _LIMIT.get()
    if limit is None:
        return int(SHARE * available_memory())
    return limit - held_memory(os.getpid())


def reserve(size: int, what: str) -> None:
    """Ask before allocating ``size`` bytes.

    Parameters
    ----------
    what
        What they are for, as the subject of a sentence in the plural: ``its 12 tiles``.

    Raises
    ------
    MemoryLimit
        If there is no room; it says how much is needed.
    """
    if size <= _UNCHECKED and _LIMIT.get() is None:
        return
    left = max(memory_left(), 0)
    if size > left:
        raise MemoryLimit(
            f"{what} need about {_amount(size)} of memory, and {_amount(left)} may be taken; "
            "--max-memory sets how much"
        )


def no_room(where: str, error: MemoryError) -> VolumeError:
    """What to raise for a grid that is too large; ``where`` is its file and its label."""
    reason = f": {error}" if str(error) else ""
    return VolumeError(f"{where}: does not fit into memory{reason}")


def _amount(count: int) -> str:
    return f"{count / 1e9:.1f} GB" if count >= 10**9 else f"{count / 1e6:.0f} MB"


def parse_memory(text: str, flag: str = "--memory") -> int:
    """``8GB``, ``500 MB``, ``75%`` (of what there is) to bytes.

    Raises
    ------
    UsageError
        If it is none of these.
    """
    found = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*(%|[kmgt]?i?b?)\s*", text, re.IGNORECASE)
    if found is not None:
        amount, unit = float(found[1]), found[2].lower()
        if unit == "%":
            count = amount / 100 * available_memory()
        else:
            factor = _UNITS[unit.rstrip("ib")]
            count = amount * (factor if "i" not in unit else 1024 ** round(len(str(factor)) / 3))
        if count >= 1:
            return int(count)
    raise UsageError(f"{flag} {text}: give bytes with a unit, such as 8GB, or a share, 75%")


def available_memory() -> int:
    """Bytes that are free to use: the machine's, or what is left of the control group's limit or
    of the process' own (``ulimit -v``).
    """
    free = [_left_in_cgroup(), _left_of_own_limit()]
    meminfo = Path("/proc/meminfo")
    if meminfo.exists():
        found = re.search(r"MemAvailable:\s*(\d+) kB", meminfo.read_text())
        if found:
            free.append(int(found[1]) * 1024)
    known = [count for count in free if count is not None]
    return min(known) if known else os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def held_memory(pid: int) -> int:
    """Bytes that a process holds, without what it shares with files; 0 where that is not known."""
    try:
        pages = Path(f"/proc/{pid}/statm").read_text().split()
        return (int(pages[1]) - int(pages[2])) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, IndexError, ValueError):
        return 0  # it has ended, or this system has no such file


def _left_of_own_limit() -> int | None:
    """What the limits of this process' address space and data leave, if there are any."""
    import resource  # not on Windows, which volcli has not been tried on

    left = []
    with suppress(OSError, IndexError, ValueError):
        pages = [int(n) for n in Path("/proc/self/statm").read_text().split()]
        for kind, used in ((resource.RLIMIT_AS, pages[0]), (resource.RLIMIT_DATA, pages[5])):
            limit = resource.getrlimit(kind)[0]
            if limit != resource.RLIM_INFINITY:
                left.append(max(limit - used * os.sysconf("SC_PAGE_SIZE"), 0))
    return min(left, default=None)


def _left_in_cgroup() -> int | None:
    """What the tightest limit of a control group above this process leaves, if there is one."""
    left: list[int] = []
    try:
        groups = Path("/proc/self/cgroup").read_text().splitlines()
    except OSError:
        return None
    for line in groups:
        _, kinds, own = line.split(":", 2)
        if kinds == "":
            root, limit, used, cache = _CGROUPS, "memory.max", "memory.current", "inactive_file"
        elif kinds == "memory":  # version 1
            root = _CGROUPS / "memory"
            limit, used = "memory.limit_in_bytes", "memory.usage_in_bytes"
            cache = "total_inactive_file"
        else:
            continue
        group = root / own.lstrip("/")
        while group.is_relative_to(root):
            with suppress(OSError, ValueError):  # no limit here, or a file that is hidden
                stat = dict(
                    line.split(" ", 1) for line in (group / "memory.stat").read_text().splitlines()
                )
                held = int((group / used).read_text()) - int(stat.get(cache, 0))
                left.append(int((group / limit).read_text()) - held)
            group = group.parent
    return min(left, default=None)


def peak_memory_bytes() -> int:
    """The most memory that this process has held.

    Linux counts it afresh for each program in /proc; getrusage counts that of the program that
    started this one as well.
    """
    status = Path("/proc/self/status")
    if status.exists():
        found = re.search(r"VmHWM:\s*(\d+) kB", status.read_text())
        if found:
            return int(found[1]) * 1024
    import resource  # not on Windows, which volcli has not been tried on

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024
