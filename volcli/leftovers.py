"""Files while they are written: their names, and the removal of those whose writer was killed.

A file of volcli's is written beside the one that it will be, as ``.volcli-PID-TOKEN``, and then
moved into place. Half of the token stands for this machine since it was started, so that it can be
told whether the writer is no more. A file is removed if so, or if it is so old that no process
anywhere can still be writing it: by the next process that writes into its folder, and by a batch
before and after.
"""

from __future__ import annotations

import hashlib
import os
import re
import secrets
import socket
import time
from collections.abc import Collection, Iterable
from contextlib import suppress
from functools import cache
from pathlib import Path

OLD_SECONDS = 24 * 3600

_NAME = re.compile(r"\.volcli-(\d+)-([0-9a-f]+)(\..*)?")


def temporary_name(path: Path) -> Path:
    """A name for a file that is to become ``path``, unlike any other. The first time that a process
    writes into a folder, what others left there is removed.
    """
    _swept_once(path.parent)
    # Short, so that a long name of the file does not become one that is too long.
    return path.with_name(
        f".volcli-{os.getpid()}-{_here()}{secrets.token_hex(4)}{path.suffix[:10]}"
    )


@cache
def _swept_once(folder: Path) -> None:
    remove_leftovers([folder])


def remove_leftovers(folders: Iterable[Path], workers: Collection[int] = ()) -> int:
    """Remove temporary files from folders; how many there were.

    Parameters
    ----------
    workers
        Process ids that are known to be of this machine, whatever the token says.
    """
    count = 0
    for folder in set(folders):
        with suppress(OSError):  # a folder that is not there, or may not be looked into
            for entry in os.scandir(folder):
                found = _NAME.fullmatch(entry.name)
                if found is None:
                    continue
                pid = int(found[1])
                known = pid in workers or found[2].startswith(_here())
                abandoned = known and not _is_running(pid)
                with suppress(OSError):  # its writer was faster
                    if abandoned or time.time() - entry.stat().st_mtime > OLD_SECONDS:
                        Path(entry.path).unlink()
                        count += 1
    return count


@cache
def _here() -> str:
    """Eight letters for this machine, since it was started, and for this container on it."""
    parts = [socket.gethostname()]
    with suppress(OSError):
        parts.append(Path("/proc/sys/kernel/random/boot_id").read_text())
        parts.append(str(Path("/proc/self/ns/pid").readlink()))
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:8]


def _is_running(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return True
