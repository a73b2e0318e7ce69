"""The options that commands share, each defined once, with its help and default from the schema."""

from __future__ import annotations

import math
from typing import Any

import typer

from volcli.errors import UsageError
from volcli.schema import field


def option(key: str, *flags: str, metavar: str | None = None) -> Any:
    """The option that sets a field of the job: its help and default come from the schema."""
    text, default = field(key)
    if default not in (None, ()):
        # In the text, because typer puts a default that it is told in parentheses.
        text = f"{text} [default: {_written(default)}]"
    return typer.Option(*flags, metavar=metavar, help=text)


def _written(default: Any) -> str:
    if isinstance(default, float):
        return f"{default:g}"
    if not isinstance(default, tuple):
        return str(default)
    joint = "x" if all(isinstance(v, int) for v in default) else ","
    return joint.join(f"{v:g}" for v in default)


def numbers(flag: str, text: str | None) -> tuple[float, ...] | None:
    """``X,Y,Z`` to numbers; None stays None.

    Raises
    ------
    UsageError
        Naming the flag and what it takes.
    """
    if text is None:
        return None
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) != 3 or not all(math.isfinite(v) for v in values):
        raise UsageError(f"{flag} {text}: give 3 finite numbers separated by commas, such as 0,1,0")
    return values


def size(text: str | None) -> tuple[int, int] | None:
    """``WxH`` to (width, height); None stays None.

    Raises
    ------
    UsageError
        If it is not two whole numbers above 0.
    """
    if text is None:
        return None
    width, _, height = text.lower().partition("x")
    try:
        pixels = int(width), int(height)
    except ValueError:
        pixels = (0, 0)
    if min(pixels) < 1:
        raise UsageError(f"--size {text}: give width and height in pixels, such as 1280x720")
    return pixels


def names(text: str | None) -> list[str] | None:
    """``A,B`` to a list; None stays None, and nothing is no names."""
    if text is None:
        return None
    return [part.strip() for part in text.split(",") if part.strip()]


def background(text: str | None) -> list[tuple[str, Any]]:
    """``transparent``, ``R,G,B`` or an image file, as settings of the job."""
    if text is None:
        return []
    if text == "transparent":
        return [("background.color", None)]
    parts = text.split(",")
    try:
        color = [float(part) for part in parts]
    except ValueError:
        return [("background.image", text)]
    if len(color) != 3:
        raise UsageError(
            f"--background {text}: give transparent, three numbers R,G,B, or an image file"
        )
    return [("background.color", color)]
