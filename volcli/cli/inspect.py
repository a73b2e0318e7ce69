"""`volcli inspect`: what an image says of opacity, in numbers, in sentences and in pictures."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from volcli.cli.table import say, say_json, table, terminal_width
from volcli.errors import UsageError
from volcli.schema import MAPS

if TYPE_CHECKING:
    from volcli.opacity.maps import Maps

_BARS = " ▁▂▃▄▅▆▇█"


def inspect(
    images: Annotated[
        list[Path],
        typer.Argument(
            metavar="IMAGE...",
            help="Images: an EXR of volcli's, a map that it wrote, or any EXR or PNG with alpha.",
        ),
    ],
    heatmap: Annotated[
        Path | None,
        typer.Option(
            metavar="OUT", help="Draw a map with a colour bar, as .png, .svg or .pdf. One image."
        ),
    ] = None,
    html: Annotated[
        Path | None,
        typer.Option(
            metavar="PAGE.html",
            help="Write a page that needs nothing else: picture, maps, values under the cursor; "
            "several images to wipe between.",
        ),
    ] = None,
    name: Annotated[
        str,
        typer.Option(
            "--map",
            metavar="NAME",
            help=f"The map that is drawn: {', '.join(MAPS)}. [default: opacity]",
        ),
    ] = "opacity",
    colormap: Annotated[
        str,
        typer.Option(metavar="NAME", help="matplotlib's colour map. [default: viridis]"),
    ] = "viridis",
    logarithmic: Annotated[
        bool | None,
        typer.Option(
            "--log/--linear",
            help="Scale of the colours. [default: logarithmic where the medium is thin]",
        ),
    ] = None,
    contours: Annotated[
        str | None,
        typer.Option(
            metavar="A,...", help="Opacities at which the heat map has lines, such as 0.1,0.5,0.9."
        ),
    ] = None,
    overwrite: Annotated[bool, typer.Option(help="Whether files that exist are replaced.")] = True,
    as_json: Annotated[
        bool,
        typer.Option("--json", help="Print one JSON object (of several images: their list)."),
    ] = False,
) -> None:
    """Look at the opacity of images.

    Coverage, percentiles of what is visible, NaN and Inf, and why a picture may be empty, thin,
    solid, cut off or banded. A terminal shows the picture and the map as well.
    """
    levels = _levels(contours)
    if name not in MAPS:
        raise UsageError(f"--map {name}: must be one of {', '.join(MAPS)}")
    if heatmap is not None and len(images) > 1:
        raise UsageError("--heatmap draws one image; give one, or --html for several")
    from volcli.files import FIGURES
    from volcli.images import check_output
    from volcli.opacity.colormap import shades
    from volcli.opacity.findings import findings
    from volcli.opacity.maps import read_maps
    from volcli.opacity.statistics import statistics

    if heatmap is not None:
        check_output(heatmap, overwrite=overwrite, kinds=FIGURES)
    if html is not None:
        check_output(html, overwrite=overwrite, kinds=(".html", ".htm"))
    if heatmap is not None or html is not None or colormap != "viridis":
        shades(colormap)  # raises now, before images are read
    printed: list[dict[str, Any]] = []
    kept = []
    for path in images:
        maps = read_maps(path)
        if name not in maps.layers and (heatmap is not None or _shows_pictures()):
            raise UsageError(f"--map {name}: {path} has none; it has {', '.join(maps.layers)}")
        numbers = statistics(maps)
        numbers["findings"] = findings(numbers)
        printed.append(numbers)
        if html is not None:
            kept.append(maps)
        if heatmap is not None:
            _draw(heatmap, maps, name, colormap, logarithmic, levels, overwrite)
        if not as_json:
            if len(printed) > 1:
                say()
            if _shows_pictures():
                say(_picture(maps, name, colormap, logarithmic))
            say(_summary(numbers))
    if html is not None:
        from volcli.opacity.page import write_page

        write_page(html, kept, colormap=colormap, overwrite=overwrite)
    if as_json:
        say_json(printed[0] if len(images) == 1 else {"images": printed})
    else:
        for written in (heatmap, html):
            if written is not None:
                say(str(written))


def _levels(text: str | None) -> tuple[float, ...]:
    """``A,...`` to opacities.

    Raises
    ------
    UsageError
        If they are not numbers between 0 and 1.
    """
    if text is None:
        return ()
    try:
        levels = tuple(float(part) for part in text.split(","))
    except ValueError:
        levels = (-1.0,)
    if not all(0 < level < 1 for level in levels):
        raise UsageError(f"--contours {text}: give opacities between 0 and 1, such as 0.1,0.5,0.9")
    return levels


def _draw(
    path: Path,
    maps: Maps,
    name: str,
    colormap: str,
    logarithmic: bool | None,
    levels: tuple[float, ...],
    overwrite: bool,
) -> None:
    from volcli.opacity.heatmap import suits_logarithm, write_heatmap

    write_heatmap(
        path,
        maps,
        name,
        colormap=colormap,
        logarithmic=suits_logarithm(maps, name) if logarithmic is None else logarithmic,
        contours=levels,
        overwrite=overwrite,
    )


def _writes_unicode() -> bool:
    return (sys.stdout.encoding or "").lower().replace("-", "") in ("utf8", "utf8sig")


def _shows_pictures() -> bool:
    """Whether stdout is a terminal that shows colours (https://no-color.org)."""
    plain = os.environ.get("NO_COLOR") or os.environ.get("TERM", "dumb") == "dumb"
    return sys.stdout.isatty() and _writes_unicode() and not plain


def _picture(maps: Maps, name: str, colormap: str, logarithmic: bool | None) -> str:
    from volcli.opacity.blocks import picture_and_map
    from volcli.opacity.heatmap import suits_logarithm

    if logarithmic is None:
        logarithmic = suits_logarithm(maps, name)
    return picture_and_map(maps, name, terminal_width(), colormap=colormap, logarithmic=logarithmic)


def _summary(numbers: dict[str, Any]) -> str:
    width, height = numbers["size"]
    head = f"{numbers['image']}  {width}x{height}  {numbers['format']}"
    if numbers["rule"] is not None:
        head += f"  rule {numbers['rule']}"
    if numbers["density_scale"] is not None:
        head += f"  density scale {numbers['density_scale']:g}"
    shares = numbers["coverage"]
    coverage = table(
        ["opacity", "> 0", "> 0.5", "> 0.99", "saturated"],
        [["of all pixels", *(f"{100 * share:.3g} %" for share in shares.values())]],
        terminal_width(),
    )
    lines = [head, "", coverage]
    if shares["above_0"]:
        lines += ["", _percentiles(numbers["maps"]), "", *_facts(numbers)]
    lines += [f"{found['kind']}: {found['text']}" for found in numbers["findings"]]
    return "\n".join(lines)


def _percentiles(maps: dict[str, dict[str, Any]]) -> str:
    """A table of the maps where they are visible, a column each."""
    known = {name: found for name, found in maps.items() if found["percentiles"] is not None}
    steps = list(next(iter(known.values()))["percentiles"]) if known else []
    rows = [
        ["min", *(f"{found['min']:.4g}" for found in known.values())],
        *([f"{q} %", *(f"{f['percentiles'][q]:.4g}" for f in known.values())] for q in steps),
        ["max", *(f"{found['max']:.4g}" for found in known.values())],
        ["mean", *(f"{found['mean']:.4g}" for found in known.values())],
    ]
    if any(found["not_finite"] for found in known.values()):
        rows.append(["not finite", *(f"{f['not_finite']:,} pixels" for f in known.values())])
    if _writes_unicode():
        bars = (_bars(found["histogram"]["counts"]) for found in known.values())
        rows.append(["min to max", *bars])
    return table(["of what is visible", *known], rows, terminal_width())


def _bars(counts: list[int], columns: int = 16) -> str:
    """A histogram in one line."""
    group = len(counts) // columns
    sums = [sum(counts[i * group : (i + 1) * group]) for i in range(columns)]
    top = max(sums)
    # Anything that is not 0 shows at least the lowest bar.
    return "".join(_BARS[-(-8 * count // top)] for count in sums)


def _facts(numbers: dict[str, Any]) -> list[str]:
    box, levels, colour = numbers["visible_box"], numbers["levels"], numbers["colour"]
    (x0, x1), (y0, y1) = box["x"], box["y"]
    stored = f" of {2 ** levels['bits']:,}" if levels["bits"] else ""
    facts = [
        f"visible: x {x0} to {x1}, y {y0} to {y1}",
        f"opacity: {levels['distinct']:,} levels{stored}, taken from "
        f"{numbers['maps']['opacity']['from']}",
    ]
    if not numbers["nonfinite"]:
        facts.append("NaN and Inf: none")
    if colour is not None:
        if colour["over_background"]:
            how = "over a background"
        elif not colour["associated"]:
            how = "not multiplied by opacity, as its format wants it"
        else:
            how = {True: "not multiplied by opacity", False: "multiplied by opacity"}.get(
                colour["straight"], "too little is half transparent to tell if multiplied by it"
            )
        glow = ""
        if colour["light_where_empty"] and colour["associated"] and not colour["over_background"]:
            glow = f"; {colour['light_where_empty']:,} pixels have light and no opacity"
        facts.append(f"colour: up to {colour['max']:.4g}, {how}{glow}")
    return facts
