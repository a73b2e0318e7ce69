"""`volcli compare`: how much two images differ, and whether that is more than asked."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any

import typer

from volcli.cli.options import background as parse_background
from volcli.cli.options import names
from volcli.cli.table import say, say_json, table, terminal_width
from volcli.errors import UsageError, VolcliError


def compare(
    a: Annotated[Path, typer.Argument(metavar="A", help="The reference: an EXR or a PNG.")],
    b: Annotated[Path, typer.Argument(metavar="B", help="What is compared with it.")],
    max_error: Annotated[
        float | None,
        typer.Option(min=0, metavar="E", help="Largest difference allowed of any pixel."),
    ] = None,
    rmse: Annotated[
        float | None,
        typer.Option(min=0, metavar="E", help="Largest root mean square allowed of any channel."),
    ] = None,
    channels: Annotated[
        str | None,
        typer.Option(metavar="NAME,...", help="Channels to compare. [default: all that both have]"),
    ] = None,
    background: Annotated[
        str | None,
        typer.Option(
            metavar="transparent|R,G,B|IMAGE",
            help="Put both before this first, whatever they were rendered over: a linear colour "
            "or an image. [default: compare as they are]",
        ),
    ] = None,
    difference: Annotated[
        Path | None,
        typer.Option(
            metavar="OUT", help="Write B - A as .exr, or its picture as .png, .svg or .pdf."
        ),
    ] = None,
    overwrite: Annotated[bool, typer.Option(help="Whether files that exist are replaced.")] = True,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Compare two images, channel by channel.

    Ends with exit code 1 where a limit (--max-error, --rmse) is exceeded. A pixel that is finite
    in one image alone exceeds any limit.
    """
    behind = background_of(background)
    from volcli.files import FIGURES
    from volcli.images import check_output
    from volcli.opacity.difference import Pair, read_pair, write_difference
    from volcli.opacity.difference import compare as compare_pair

    if difference is not None:
        check_output(difference, overwrite=overwrite, kinds=(".exr", *FIGURES))
    pair = read_pair(a, b, background=behind)
    wanted = names(channels)
    if wanted is not None:
        absent = [name for name in wanted if name not in pair.a]
        if absent or not wanted:
            raise UsageError(
                f"--channels {channels}: both have {', '.join(pair.a)}; choose of these"
            )
        first, second = ({name: image[name] for name in wanted} for image in (pair.a, pair.b))
        pair = Pair(first, second, pair.encoding, pair.encoded)
    found = compare_pair(pair)
    beyond = _beyond(found["channels"], max_error, rmse)
    if difference is not None:
        title = f"{b.name} - {a.name}"
        write_difference(difference, pair, title, overwrite=overwrite)
        found["difference"] = str(difference)
    if as_json:
        say_json({"a": str(a), "b": str(b), **found, "beyond": beyond})
    else:
        say(_summary(found))
    if beyond:
        raise VolcliError(f"{a} and {b} differ by more than asked: {'; '.join(beyond)}")


def background_of(text: str | None) -> tuple[float, float, float] | Path | str | None:
    """``transparent``, ``R,G,B`` or an image file; None stays None.

    Raises
    ------
    UsageError
        If it is a list of numbers, but not of three that are at least 0.
    """
    if text is None or text == "transparent":
        return text
    ((key, value),) = parse_background(text)
    if key == "background.image":
        return Path(value)
    if not all(math.isfinite(v) and v >= 0 for v in value):
        raise UsageError(f"--background {text}: give three numbers R,G,B that are at least 0")
    return tuple(value)


def _beyond(
    channels: dict[str, dict[str, Any]], max_error: float | None, rmse: float | None
) -> list[str]:
    """Which limits are exceeded, in words."""
    beyond = []
    for name, found in channels.items():
        limited = max_error is not None or rmse is not None
        if limited and found["unmatched"]:
            beyond.append(f"{name} has {found['unmatched']:,} pixels that are finite in one alone")
        if max_error is not None and found["max"] > max_error:
            x, y = found["at"]
            beyond.append(f"{name} by {found['max']:.3g} at x={x}, y={y}")
        if rmse is not None and found["rmse"] > rmse:
            beyond.append(f"{name} by {found['rmse']:.3g} RMSE")
    return beyond


def _summary(found: dict[str, Any]) -> str:
    rows = []
    for name, channel in found["channels"].items():
        x, y = channel["at"]
        psnr = "same" if channel["psnr"] is None else f"{channel['psnr']:.1f} dB"
        if channel["unmatched"]:
            psnr = "-"
        row = [name, *(f"{channel[key]:.3g}" for key in ("max", "mean", "rmse")), psnr]
        same = channel["max"] == 0 and not channel["unmatched"]
        values = (_shown(channel[key]) for key in ("a", "b"))
        row += ["-", "-", "-"] if same else [f"{x},{y}", *values]
        rows.append([*row, f"{channel['unmatched']:,}" if channel["unmatched"] else "-"])
    head = ["channel", "max", "mean", "RMSE", "PSNR", "at x,y", "A there", "B there", "unmatched"]
    lines = [table(head, rows, terminal_width()), "", f"compared: {found['encoding']}"]
    if found["flip"] is not None:
        seen = found["flip"]
        lines.append(f"{seen['kind']}: mean {seen['mean']:.3g}, max {seen['max']:.3g}")
    if "difference" in found:
        lines.append(found["difference"])
    return "\n".join(lines)


def _shown(value: float | str) -> str:
    return value if isinstance(value, str) else f"{value:.6g}"
