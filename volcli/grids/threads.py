"""Work shared out among threads: for functions that release the interpreter lock (zlib, NumPy)."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")

_THREADS: ContextVar[int | None] = ContextVar("threads", default=None)


@contextmanager
def threads_limited_to(count: int | None) -> Iterator[None]:
    """Within, `in_threads` takes so many threads; None: as many as this process may use processors.

    It is no argument of all that lies between a reader of files and the work that it shares out,
    because nothing that they return depends on it.
    """
    before = _THREADS.set(count)
    try:
        yield
    finally:
        _THREADS.reset(before)


def in_threads(function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    """As `map`, with items worked on side by side; results, and what fails, in the items' order."""
    count = _THREADS.get()
    if count is None:
        count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    if count == 1:  # items are made while others are worked on: a pool of one would be two
        yield from map(function, items)
        return
    pool = ThreadPoolExecutor(count)
    try:
        yield from pool.map(function, items)
    finally:  # an error or an interrupt does not wait for the work that is still to come
        pool.shutdown(wait=True, cancel_futures=True)
