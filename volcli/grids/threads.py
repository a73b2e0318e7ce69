"""Work shared out among threads: for functions that release the interpreter lock (zlib, NumPy)."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


def in_threads(function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    """As `map`, with items worked on side by side; results, and what fails, in the items' order."""
    processors = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None
    pool = ThreadPoolExecutor(processors)
    try:
        yield from pool.map(function, items)
    finally:  # an error or an interrupt does not wait for the work that is still to come
        pool.shutdown(wait=True, cancel_futures=True)
