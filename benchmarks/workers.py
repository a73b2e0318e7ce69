"""Renderers to compare, each alone in a process that loads a volume once and renders on request.

    python -m benchmarks.workers NAME SCENE.json

The first line of its output says what it is and how long importing and loading took; then for each
request ``{"setting": {...}, "out": FILE.npy}`` on its input there is one line of time and memory,
and the opacity of every pixel, row 0 at the top, is in FILE.npy. A renderer that is not installed
says so in the first line. Nothing of volcli is imported for the others, so that it is not in their
memory.

Scenes have voxels of one world unit: ``vdb`` and ``dense`` (z, y, x) are the files, ``origin`` the
lattice point of the first of ``dense``, ``low`` and ``high`` the lattice box.
"""

from __future__ import annotations

import ctypes
import json
import os
import re
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

Scene = dict[str, Any]
Setting = dict[str, Any]

DENSITIES = 4096
"""Points of VTK's piecewise-linear opacity: far more than its tables can tell apart."""

RAYS_AT_ONCE = 1 << 22
"""For Mitsuba, so that memory does not grow with the number of samples."""


TRY_LLVM = """
import drjit as dr, mitsuba as mi
mi.set_variant("llvm_ad_mono")
x = dr.arange(mi.Float, 64)
dr.eval(dr.maximum(x, 3.0 - x))
"""
"""Compiles what an LLVM that is too old cannot."""


class NotInstalledError(Exception):
    """A renderer that this machine lacks, and why."""


class Volcli:
    """This program, from a loaded grid to finished arrays."""

    def __init__(self) -> None:
        try:
            import volcli.kernels.rays
            import volcli.render  # noqa: F401 - the imports are timed apart
        except ImportError as error:
            raise NotInstalledError(str(error)) from error
        self.version = version("volcli")

    def load(self, scene: Scene) -> None:
        """Read the .vdb file, build bricks and bound them."""
        from volcli import schema
        from volcli.bounds import scene_bounds
        from volcli.camera import make_camera
        from volcli.grids import density_grid, load_density, open_volume
        from volcli.render import Scene as Rendered

        self.threads = scene["threads"]
        self.volume = open_volume(Path(scene["vdb"]))
        grid, _ = load_density(self.volume, density_grid(self.volume, None)[0], "error")
        made = Rendered(grid, scene["sigma"], (1.0, 1.0, 1.0))
        self.scene = replace(made, bounds=scene_bounds(made, False))
        size = (scene["size"], scene["size"])
        camera = schema.Camera(
            eye=scene["eye"], target=scene["target"], fov=scene["fov"], resolution=size
        )
        self.camera = make_camera(camera, grid.world_box())

    def render(self, setting: Setting) -> tuple[float, Any]:
        """``step`` or ``max_error``: the rule, else exact; ``depth``: also the hit distance."""
        from volcli import schema
        from volcli.plan import make_plan
        from volcli.render import render

        layers = {"picture", "transmittance", "optical_depth"}
        step = setting.get("step")
        quadrature = schema.Quadrature(
            rule="exact" if step is None else "midpoint",
            step=step,
            max_error=setting.get("max_error"),
        )
        plan = make_plan(
            schema.Job(quadrature=quadrature),
            self.volume,
            frozenset(layers | {"depth"} if setting.get("depth") else layers),
        )
        result = render(self.scene, plan, self.camera, threads=self.threads)
        self.cells = result.evaluations
        return result.render_seconds, result.opacity


class VdbRender:
    """OpenVDB's vdb_render; each picture is a process of its own, which loads the file again."""

    def __init__(self) -> None:
        if shutil.which("vdb_render") is None:
            raise NotInstalledError("no vdb_render (Debian: libopenvdb-tools)")
        from benchmarks.render import vdb_render

        self.run = vdb_render
        said = subprocess.run(
            ["vdb_render", "-version"], capture_output=True, text=True, check=False
        )
        found = re.search(r"OpenVDB library version: ([\d.]+)", said.stdout + said.stderr)
        self.version = f"of OpenVDB {found[1]}" if found else ""

    def load(self, scene: Scene) -> None:
        """Nothing: the program loads."""
        self.scene = scene

    def render(self, setting: Setting) -> tuple[float, Any]:
        """``step`` in voxels and ``cutoff``."""
        scene = self.scene
        ran = self.run(
            Path(scene["vdb"]),
            scene["eye"],
            scene["target"],
            step=setting["step"],
            cutoff=setting.get("cutoff"),
            size=(scene["size"], scene["size"]),
            threads=scene["threads"],
        )
        self.peak, self.whole = ran.peak_bytes, ran.whole_seconds
        return ran.seconds, ran.opacity


class Vtk:
    """VTK's ray caster for CPUs, offscreen, with opacity read before it becomes 8 bits."""

    def __init__(self) -> None:
        try:
            import vtkmodules.vtkRenderingOpenGL2
            import vtkmodules.vtkRenderingVolumeOpenGL2  # noqa: F401 - they register themselves
        except ImportError as error:
            raise NotInstalledError(f"{error} (pip: vtk)") from error
        self.version = version("vtk")

    def load(self, scene: Scene) -> None:
        """The dense array, and all but the sample distance."""
        from vtkmodules.util.numpy_support import numpy_to_vtk
        from vtkmodules.vtkCommonDataModel import vtkImageData, vtkPiecewiseFunction
        from vtkmodules.vtkRenderingCore import (
            vtkColorTransferFunction,
            vtkRenderer,
            vtkRenderWindow,
            vtkVolume,
            vtkVolumeProperty,
        )
        from vtkmodules.vtkRenderingVolume import vtkFixedPointVolumeRayCastMapper

        array = np.load(scene["dense"])
        self.size, self.sigma, self.largest = scene["size"], scene["sigma"], float(array.max())
        image = vtkImageData()
        image.SetDimensions(*array.shape[::-1])
        image.SetOrigin(*scene["origin"])
        self.values = numpy_to_vtk(array.ravel())  # shares the array, which lives in here
        image.GetPointData().SetScalars(self.values)
        self.mapper = vtkFixedPointVolumeRayCastMapper()
        self.mapper.SetInputData(image)
        self.mapper.AutoAdjustSampleDistancesOff()
        self.mapper.LockSampleDistanceToInputSpacingOff()
        self.mapper.IntermixIntersectingGeometryOff()
        self.mapper.SetImageSampleDistance(1.0)
        self.mapper.SetNumberOfThreads(scene["threads"])
        white = vtkColorTransferFunction()
        white.AddRGBPoint(0.0, 1.0, 1.0, 1.0)
        self.opacity = vtkPiecewiseFunction()
        self.look = vtkVolumeProperty()
        self.look.SetColor(white)
        self.look.SetScalarOpacity(self.opacity)
        self.look.SetInterpolationTypeToLinear()
        self.look.ShadeOff()
        self.volume = vtkVolume()
        self.volume.SetMapper(self.mapper)
        self.volume.SetProperty(self.look)
        renderer = vtkRenderer()
        renderer.AddVolume(self.volume)
        camera = renderer.GetActiveCamera()
        camera.SetPosition(*scene["eye"])
        camera.SetFocalPoint(*scene["target"])
        camera.SetViewUp(0.0, 1.0, 0.0)
        camera.SetViewAngle(scene["fov"])
        renderer.ResetCameraClippingRange()
        self.window = vtkRenderWindow()
        self.window.SetOffScreenRendering(True)
        self.window.SetMultiSamples(0)
        self.window.SetSize(self.size, self.size)
        self.window.AddRenderer(renderer)

    def render(self, setting: Setting) -> tuple[float, Any]:
        """``distance`` between samples in voxels.

        With the unit of distance equal to that between samples no correction is left to round, and
        the opacity of one sample is 1 - exp(-sigma density distance), as finely as VTK keeps it.
        """
        distance = setting["distance"]
        if distance != getattr(self, "distance", None):
            self.distance = distance
            self.mapper.SetSampleDistance(distance)
            self.mapper.SetInteractiveSampleDistance(distance)
            self.look.SetScalarOpacityUnitDistance(distance)
            self.opacity.RemoveAllPoints()
            for density in np.linspace(0.0, self.largest, DENSITIES):
                opacity = -np.expm1(-self.sigma * density * distance)
                self.opacity.AddPoint(float(density), float(opacity))
        begin = time.perf_counter()
        self.window.Render()
        whole = time.perf_counter() - begin
        return min(whole, self.mapper.GetTimeToDraw() or whole), self._alpha()

    def _alpha(self) -> Any:
        """Alpha of the caster's own picture, 15 bits; it covers a part of the window."""
        picture = self.mapper.GetRayCastImage()
        width, height = picture.GetImageInUseSize()
        columns, rows = picture.GetImageMemorySize()
        x, y = picture.GetImageOrigin()
        address = int(picture.GetImage().split("_")[1], 16)
        pixels = (ctypes.c_uint16 * (columns * rows * 4)).from_address(address)
        alpha = np.frombuffer(pixels, np.uint16).reshape(rows, columns, 4)[:height, :width, 3]
        found = np.zeros((self.size, self.size))
        found[y : y + height, x : x + width] = alpha / 32767.0
        return found[::-1]


class Mitsuba:
    """Mitsuba's volpath: an absorbing volume before light of radiance 1, so that a pixel is T.

    Where it finds an LLVM that can compile it, it is given rays through the middles of pixels. Else
    it runs as plain C++, with rays of its own, which are spread over each pixel.
    """

    def __init__(self) -> None:
        try:
            import drjit as dr
            import mitsuba as mi
        except ImportError as error:
            raise NotInstalledError(f"{error} (pip: mitsuba)") from error
        # An LLVM that is too old ends the program that tries it.
        begin = time.perf_counter()
        tried = subprocess.run(
            [sys.executable, "-c", TRY_LLVM], stdout=sys.stderr.fileno(), check=False
        )
        self.apart = time.perf_counter() - begin
        self.compiled = tried.returncode == 0
        variant = "llvm_ad_mono" if self.compiled else "scalar_rgb"
        mi.set_variant(variant)
        self.mi, self.dr = mi, dr
        self.version = f"{version('mitsuba')}, {variant}"

    def load(self, scene: Scene) -> None:
        """The dense array as a grid of extinction in a cube."""
        mi, dr = self.mi, self.dr
        dr.set_thread_count(scene["threads"])
        self.size, self.seed = scene["size"], 0
        array = np.load(scene["dense"])
        low = np.array(scene["origin"]) - 0.5  # values lie in the middles of Mitsuba's voxels
        extent = np.array(array.shape[::-1])
        unit = mi.ScalarTransform4f().translate(low.tolist()).scale(extent.tolist())
        both = mi.ScalarTransform4f().translate([0.5] * 3).scale(0.5)  # of a cube from -1 to 1
        grid = mi.VolumeGrid(array[..., None])
        sigma_t = {"type": "gridvolume", "grid": grid, "to_world": unit, "raw": True}
        medium = {
            "type": "heterogeneous",
            "sigma_t": sigma_t,
            "scale": scene["sigma"],
            "albedo": 0.0,
        }
        shape = {
            "type": "cube",
            "to_world": unit @ both,
            "bsdf": {"type": "null"},
            "interior": medium,
        }
        light = {"type": "constant", "radiance": 1.0}
        self.integrator = mi.load_dict({"type": "volpath", "max_depth": -1, "rr_depth": 1 << 20})
        film = {"type": "hdrfilm", "width": self.size, "height": self.size}
        sensor = {
            "type": "perspective",
            "fov": scene["fov"],
            "to_world": mi.ScalarTransform4f().look_at(scene["eye"], scene["target"], [0, 1, 0]),
            "film": {**film, "rfilter": {"type": "box"}, "component_format": "float32"},
        }
        self.scene = mi.load_dict(
            {"type": "scene", "shape": shape, "light": light, "sensor": sensor}
        )
        if self.compiled:
            self.sampler = mi.load_dict({"type": "independent"})
            self.origin = mi.Point3f(np.array(scene["eye"]))
            self.directions = mi.Vector3f(_directions(scene))

    def render(self, setting: Setting) -> tuple[float, Any]:
        """``samples`` per pixel."""
        begin = time.perf_counter()
        self.seed += 1
        opacity = (
            self._given(setting["samples"]) if self.compiled else self._own(setting["samples"])
        )
        return time.perf_counter() - begin, opacity

    def _own(self, samples: int) -> Any:
        light = self.mi.render(self.scene, integrator=self.integrator, spp=samples, seed=self.seed)
        return 1.0 - np.asarray(light)[..., 0].astype(np.float64)

    def _given(self, samples: int) -> Any:
        mi, pixels = self.mi, self.size**2
        total = np.zeros(pixels)
        done = 0
        while done < samples:
            now = max(1, min(samples - done, RAYS_AT_ONCE // pixels))
            self.sampler.seed(self.seed * 1000 + done, now * pixels)
            ray = mi.RayDifferential3f(self.origin, self.dr.tile(self.directions, now))
            light, _, _ = self.integrator.sample(self.scene, self.sampler, ray)
            total += np.asarray(light[0]).reshape(now, pixels).sum(axis=0, dtype=np.float64)
            done += now
        return (1.0 - total / samples).reshape(self.size, self.size)


def _directions(scene: Scene) -> Any:
    """(3, n) unit directions through the middles of the pixels, row by row from the top."""
    forward = np.subtract(scene["target"], scene["eye"])
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    size = scene["size"]
    across = ((np.arange(size) + 0.5) * 2 / size - 1) * np.tan(np.radians(scene["fov"]) / 2)
    x, y = np.meshgrid(across, -across)
    found = forward + x[..., None] * right + y[..., None] * np.cross(right, forward)
    found /= np.linalg.norm(found, axis=-1, keepdims=True)
    return found.reshape(-1, 3).T


PEERS = {"volcli": Volcli, "vdb_render": VdbRender, "VTK": Vtk, "Mitsuba": Mitsuba}


def peak_bytes() -> int:
    """The peak memory of this very program: ru_maxrss would count what its parent held."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM:")) * 1024


def main(arguments: list[str]) -> None:
    """Serve one renderer."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what a library prints is not an answer

    def say(**what: Any) -> None:
        print(json.dumps(what), file=answers, flush=True)

    scene = json.loads(Path(arguments[1]).read_text())
    begin = time.perf_counter()
    try:
        peer = PEERS[arguments[0]]()
    except NotInstalledError as error:
        say(missing=str(error))
        return
    imported = time.perf_counter()
    peer.load(scene)
    loaded = time.perf_counter()
    times = {
        "import_seconds": imported - begin - getattr(peer, "apart", 0.0),
        "load_seconds": loaded - imported,
    }
    say(version=peer.version, **({} if isinstance(peer, VdbRender) else times))
    for line in sys.stdin:
        request = json.loads(line)
        begin = time.perf_counter()
        seconds, opacity = peer.render(request["setting"])
        whole = getattr(peer, "whole", time.perf_counter() - begin)
        peak = getattr(peer, "peak", None) or peak_bytes()
        np.save(request["out"], opacity)
        say(seconds=seconds, whole=whole, peak=peak, cells=getattr(peer, "cells", None))


if __name__ == "__main__":
    main(sys.argv[1:])
