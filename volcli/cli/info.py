"""`volcli info`: what is in a volume file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from volcli.cli.options import option
from volcli.cli.table import in_bytes, in_short, say, say_json, table, terminal_width


def info(
    volume: Annotated[Path, typer.Argument(help="A volume file: .vdb, .npy or .npz.")],
    stats: Annotated[
        bool, typer.Option("--stats", help="Read the values: counts, ranges, memory.")
    ] = False,
    reader: Annotated[
        str, option("density.reader", "--reader", metavar="volcli|openvdb")
    ] = "volcli",
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """List the grids of a volume.

    Types, transforms and boxes; with --stats, what their values are, and whether a picture would
    look empty or solid. Without --stats only headers are read, and counts and boxes are what the
    file declares.
    """
    from volcli.config import make_job
    from volcli.describe import describe

    make_job({}, [("density.reader", reader)], spelled={"density.reader": f"--reader {reader}"})
    found = describe(volume, stats=stats, reader=reader)
    if as_json:
        say_json(found)
        return
    grids = found["grids"]
    say(f"{found['file']}  {found['format']}{'' if grids else ', holds no grids'}")
    if grids:
        say(_tables(grids, _GROUPS if stats else _GROUPS[:-1]))
    for grid in grids:
        name = in_short(grid["grid"])
        if grid["refusal"]:
            say(f"{name}: cannot be rendered: {grid['refusal']}")
        if grid.get("optical_depth"):
            median = f"median optical depth through the box {grid['optical_depth']['50']:.3g}"
            say(f"{name}: {median}{'; ' + grid['advice'] if grid['advice'] else ''}")


_Columns = list[tuple[str, str]]

_GROUPS: list[_Columns] = [
    [
        ("type", "type"),
        ("class", "class"),
        ("voxels", "voxels"),
        ("voxel size", "voxel_size"),
        ("box (world)", "world_box"),
    ],
    [
        ("box (index)", "box"),
        ("transform", "transform"),
        ("background", "background"),
        ("stored as", "stored"),
        ("use", "use"),
    ],
    [
        ("min", "min"),
        ("mean", "mean"),
        ("max", "max"),
        ("leaves", "leaves"),
        ("tiles", "tiles"),
        ("NaN", "nan"),
        ("Inf", "inf"),
        ("below 0", "negative"),
        ("memory", "memory_bytes"),
    ],
]
"""Headings and keys, the most useful first; the last group is of --stats."""


def _tables(grids: list[dict[str, Any]], groups: list[_Columns]) -> str:
    """One table where the terminal is wide enough for it, else one for each group of columns."""
    width = terminal_width()
    whole = _table(grids, [column for group in groups for column in group], None)
    if max(map(len, whole.splitlines())) <= width:
        return whole
    return "\n\n".join(_table(grids, group, width) for group in groups)


def _table(grids: list[dict[str, Any]], columns: _Columns, width: int | None) -> str:
    columns = [("grid", "grid"), *columns]
    rows = [[_cell(grid.get(key), key) for _, key in columns] for grid in grids]
    return table([title for title, _ in columns], rows, width)


def _cell(value: Any, key: str) -> str:
    if value is None or value == "":
        return "-"
    if key == "memory_bytes":
        return in_bytes(value)
    if key == "grid":
        return in_short(value)
    if key == "voxel_size" and len({f"{v:.6g}" for v in value}) == 1:
        return f"{value[0]:.6g}"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list):
        joint = " .. " if value and isinstance(value[0], list) else ","
        return joint.join(f"{v:.4g}" if isinstance(v, float) else _cell(v, "") for v in value)
    if isinstance(value, int):
        return f"{value:,}" if key else str(value)
    return str(value)
