"""Puts the results into the README and docs/accuracy.md: ``python -m benchmarks.report``.

Between ``<!-- NAME -->`` and ``<!-- /NAME -->`` a page holds what this module makes of
``results/NAME.json``, and nothing else.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from typing import Any

from benchmarks.accuracy import STEPS
from benchmarks.common import RESULTS

README = RESULTS.parents[1] / "README.md"


def accuracy(results: dict[str, Any]) -> str:
    """Errors of both rules on the samples."""
    jobs = [name for name in results if name != "machine"]
    rows = [["largest error", *jobs]]
    for text, key in (
        ("transmittance", "transmittance"),
        ("radiance, of its maximum", "radiance_relative_to_max"),
        ("hit distance, of itself", "distance_relative"),
    ):
        rows.append([f"`exact`: {text}", *(_error(results[j]["exact"].get(key)) for j in jobs)])
    for step in STEPS:
        cells = (_error(results[j][f"midpoint {step:g}"]["transmittance"]) for j in jobs)
        rows.append([f"`--step {step:g}`: transmittance", *cells])
    orders = sorted(results[j]["observed_order"] for j in jobs)
    return (
        f"{_markdown(rows)}\n\nWhere density is smooth `midpoint` converges with order 2 (a test "
        f"holds it to that). On these rough volumes\nthe mean error falls with order "
        f"{orders[0]:.1f} to {orders[-1]:.1f} over steps from 1 to 1/16 of a voxel."
    )


def render(results: dict[str, Any]) -> str:
    """Kernel times and errors beside vdb_render's."""
    (name,) = (key for key in results if key != "machine")
    runs, machine = results[name]["runs"], results["machine"]
    rows = [["", "median", "opacity error, max", "mean", "times faster (least to most)"]]
    for run, row in runs.items():
        faster = row.get("times_faster_than_vdb_render")
        error = row["opacity_error"]
        rows.append(
            [
                run,
                f"{row['seconds']['median'] * 1e3:.0f} ms",
                _error(error["max"] or None),
                _error(error["mean"] or None),
                f"{faster['median']:.1f} ({faster['min']:.1f} to {faster['max']:.1f})"
                if faster
                else "",
            ]
        )
    rounds = next(iter(runs.values()))["seconds"]["rounds"]
    return (
        f"{_markdown(rows)}\n\n{results[name]['voxels']:,} voxels, 512 x 512 rays, "
        f"{machine['threads']} threads, {rounds} rounds."
    )


def load(results: dict[str, Any]) -> str:
    """Reading beside OpenVDB's."""
    return _loaded(results) + "."


def load_large(results: dict[str, Any]) -> str:
    """The same of a large volume, and out of volcli's cache."""
    (name,) = (key for key in results if key != "machine")
    cached = results[name]["volcli"]["cached_seconds"]
    return f"{_loaded(results)};\nout of the cache (`--cache`) {cached:.2f} s."


def _loaded(results: dict[str, Any]) -> str:
    (name,) = (key for key in results if key != "machine")
    row = results[name]
    ours, theirs, ratio = row["volcli"], row["openvdb"], row["volcli_over_openvdb"]
    return (
        f"for {row['voxels']:,} voxels {ours['seconds']['median']:.2f} s against "
        f"{theirs['seconds']['median']:.2f} s, {ratio['median']:.1f} times as\nlong "
        f"({ratio['min']:.1f} to {ratio['max']:.1f} over {ratio['rounds']} rounds), with a peak of "
        f"{ours['peak_bytes'] / 1e6:.0f} MB for {ours['held_bytes'] / 1e6:.0f} MB of bricks"
    )


def startup(results: dict[str, Any]) -> str:
    """Whole processes, warm and cold."""
    parts = ("start", "load", "compile", "render", "write")
    rows = [["size", "kernels", "to the written EXR (least to most)", "busy", *parts]]
    for kind, kernels in (("warm", "cached"), ("cold", "compiled")):
        for size, row in results[kind].items():
            seconds = row["written"]
            rows.append(
                [
                    size,
                    kernels,
                    f"{seconds['median']:.2f} s ({seconds['min']:.2f} to {seconds['max']:.2f})",
                    f"{row['busy']['median']:.2f}",
                    *(f"{row['parts'][part]:.2f}" for part in parts),
                ]
            )
    beside = [f"{name} {1e3 * row['median']:.0f} ms" for name, row in results["beside"].items()]
    return f"{_markdown(rows)}\n\n{results['volume']}; beside it, in turns: {', '.join(beside)}."


def process(results: dict[str, Any]) -> str:
    """Whole processes beside vdb_render's."""
    rows = [["", "volcli", "`vdb_render -step 1`", "times faster (least to most)"]]
    for name, row in results.items():
        if name != "machine":
            faster = row["times_faster"]
            rows.append(
                [
                    name,
                    f"{row['volcli']['median']:.2f} s",
                    f"{row['vdb_render -step 1']['median']:.2f} s",
                    f"{faster['median']:.1f} ({faster['min']:.1f} to {faster['max']:.1f})",
                ]
            )
    return _markdown(rows)


def peers(results: dict[str, Any]) -> str:
    """All renderers and settings."""
    rows = [["", "median (least to most)", "error, max", "rms", "start, load, first", "peak"]]
    absent = []
    for name, peer in results["peers"].items():
        if "settings" not in peer:
            absent.append(f"{name}: {peer.get('missing')}.")
            continue
        parts = [
            f"{peer[key]['median']:.2f}" if key in peer else "-"
            for key in ("import_seconds", "load_seconds", "first_seconds")
        ]
        once = [" + ".join(parts) + " s", f"{peer['peak_bytes'] / 1e6:.0f} MB"]
        for label, row in peer["settings"].items():
            seconds = row["seconds"]
            rows.append(
                [
                    f"{name} {label}",
                    f"{seconds['median'] * 1e3:.0f} ms "
                    f"({seconds['min'] * 1e3:.0f} to {seconds['max'] * 1e3:.0f})",
                    _error(row["opacity_error"]["max"]),
                    _error(row["opacity_error"]["rms"]),
                    *once,
                ]
            )
            once = ["", ""]
    versions = (
        f"{name} {peer['version']}"
        for name, peer in results["peers"].items()
        if "settings" in peer and name != "volcli"
    )
    lines = [
        f"{results['voxels']:,} voxels, {results['pixels']} x {results['pixels']} rays, "
        f"{results['machine']['threads']} threads.",
        "; ".join(versions) + ".",
        *absent,
    ]
    return _markdown(rows) + "\n\n" + "\n".join(lines)


def scaling(results: dict[str, Any]) -> str:
    """Lines through times and sizes."""
    fits, voxels, pixels = results["fits"], results["voxels"], results["pixels"]
    rows = [["active voxels", "pixels", "cells visited", "seconds on 1 thread", "on 2", "peak"]]
    seen: dict[tuple[int, int], dict[int, dict[str, Any]]] = {}
    for row in (*voxels, *pixels):
        seen.setdefault((row["active_voxels"], row["pixels"]), {})[row["threads"]] = row
    for (active, size), by in seen.items():
        times = [f"{by[n]['seconds']['median']:.3f}" if n in by else "-" for n in (1, 2)]
        cells, peak = f"{by[1]['cells']:,}", f"{by[1]['peak_bytes'] / 1e6:.0f} MB"
        rows.append([f"{active:,}", f"{size:,}", cells, *times, peak])
    of_cells = [
        f"{1e-6 / line['slope']:.0f} M cells/s on {n} thread{'' if n == '1' else 's'} "
        f"(measurements within {100 * line['worst']:.0f} %)"
        for n, line in fits["seconds_of_cells"].items()
    ]
    rates = ",\n".join(of_cells)
    held, peak = fits["held_bytes_of_voxels"], fits["peak_bytes_of_pixels"]
    return (
        f"{_markdown(rows)}\n\nA line through times over cells visited:\n{rates}.\n"
        f"Bricks take {held['slope']:.1f} bytes an active voxel "
        f"(within {100 * held['worst']:.0f} %), pictures {peak['slope']:.0f} bytes a pixel."
    )


def memory(results: dict[str, Any]) -> str:
    """What renders were said to take, and took."""
    rows = [["active voxels", "`--explain` says", "peak", "of what it said"]]
    for row in results["volumes"]:
        said, peak = row["estimate_bytes"] / 1e6, row["peak_bytes"] / 1e6
        share = f"{row['peak_over_estimate']:.2f}"
        rows.append([f"{row['active_voxels']:,}", f"{said:.0f} MB", f"{peak:.0f} MB", share])
    return _markdown(rows)


def batch(results: dict[str, Any]) -> str:
    """A batch beside a shell loop, and after it was killed."""
    mixed, killed = results["mixed"], results["killed"]
    rows = [["", "seconds", "of the loop's (least to most)"]]
    names = {"loop": "a shell loop over `volcli render`", "processes": "plain processes"}
    names["cluster"] = "a dask cluster of this machine"
    for key, name in names.items():
        if key not in mixed:
            continue
        told = mixed[key]
        seconds, share = told.get("seconds", told), told.get("of_the_loop")
        text = f"{share['median']:.2f} ({share['min']:.2f} to {share['max']:.2f})" if share else ""
        rows.append([name, f"{seconds['median']:.1f} s", text])
    agree = "agree" if killed["manifest_and_folder_agree"] else "do not agree"
    return (
        f"{_markdown(rows)}\n\n{mixed['jobs']} mixed jobs, {mixed['workers']} workers, "
        f"{results['machine']['threads']} processors, {mixed['loop']['rounds']} rounds. And "
        f"{killed['jobs']} small jobs, killed {killed['kills']} times and resumed:\n"
        f"{killed['pictures']} pictures, {killed['rendered_again_though_recorded']} rendered again "
        f"though recorded as done, {killed['temporary_files_left']} temporary files left; manifest "
        f"and folder {agree}."
    )


def _error(value: float | None) -> str:
    return "-" if value is None else f"{value:.0e}".replace("e-0", "e-")


def calibrated(results: dict[str, Any]) -> str:
    """What a target error keeps and buys."""
    rows = [["", "target", "step", "pixels above, of 1000", "times less work", "with the pilot"]]
    for name, targets in results["volumes"].items():
        for target, row in targets.items():
            step = row["pilot"]["step"]
            with_pilot = row["times_faster_with_pilot"]
            rows.append(
                [
                    name,
                    f"{float(target):.2g}",
                    "exact" if step is None else f"{step:g}",
                    f"{1000 * row['pixels_above'] / row['pixels']:.2g}",
                    "" if step is None else _ratio(row["times_faster"]),
                    _ratio(with_pilot),
                ]
            )
    rounds = next(iter(next(iter(results["volumes"].values())).values()))["times_faster"]["rounds"]
    return (
        f"{_markdown(rows)}\n\n800 x 600 rays with depth; work is the seconds of all processors, "
        f"against `exact`'s, median (least to most) of\n{rounds} rounds."
    )


def certified(results: dict[str, Any]) -> str:
    """What was allowed, what it came to, and what it took."""
    scenes = {name: found for name, found in results.items() if name != "machine"}
    rows = [["", "", *next(iter(scenes.values()))["certified"]]]
    for name, found in scenes.items():
        made = found["certified"].values()
        colour = "colour varies" if found["colour_varies"] else "one colour"
        rows += [
            [name, "largest error", *(f"{row['error']:.1e}" for row in made)],
            [colour, "largest certificate", *(f"{row['certificate']:.1e}" for row in made)],
            [
                "",
                "evaluations, of exact's",
                *(f"{row['evaluations_of_exact']:.2f}" for row in made),
            ],
            ["", "time, of exact's", *(f"{row['seconds_of_exact']['median']:.2f}" for row in made)],
        ]
    broken = sum(
        row["violations"] for found in scenes.values() for row in found["certified"].values()
    )
    pixels = next(iter(scenes.values()))["pixels"]
    count = len(rows[0]) - 2
    return (
        f"{_markdown(rows)}\n\nAllowed errors across; {pixels:,} pixels each. Pixels whose error "
        f"is above their own certificate: {broken}, in all of the\n{count * len(scenes)} pictures "
        "(`python -m benchmarks.certified`). A number after a name is the optical depth at the "
        "thickest."
    )


def _ratio(found: dict[str, Any]) -> str:
    return f"{found['median']:.1f} ({found['min']:.1f} to {found['max']:.1f})"


def _markdown(rows: list[list[str]]) -> str:
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join([lines[0], "|" + "---|" * len(rows[0]), *lines[1:]])


BLOCKS = (
    accuracy,
    calibrated,
    peers,
    render,
    process,
    load,
    load_large,
    startup,
    scaling,
    memory,
    batch,
)
"""What the README has a place for; each is made of the results of its name."""

PAGES = {README: BLOCKS, README.parent / "docs/accuracy.md": (certified,)}


def block(make: Callable[[dict[str, Any]], str]) -> str:
    """What a page has between its marks, and these."""
    name = make.__name__
    results = json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))
    return f"<!-- {name} -->\n{make(results)}\n<!-- /{name} -->"


def main() -> None:
    """Rewrite the results in all pages."""
    for page, makes in PAGES.items():
        text = page.read_text(encoding="utf-8")
        for make in makes:
            name, made = make.__name__, block(make)
            text, count = re.subn(
                rf"<!-- {name} -->.*?<!-- /{name} -->", lambda _, b=made: b, text, flags=re.DOTALL
            )
            assert count == 1, f"{page.name} has no place for {name}"
        page.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
