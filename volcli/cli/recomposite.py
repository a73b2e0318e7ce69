"""`volcli recomposite`: another background behind a picture, without rendering it again."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from volcli.cli.compare import background_of
from volcli.cli.options import option
from volcli.cli.table import say
from volcli.errors import UsageError


def recomposite(
    image: Annotated[Path, typer.Argument(help="An EXR of volcli's, or an image with alpha.")],
    background: Annotated[
        str,
        typer.Option(
            metavar="transparent|R,G,B|IMAGE",
            help="What is behind the volume: nothing, a linear colour, or an image file.",
        ),
    ],
    output: Annotated[Path, option("output.image", "-o", "--output", metavar="OUT")],
    bits: Annotated[int, option("output.bits", "--bits", metavar="8|16")] = 8,
    overwrite: Annotated[bool, typer.Option(help="Whether files that exist are replaced.")] = True,
) -> None:
    """Put another background behind a rendered picture.

    The background that it was rendered over is taken away first. An EXR keeps the layers.
    """
    from volcli.images import check_output
    from volcli.opacity.background import write_recomposite

    if bits not in (8, 16):
        raise UsageError(f"--bits {bits}: must be 8 or 16")
    behind = background_of(background)
    assert behind is not None, "the option must be given"
    check_output(output, overwrite=overwrite)
    for warning in write_recomposite(image, output, behind, bits=bits, overwrite=overwrite):
        print(f"volcli: {warning}", file=sys.stderr)
    say(str(output))
