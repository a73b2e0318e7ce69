"""Temporary files of workers that were killed while they wrote: whose they are, and their removal.

A file of volcli's is written as ``.volcli-PID-...`` and then moved into place (`volcli.files`,
`volcli.images`). One is removed if its process was a worker of this batch, on this machine, and is
no more; or if it is so old that no process anywhere can still be writing it.
"""

from __future__ import annotations

import os
import re
import time
from collections.abc import Collection, Iterable
from contextlib import suppress
from pathlib import Path

OLD_SECONDS = 24 * 3600

_NAME = re.compile(r"\.volcli-(\d+)-[0-9a-f]+(\..*)?")


def remove_leftovers(folders: Iterable[Path], workers: Collection[int]) -> int:
    """Remove temporary files from folders; how many there were.

    Parameters
    ----------
    workers
        Process ids of workers that this batch had on this machine.
    """
    count = 0
    for folder in set(folders):
        with suppress(OSError):  # a folder that is not there, or may not be looked into
            for entry in os.scandir(folder):
                found = _NAME.fullmatch(entry.name)
                if found is None:
                    continue
                pid = int(found[1])
                abandoned = pid in workers and not _is_running(pid)
                with suppress(OSError):  # its writer was faster
                    if abandoned or time.time() - entry.stat().st_mtime > OLD_SECONDS:
                        Path(entry.path).unlink()
                        count += 1
    return count


def _is_running(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
