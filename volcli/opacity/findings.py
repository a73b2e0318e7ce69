"""Numbers to sentences: why a picture is empty, thin, solid, cut off or banded, and what to do.

Each finding is a kind, for programs, and one line, for people. The thresholds are here, and so is
the advice on the density's scale that `volcli info` gives as well.
"""

from __future__ import annotations

import math
from typing import Any

THIN = 0.1
"""A volume of less optical depth than this nearly everywhere looks empty: opacity below 10 %."""

SOLID = 7.0
"""A volume of more optical depth than this over most of it looks solid: T below 0.001."""

OPAQUE_SHARE = 0.9
"""Where more of what is visible than this is opaque to the last digit, the picture is solid."""

FEW_LEVELS = 64
"""Fewer levels of opacity than this over a picture show as bands."""

COARSE_STEP = 1.0
"""Steps of the midpoint rule, in voxels, that show as bands."""

Finding = dict[str, str]


def better_scale(scale: float, median_tau: float) -> float:
    """The density scale, of one digit, that brings a median optical depth to about 1."""
    wanted = min(max(scale / max(median_tau, 1e-300), 1e-300), 1e300)
    power = 10.0 ** math.floor(math.log10(wanted))
    return float(f"{round(wanted / power) * power:.3g}")


def scale_advice(scale: float, median_tau: float) -> str:
    """What to write on the command line to bring a median optical depth to about 1."""
    return f"try --density-scale {better_scale(scale, median_tau):g}"


def findings(numbers: dict[str, Any]) -> list[Finding]:
    """What is worth saying of the numbers of `statistics.statistics`, gravest first."""
    found = [
        *_nonfinite(numbers),
        *_visibility(numbers),
        *_framing(numbers),
        *_storage(numbers),
        *_premultiplication(numbers),
    ]
    return [{"kind": kind, "text": text} for kind, text in found]


def _nonfinite(numbers: dict[str, Any]) -> list[tuple[str, str]]:
    return [
        (
            "nonfinite",
            f"{odd['channel']}: {odd['nan']:,} NaN and {odd['inf']:,} Inf, the first at "
            f"x={odd['first'][0]}, y={odd['first'][1]}",
        )
        for odd in numbers["nonfinite"]
    ]


def _visibility(numbers: dict[str, Any]) -> list[tuple[str, str]]:
    """Empty, thin, solid, or black."""
    colour = numbers["colour"]
    if not numbers["coverage"]["above_0"]:
        light = colour["light_where_empty"] if colour and not colour["over_background"] else 0
        if light:
            return [
                (
                    "emission",
                    f"opacity is 0 in every pixel, and {light:,} pixels have light: emission alone",
                )
            ]
        return [
            (
                "empty",
                "opacity is 0 in every pixel: the camera looks past the volume, or the grid is "
                "empty; leave out --eye and --target to have it framed, and see "
                "volcli info VOLUME --stats",
            )
        ]
    found = []
    tau = numbers["maps"]["optical_depth"]
    scale = numbers["density_scale"]
    if tau["percentiles"] is not None:
        least, median, most = (tau["percentiles"][q] for q in ("25", "50", "99"))
        advice = (
            f"{scale_advice(scale, median)} (now {scale:g})"
            if scale is not None
            else f"a density scale {better_scale(1, median):g} times as large brings it to 1"
        )
        if most < THIN:
            found.append(("thin", f"optical depth is {median:.3g} in the median: {advice}"))
        elif least > SOLID:
            found.append(("solid", f"optical depth is {median:.3g} in the median: {advice}"))
    visible = numbers["coverage"]["above_0"]
    saturated = numbers["coverage"]["saturated"]
    if saturated > OPAQUE_SHARE * visible and not any(kind == "solid" for kind, _ in found):
        found.append(
            (
                "solid",
                f"{saturated / visible:.0%} of what is visible is opaque as far as the file can "
                f"tell; a smaller --density-scale shows what is inside",
            )
        )
    most_opaque = numbers["maps"]["opacity"]["max"]
    if colour is not None and not colour["over_background"] and colour["max"] < 0.01 * most_opaque:
        found.append(
            (
                "black",
                f"colour is {_at_most(colour['max'])} where "
                f"there is opacity: the volume hides what is behind it and emits nothing; see "
                f"--color, --color-grid",
            )
        )
    return found


def _at_most(value: float) -> str:
    return f"at most {value:.3g}" if value else "0"


def _framing(numbers: dict[str, Any]) -> list[tuple[str, str]]:
    """Cut off at the picture's edges, or tiny in it."""
    box = numbers["visible_box"]
    if box is None:
        return []
    if box["edges"]:
        return [
            (
                "cut",
                f"goes on beyond the {_listed(box['edges'])} of the picture: move the eye away or "
                f"widen --fov, or leave out --eye and --target",
            )
        ]
    width, height = (box[axis][1] - box[axis][0] + 1 for axis in "xy")
    if width * height < 0.01 * numbers["size"][0] * numbers["size"][1]:
        return [
            ("small", f"only {width} x {height} pixels are visible: move the eye nearer"),
        ]
    return []


def _storage(numbers: dict[str, Any]) -> list[tuple[str, str]]:
    """Too few levels, too long steps, clipped colour, layers that disagree."""
    found = []
    levels, opacity = numbers["levels"], numbers["maps"]["opacity"]
    pixels = numbers["size"][0] * numbers["size"][1] * numbers["coverage"]["above_0"]
    several = opacity["min"] != opacity["max"]
    if levels["bits"] == 8 and several:
        text = (
            f"opacity is stored in 8 bits, in steps of 0.004: {levels['distinct']} levels from "
            f"{opacity['min']:.3g} to {opacity['max']:.3g}"
        )
        if levels["distinct"] < FEW_LEVELS and pixels > 16 * FEW_LEVELS:
            text += ", which shows as bands"
        found.append(("quantised", f"{text}; an .exr, or --bits 16, keeps more"))
    elif levels["distinct"] < FEW_LEVELS and several and pixels > 16 * FEW_LEVELS:
        found.append(
            ("banded", f"opacity takes {levels['distinct']} values only, which shows as bands")
        )
    rule = (numbers["rule"] or "").split()
    if rule[:1] == ["midpoint"] and float(rule[-1]) >= COARSE_STEP:
        found.append(
            (
                "banded",
                f"rendered in steps of {rule[-1]} voxels, which may show as bands: leave out "
                f"--step (exact), or give --step 0.25",
            )
        )
    found += _brightness(numbers, max(pixels, 1))
    for layer, difference in numbers["disagreement"].items():
        if difference > 1e-5:
            found.append(
                (
                    "disagreement",
                    f"{layer} and what the layers say of opacity differ by {difference:.3g}: the "
                    f"file was changed after it was rendered",
                )
            )
    return found


def _brightness(numbers: dict[str, Any], pixels: float) -> list[tuple[str, str]]:
    """Colour that is clipped, or will be; one colour of exactly 1 everywhere is neither."""
    colour = numbers["colour"]
    if colour is None:
        return []
    if numbers["levels"]["bits"] and 0.01 < colour["at_1"] / pixels < 0.99:
        return [
            (
                "clipped",
                f"{colour['at_1'] / pixels:.0%} of what is visible has colour at the top of what "
                f"the file can hold: an .exr keeps what is brighter",
            )
        ]
    if colour["above_1"] > 0.01 * pixels:
        return [
            (
                "clipped",
                f"{colour['above_1'] / pixels:.0%} of what is visible is brighter than 1 (up to "
                f"{colour['max']:.3g}), which a PNG or a screen clips",
            )
        ]
    return []


def _premultiplication(numbers: dict[str, Any]) -> list[tuple[str, str]]:
    colour = numbers["colour"]
    if colour is None or not colour["associated"]:
        return []
    if colour["straight"]:
        return [
            (
                "straight",
                "colour does not fade with opacity: it looks unassociated, where an EXR should "
                "hold it multiplied by alpha",
            )
        ]
    return []


def _listed(names: list[str]) -> str:
    edges = " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)
    return f"{edges} edge{'s' if len(names) > 1 else ''}"
