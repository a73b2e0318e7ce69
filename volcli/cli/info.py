"""`volcli info`: what is in a volume file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from volcli.cli.options import option
from volcli.cli.table import table


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
    """List the grids of a volume: types, transforms, boxes; with --stats, what their values are.

    Without --stats only headers are read, and counts and boxes are what the file declares.
    """
    from volcli.describe import describe

    found = describe(volume, stats=stats, reader=reader)
    if as_json:
        print(json.dumps(found))
        return
    print(f"{found['file']}  {found['format']}")
    head = ["grid", "type", "class", "voxels", "box (index)", "voxel size", "transform", "stored"]
    keys = ["grid", "type", "class", "voxels", "box", "voxel_size", "transform", "stored"]
    if stats:
        head += ["min", "mean", "max", "tiles", "NaN/Inf", "below 0", "memory"]
        keys += ["min", "mean", "max", "tiles", "nonfinite", "negative", "memory_bytes"]
    print(table(head, [[_cell(grid.get(key)) for key in keys] for grid in found["grids"]]))
    for grid in found["grids"]:
        if grid["refusal"]:
            print(f"{grid['grid']}: cannot be rendered: {grid['refusal']}")


def _cell(value: Any) -> str:
    if value is None or value == "":
        return "-"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list):
        joint = " .. " if value and isinstance(value[0], list) else ","
        return joint.join(_cell(v) for v in value)
    return str(value)
