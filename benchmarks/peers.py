"""volcli beside the renderers that people use, on CPUs: time, error of opacity, memory.

    python -m benchmarks.peers [--size N] [--pixels N] [--rounds N]

One cloud, one camera, one number of threads. Each renderer is a process of its own
(`benchmarks.workers`) that loads once and then renders each of its settings when asked, in rounds
that take the renderers in turn, so that a change of the machine's speed meets all. Compilation and
first use are apart: each renderer is started several times for its times of import, of loading and
of its first picture, and each setting is rendered once before it is timed.

Errors are against volcli's exact rule in float64, before it is rounded to a pixel's float32; that
in turn is compared with the tests' reference renderer, which shares no code with volcli, on some of
the rays. A renderer that is not installed is listed as such.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import subprocess
import sys
import tempfile
import threading
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import accuracy
from benchmarks.common import (
    CLOUD_THRESHOLD,
    make_cloud,
    make_dense,
    summary,
    view_of,
    write_results,
)
from benchmarks.plots import draw
from benchmarks.render import FOV, SIGMA_PER_VOXEL
from volcli import schema
from volcli.camera import make_camera
from volcli.grids import density_grid, load_density, open_volume
from volcli.plan import make_plan
from volcli.render import Scene, available_threads, make_integrator

STARTS = 3
SETTING_SECONDS = 10.0
"""A setting gets no more rounds after this; where one takes as long, that one is what counts."""

PATIENCE = 180.0
"""Seconds after which a renderer that does not answer is ended."""

REFERENCE_RAYS = 200

SETTINGS: dict[str, dict[str, dict[str, Any]]] = {
    "volcli": {
        "exact": {"step": None},
        "midpoint 2": {"step": 2.0},
        "midpoint 1": {"step": 1.0},
        "midpoint 0.5": {"step": 0.5},
        "midpoint 0.25": {"step": 0.25},
        "certified 0.1": {"max_error": 0.1},
        "certified 0.01": {"max_error": 0.01},
    },
    "vdb_render": {
        "step 1": {"step": 1.0},
        "step 0.5": {"step": 0.5},
        "step 0.25": {"step": 0.25},
        "step 1, cutoff 1e-6": {"step": 1.0, "cutoff": 1e-6},
    },
    "VTK": {
        "distance 2": {"distance": 2.0},
        "distance 1": {"distance": 1.0},
        "distance 0.5": {"distance": 0.5},
        "distance 0.25": {"distance": 0.25},
    },
    "Mitsuba": {
        "1 sample": {"samples": 1},
        "4 samples": {"samples": 4},
        "16 samples": {"samples": 16},
        "64 samples": {"samples": 64},
    },
}
"""Of each renderer, from fast to slow; the first picture is by the first."""

BASE = "step 1"


class GoneError(Exception):
    """A renderer cannot be had: not installed, or it ended."""


class Process:
    """A worker and the conversation with it."""

    def __init__(self, name: str, scene: Path, folder: Path) -> None:
        self.picture = folder / "opacity.npy"
        self.log = folder / f"{name}.log"
        with self.log.open("w") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "benchmarks.workers", name, str(scene)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
            )
        try:
            self.started = self._answer()
            if "missing" in self.started:
                raise GoneError(f"not installed: {self.started['missing']}")
        except GoneError:
            self.close()
            raise

    def render(self, setting: dict[str, Any]) -> dict[str, Any]:
        """One picture: its times and memory, its ``opacity`` among them."""
        assert self.process.stdin is not None
        request = json.dumps({"setting": setting, "out": str(self.picture)})
        with contextlib.suppress(BrokenPipeError):
            self.process.stdin.write(request + "\n")
            self.process.stdin.flush()
        answer = self._answer()
        return {**answer, "opacity": np.load(self.picture)}

    def close(self) -> None:
        """End the worker, which waits for a request."""
        for stream in (self.process.stdin, self.process.stdout):
            assert stream is not None
            with contextlib.suppress(BrokenPipeError):
                stream.close()
        self.process.wait()

    def _answer(self) -> dict[str, Any]:
        assert self.process.stdout is not None
        timer = threading.Timer(PATIENCE, self.process.kill)
        timer.start()
        line = self.process.stdout.readline()
        timer.cancel()
        if not line:
            said = [text for text in self.log.read_text(errors="replace").splitlines() if text]
            raise GoneError(f"failed: {said[-1] if said else 'no answer'}")
        return json.loads(line)


def truth_of(scene: dict[str, Any], rays: int) -> tuple[Any, float]:
    """Opacity in float64 of every pixel, and its largest difference from the reference's."""
    volume = open_volume(Path(scene["vdb"]))
    header, _ = density_grid(volume, None)
    grid, _ = load_density(volume, header, "error")
    plan = make_plan(schema.Job(), volume, frozenset({"transmittance", "optical_depth"}))
    integrate = make_integrator(Scene(grid, scene["sigma"], (1.0, 1.0, 1.0)), plan)
    camera = make_camera(
        schema.Camera(
            eye=scene["eye"],
            target=scene["target"],
            fov=scene["fov"],
            resolution=(scene["size"], scene["size"]),
        ),
        grid.world_box(),
    )
    tau = []
    for row in range(scene["size"]):
        tau.append(integrate(*camera.rays(slice(row, row + 1), slice(None))).tau)
    truth = -np.expm1(-np.array(tau))
    origins, directions = camera.rays(slice(None), slice(None))
    hit = np.flatnonzero(truth.ravel() > 1e-3)
    chosen = np.random.default_rng(1).choice(hit, min(rays, len(hit)), replace=False)
    lattice = accuracy.lattice_of(volume.read_tree(header), grid)
    traced, _, _ = accuracy.reference.trace_all(
        origins[chosen], directions[chosen], lattice, scene["sigma"]
    )
    return truth, float(np.abs(truth.ravel()[chosen] + np.expm1(-traced)).max())


def compare(folder: Path, size: int, pixels: int, rounds: int) -> dict[str, Any]:
    """All renderers on one cloud of ``size``^3 voxels, ``pixels``^2 rays."""
    vdb = make_cloud(folder / f"cloud_{size}.vdb", size, CLOUD_THRESHOLD)
    dense = folder / "dense.npy"
    origin = make_dense(vdb, dense)
    volume = open_volume(vdb)
    header, _ = density_grid(volume, None)
    low = np.array(origin) + 1
    extent = np.load(dense, mmap_mode="r").shape[::-1]
    eye, target = view_of(np.array([low - 1, low + np.array(extent) - 2], np.float64), FOV)
    scene = {
        "vdb": str(vdb),
        "dense": str(dense),
        "origin": origin,
        "sigma": SIGMA_PER_VOXEL,
        "eye": eye.tolist(),
        "target": target.tolist(),
        "fov": FOV,
        "size": pixels,
        "threads": available_threads(),
    }
    file = folder / "scene.json"
    file.write_text(json.dumps(scene))
    truth, checked = truth_of(scene, REFERENCE_RAYS)

    peers: dict[str, dict[str, Any]] = {name: {} for name in SETTINGS}
    starts: dict[str, list[dict[str, float]]] = {name: [] for name in SETTINGS}
    workers: dict[str, Process] = {}
    for _ in range(STARTS):
        for name, settings in SETTINGS.items():
            if "missing" in peers[name]:
                continue
            if name in workers:
                workers.pop(name).close()
            try:
                worker = workers[name] = Process(name, file, folder)
                first = worker.render(next(iter(settings.values())))
            except GoneError as error:
                peers[name]["missing"] = str(error)
                print(f"  {name}: {error}")
                continue
            starts[name].append({**worker.started, "first_seconds": first["whole"]})

    runs: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for turn in range(rounds + 1):  # the first is not counted
        for name, worker in list(workers.items()):
            if "missing" in peers[name]:
                continue
            for label, setting in SETTINGS[name].items():
                done = runs.setdefault((name, label), [])
                if done and sum(run["whole"] for run in done) > SETTING_SECONDS:
                    continue
                try:
                    ran = worker.render(setting)
                except GoneError as error:
                    peers[name]["missing"] = str(error)
                    break
                error = np.abs(ran.pop("opacity").astype(np.float64) - truth)
                ran["error"] = {
                    "max": float(error.max()),
                    "mean": float(error.mean()),
                    "rms": float(np.sqrt((error**2).mean())),
                }
                ran["turn"] = turn
                if turn == 1 or (turn == 0 and ran["whole"] <= SETTING_SECONDS):
                    done[:] = []  # the first was to warm up
                done.append(ran)
    for worker in workers.values():
        worker.close()
    for name, peer in peers.items():
        _gather(peer, starts[name], {k[1]: v for k, v in runs.items() if k[0] == name})
    _ratios(peers, runs)
    return {
        "cloud": vdb.name,
        "voxels": header.active_voxels,
        "dense_voxels": int(np.prod(extent)),
        "pixels": pixels,
        "truth_against_reference": {"rays": REFERENCE_RAYS, "max": checked},
        "peers": peers,
    }


def _gather(
    peer: dict[str, Any], starts: list[dict[str, float]], runs: dict[str, list[dict[str, Any]]]
) -> None:
    """Results of one renderer from what its processes said."""
    if not starts:
        return
    peer["version"] = starts[0]["version"]
    for key in ("import_seconds", "load_seconds", "first_seconds"):
        if key in starts[0]:
            peer[key] = summary([start[key] for start in starts])
    if not runs:
        return
    peer["peak_bytes"] = max(run["peak"] for done in runs.values() for run in done)
    peer["settings"] = {}
    for label, done in runs.items():
        row = peer["settings"][label] = {
            "seconds": summary([run["seconds"] for run in done]),
            "whole_seconds": summary([run["whole"] for run in done]),
            "opacity_error": done[-1]["error"],
        }
        if done[0]["cells"]:
            row["cells"] = done[0]["cells"]


def _ratios(peers: dict[str, Any], runs: dict[tuple[str, str], list[dict[str, Any]]]) -> None:
    """How many times faster than ``vdb_render -step 1`` each setting is, round by round."""
    base = {run["turn"]: run["seconds"] for run in runs.get(("vdb_render", BASE), ())}
    for (name, label), done in runs.items():
        shared = [base[run["turn"]] / run["seconds"] for run in done if run["turn"] in base]
        if shared and "settings" in peers[name]:
            peers[name]["settings"][label]["times_faster_than_vdb_render"] = summary(shared)


def main(arguments: list[str]) -> None:
    """Compare all that is installed, and write the results and their plot."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.peers")
    parser.add_argument("--size", type=int, default=512, help="the cloud's edge in voxels")
    parser.add_argument("--pixels", type=int, default=512, help="the picture's edge")
    parser.add_argument("--rounds", type=int, default=5)
    asked = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        results = compare(Path(folder), asked.size, asked.pixels, asked.rounds)
    print(f"{results['voxels']:,} voxels, {asked.pixels} x {asked.pixels} rays")
    for name, peer in results["peers"].items():
        if "settings" not in peer:
            print(f"{name}: {peer.get('missing')}")
            continue
        parts = [
            f"{key.removesuffix('_seconds')} {peer[key]['median']:.2f} s"
            for key in ("import_seconds", "load_seconds", "first_seconds")
            if key in peer
        ]
        memory = f"peak {peer['peak_bytes'] / 1e6:.0f} MB"
        print(f"{name} {peer['version']}: " + ", ".join([*parts, memory]))
        for label, row in peer["settings"].items():
            error, seconds = row["opacity_error"], row["seconds"]
            print(
                f"  {label:22s} {seconds['median'] * 1e3:8.0f} ms ({seconds['min'] * 1e3:.0f} to "
                f"{seconds['max'] * 1e3:.0f})   error max {error['max']:.1e} mean "
                f"{error['mean']:.1e} rms {error['rms']:.1e}"
            )
    checked = results["truth_against_reference"]
    print(f"truth against the reference: {checked['max']:.1e} on {checked['rays']} rays")
    write_results("peers", results)
    draw("peers")


if __name__ == "__main__":
    main(sys.argv[1:])
