"""Takes the text out of PNG files: the README's pictures need no job with the paths of a machine.

    python docs/strip_headers.py PICTURE.png ...

Pixels are left alone, byte for byte.
"""

import struct
import sys
from pathlib import Path

TEXT = (b"tEXt", b"zTXt", b"iTXt")


def without_text(png: bytes) -> bytes:
    """The file without its chunks of text."""
    kept, at = [png[:8]], 8
    while at < len(png):
        (length,) = struct.unpack_from(">I", png, at)
        end = at + 12 + length  # length, type, data, checksum
        if png[at + 4 : at + 8] not in TEXT:
            kept.append(png[at:end])
        at = end
    return b"".join(kept)


if __name__ == "__main__":
    for name in sys.argv[1:]:
        Path(name).write_bytes(without_text(Path(name).read_bytes()))
