"""Seeds, and the damage that is done to them: a case by its number.

Seeds are the samples and the configs of this repository, small files that are written here, and
the volumes beside the checkout where there are any.
"""

from __future__ import annotations

import json
import tempfile
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from tests.vdbwriter import ACTIVE_MASK, BLOSC, STORED, ZIP, Grid, write_vdb

ROOT = Path(__file__).parents[1]
VOLUMES = ROOT.parent / "shared" / "volumes"

LONGEST_SEED = 300_000
"""Bytes: in longer files too few blows meet what can be damaged."""

HEAD = 600
"""Bytes of the beginning of a file, where lengths and counts are: half of the blows land there."""

EXTREMES = [
    bytes(8),
    b"\xff" * 8,
    b"\xff\xff\xff\x7f",
    b"\0\0\0\x80",
    b"\xff" * 7 + b"\x7f",
    b"\0\0\0\x01",
    b"\0\0\xc0\x7f",  # NaN
    b"\0\0\x80\x7f",  # Inf
    b"\xff\xff",
    b"\1\0\0\0",
]
NUMBERS = [b"-1", b"0", b"1e999", b"nan", b"99999999999", b"[]", b'"x"', b"1-999999999", b"true"]
NUMBERS += [b"9" * 5000, b"[" * 5000, b"{a=" * 5000, b"a" + b".a" * 5000 + b"=1"]


@dataclass(frozen=True)
class Seed:
    """A whole file; ``kind`` says which commands read it."""

    name: str
    kind: str
    raw: bytes


@dataclass(frozen=True)
class Case:
    """A damaged file, by its number."""

    number: int
    seed: Seed
    raw: bytes


@cache
def seeds() -> tuple[Seed, ...]:
    """All seeds, by kind and name."""
    found = [*_written(), *_files(ROOT / "samples", "*.vdb", "vdb")]
    found += _files(ROOT / "configs", "*.toml", "job")
    found += _files(ROOT / "configs" / "batch", "*.toml", "batch")
    for folder in ("conformance", "malformed", "real"):
        found += _files(VOLUMES / folder, "*.vdb", "vdb")
    return tuple(sorted(found, key=lambda seed: (seed.kind, seed.name)))


def case(number: int, kinds: tuple[str, ...] = ()) -> Case:
    """The case of a number, of all kinds or of some."""
    rng = np.random.default_rng(number)
    known = [seed for seed in seeds() if not kinds or seed.kind in kinds]
    by_kind = sorted({seed.kind for seed in known})
    weights = np.array([6.0 if kind == "vdb" else 1.0 for kind in by_kind])
    kind = rng.choice(by_kind, p=weights / weights.sum())
    alike = [seed for seed in known if seed.kind == kind]
    seed = alike[rng.integers(len(alike))]
    raw = bytearray(seed.raw)
    for _ in range(rng.geometric(0.5)):
        _blow(raw, rng, alike)
    return Case(number, seed, bytes(raw))


def _blow(raw: bytearray, rng: np.random.Generator, alike: list[Seed]) -> None:
    """Damage a file in one of the ways in which files are damaged, or made to do harm."""
    at = int(rng.integers(0, 1 + (min(HEAD, len(raw)) if rng.random() < 0.5 else len(raw))))
    match rng.integers(9):
        case 0 if len(raw):  # a bit
            raw[at % len(raw)] ^= 1 << int(rng.integers(8))
        case 1:  # some bytes
            raw[at : at + 4] = rng.bytes(int(rng.integers(1, 9)))[: max(len(raw) - at, 1)]
        case 2 | 3:  # a length or a count
            value = EXTREMES[rng.integers(len(EXTREMES))]
            raw[at : at + len(value)] = value
        case 4 if len(raw) > 8:  # the same, by a little
            at = min(at, len(raw) - 8)
            count = int.from_bytes(raw[at : at + 4], "little") + int(rng.integers(-3, 4))
            raw[at : at + 4] = (count % 2**32).to_bytes(4, "little")
        case 5 if rng.random() < 0.4:  # the end is missing
            del raw[at:]
        case 6:  # a part is missing
            del raw[at : at + int(rng.integers(1, 200))]
        case 7:  # a part of another file, or of this one, in between or instead
            other = alike[rng.integers(len(alike))].raw
            start = int(rng.integers(0, len(other) + 1))
            part = other[start : start + int(rng.integers(1, 4000))]
            raw[at : at + (len(part) if rng.random() < 0.5 else 0)] = part
        case 8:  # a number of a text
            value = NUMBERS[rng.integers(len(NUMBERS))]
            mark = b":" if alike[0].kind == "json" else b"="
            equals = raw.find(mark, at)
            if 0 <= equals < at + 200:
                end = raw.find(b"\n", equals)
                raw[equals + 1 : end if end > 0 else len(raw)] = value
            else:
                raw[at : at + len(value)] = value


def _files(folder: Path, pattern: str, kind: str) -> list[Seed]:
    return [
        Seed(f"{folder.name}/{path.name}", kind, path.read_bytes())
        for path in sorted(folder.glob(pattern))
        if path.stat().st_size <= LONGEST_SEED
    ]


def _written() -> list[Seed]:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        _write_volumes(folder)
        _write_cameras(folder)
        _write_images(folder)
        return [
            Seed(f"written/{path.name}", path.suffix[1:], path.read_bytes())
            for path in sorted(folder.iterdir())
        ]


def _write_volumes(folder: Path) -> None:
    """Each type of value and each compression in a few kilobytes, with tiles on each level."""
    for version, compression in ((221, 0), (224, 0), (224, ZIP | ACTIVE_MASK), (224, BLOSC | 2)):
        for value_type, (stored, shape) in STORED.items():
            rng = np.random.default_rng(5)
            value = rng.integers(0, 2, (8, 8, 8, *shape)).astype(stored)
            grid = Grid(
                value_type=value_type,
                leaves={at: (value, rng.random((8, 8, 8)) < 0.5) for at in ((0, 0, 0), (8, 0, 0))},
                tiles={
                    ((16, 0, 0), 8): (value[0, 0, 0], True),
                    ((0, 256, 0), 128): (value[0, 0, 1], True),
                    ((4096, 0, 0), 4096): (value[0, 0, 2], True),
                },
                compression=compression,
            )
            path = folder / f"{value_type}_{version}_{compression}.vdb"
            write_vdb(path, [grid], version=version, offsets=compression != 0)
    axes = np.indices((9, 9, 9)) - 4.0
    density = np.clip(1 - np.sqrt((axes**2).sum(axis=0)) / 3.5, 0, None).astype(np.float32)
    np.save(folder / "ball.npy", density)
    np.savez(folder / "ball.npz", density=density, voxel_size=0.5, origin=[0, 1, 2])
    np.savez_compressed(folder / "packed.npz", density=density, Cd=np.ones((9, 9, 9, 3)))


def _write_cameras(folder: Path) -> None:
    """Frames of a NeRF transforms.json, with each way to name a lens."""
    pose = np.eye(4).tolist()
    frames = [{"file_path": f"./r_{i}", "transform_matrix": pose} for i in range(3)]
    lens = {"fl_x": 20, "fl_y": 20.5, "cx": 8, "cy": 6, "w": 16, "h": 12, "k1": 0}
    synthetic = {"camera_angle_x": 0.6911, "frames": frames}
    (folder / "synthetic.json").write_text(json.dumps(synthetic, indent=1))
    measured = {"camera_model": "PINHOLE", **lens, "frames": frames}
    (folder / "measured.json").write_text(json.dumps(measured, indent=1))


def _write_images(folder: Path) -> None:
    from volcli import images

    rgba = np.random.default_rng(3).random((12, 16, 4)).astype(np.float32)
    channels = {c: rgba[..., i] for i, c in enumerate("RGBA")}
    channels["Z"] = channels["A"]
    channels |= images.layer_channels("transmittance", 1 - rgba[..., 3])
    channels |= images.layer_channels("optical_depth", rgba[..., 3])
    header: dict[str, str | int | float] = {"volcli:job": "[density]\nfile = 'a.vdb'\n"}
    images.write_exr(folder / "picture.exr", channels, header)
    images.write_png(folder / "picture8.png", rgba, header)
    images.write_png(folder / "picture16.png", rgba, header, bits=16)
