"""A batch file to its jobs: overrides, sweeps, files, frames and turntables, and names of outputs.

Nothing is rendered here; volumes are opened only where a camera is to frame them.
"""

from __future__ import annotations

import difflib
import itertools
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from volcli.batch import frames as numbered
from volcli.batch.names import fill, paths_of, with_paths
from volcli.batch.orbit import box_of, framing, is_framed, on_orbit
from volcli.batch.schema import EXPANSIONS, Batch, Expansion
from volcli.config import PATHS, from_folder, make_job, parse_setting, read_toml
from volcli.errors import UsageError
from volcli.images.paths import IMAGES
from volcli.outputs import outputs
from volcli.schema import Job
from volcli.transforms import each_camera

_OUTPUT = "output.image"


@dataclass(frozen=True)
class Item:
    """One job of a batch.

    Attributes
    ----------
    job
        Complete: its paths are absolute, and its camera is settled where many jobs share one.
    missing
        The file that the job is to read and that is not there, if so.
    """

    job: Job
    missing: Path | None = None

    @property
    def output(self) -> Path:
        """The picture that the job writes; no other job writes it."""
        assert self.job.output.image is not None, "expansion has seen to it"
        return self.job.output.image


@dataclass(frozen=True)
class Expanded:
    """A batch, ready to run.

    Attributes
    ----------
    notes
        What the user should know of it: frames that seem to be missing, cameras that were chosen.
    """

    items: tuple[Item, ...]
    retries: int
    manifest: Path
    notes: tuple[str, ...]


def read_batch(path: Path, settings: Sequence[str] = ()) -> Expanded:
    """The jobs of a batch file, with settings (``KEY=VALUE``) on top of every one.

    Raises
    ------
    UsageError
        For the first thing that is wrong with the file or a job; no volume is looked into.
    """
    tables = read_toml(path)
    batch = _checked(Batch, tables, str(path))
    entries: tuple[dict[str, Any], ...] = batch.job or ({},)
    items: list[Item] = []
    notes: list[str] = []
    for number, entry in enumerate(entries, 1):
        name = f"{path}: job {number}" if batch.job else str(path)
        own = _checked(Expansion, {k: entry[k] for k in EXPANSIONS if k in entry}, name)
        expansion = batch.model_copy(update={k: getattr(own, k) for k in own.model_fields_set})
        parts = {k: v for k, v in entry.items() if k not in EXPANSIONS}
        base = from_folder(batch.defaults, path.parent)
        over = from_folder(parts, path.parent)
        for job in _swept(base, over, expansion, settings, name, path.parent):
            made, said = _expanded(job, expansion, name)
            items += made
            notes += said
    _refuse_equal_outputs(items, path)
    manifest = None if batch.manifest is None else path.parent / batch.manifest
    return Expanded(
        tuple(items),
        batch.retries,
        Path(os.path.abspath(manifest or _beside(items, path))),  # noqa: PTH100 - keeps links
        tuple(dict.fromkeys(notes)),
    )


def expand_frames(job: Job, frames: str) -> list[tuple[int, Job]]:
    """The jobs of a range of frames: ``volcli render --frames``.

    Raises
    ------
    UsageError
        If the range is none, or two frames have one output.
    """
    where = f"--frames {frames}"
    made = [(frame, _at_frame(job, frame, where)) for frame in numbered.parse_frames(frames, where)]
    _refuse_equal_outputs([Item(job) for _, job in made if job.output.image is not None], where)
    return made


def _checked(model: Any, tables: Any, where: str) -> Any:
    try:
        return model.model_validate(tables)
    except ValidationError as error:
        problem = error.errors()[0]
        key = ".".join(str(part) for part in problem["loc"])
        if problem["type"] == "extra_forbidden":
            known = list(model.model_fields)
            close = difflib.get_close_matches(key, known, n=1)
            hint = f"did you mean '{close[0]}'?" if close else f"there are: {', '.join(known)}"
            raise UsageError(f"{where}: unknown key '{key}'; {hint}") from error
        message = problem["msg"].removeprefix("Value error, ").replace("Input should be", "must be")
        raise UsageError(f"{where}: {key}: {message}") from error


def _swept(
    base: dict[str, Any],
    over: dict[str, Any],
    expansion: Expansion,
    settings: Sequence[str],
    name: str,
    folder: Path,
) -> Iterator[Job]:
    """A job for each combination of the values that are swept over, the last key the fastest."""
    own: list[tuple[str, Any]] = []
    for part, table in over.items():
        if not isinstance(table, dict):
            raise UsageError(f"{name}: {part}: must be a table, [{part}]")
        own += [(f"{part}.{key}", value) for key, value in table.items()]
    typed = [(*parse_setting(text), f"--set {text}") for text in settings]
    names = list(expansion.sweep)
    for values in itertools.product(*expansion.sweep.values()):
        swept: list[tuple[str, Any]] = []
        for key, value in zip(names, values, strict=True):
            if key in PATHS and isinstance(value, str):
                value = str(folder / value)
            swept.append((key, value))
        given = {key for key, _ in own} | set(base.get("quadrature", ()))
        if "quadrature.step" in names and not {"quadrature.rule", "rule"} & {*names, *given}:
            swept.append(("quadrature.rule", "midpoint"))  # the rule that has steps
        spelled = {key: f"{name}: sweep: {key} = {value}" for key, value in swept}
        spelled |= {key: text for key, _, text in typed}
        yield make_job(
            base,
            [*own, *swept, *((key, value) for key, value, _ in typed)],
            source=name,
            spelled=spelled,
        )


def _expanded(job: Job, expansion: Expansion, name: str) -> tuple[list[Item], list[str]]:
    """The jobs of one: files, then frames or a turntable."""
    file = job.density.file
    if file is None:
        raise UsageError(f"{name}: no density.file; name the volume to render")
    if job.output.image is None:
        raise UsageError(
            f"{name}: no output.image; name the pictures, such as out/{{stem}}.exr or out/####.exr"
        )
    items: list[Item] = []
    notes: list[str] = []
    files = [file]
    if numbered.is_wild(file):
        files = numbered.matches(file)
        if not files:
            raise UsageError(f"{name}: {file}: no file is named so; check the path")
    for file in files:
        found, said = _sequence(with_paths(job, {"density.file": file}), expansion, name)
        items += found
        notes += said
    return items, notes


def _sequence(job: Job, expansion: Expansion, name: str) -> tuple[list[Item], list[str]]:
    """The frames of a job whose volume is one file or one sequence of files."""
    file, orbit = job.density.file, expansion.orbit
    assert file is not None
    notes: list[str] = []
    frames: list[int] | None = None
    if expansion.frames is not None:
        frames = numbered.parse_frames(expansion.frames, f"{name}: frames")
    elif numbered.has_place(file) and not file.exists():
        frames = numbered.frames_on_disk(file)
        if not frames:
            raise UsageError(f"{name}: {file}: there are no frames of it; check the path")
        missing = numbered.gaps(frames)
        if missing:
            notes.append(f"{file}: frames {numbered.as_ranges(missing)} are missing")
    if orbit is not None:
        if frames is not None and orbit.frames is not None:
            raise UsageError(
                f"{name}: orbit.frames: the frames are those of the sequence; leave it out, and "
                "the camera goes around once while they pass"
            )
        if frames is None and orbit.frames is None:
            raise UsageError(f"{name}: orbit.frames is missing; give the number of pictures")
        frames = frames or list(range(1, (orbit.frames or 0) + 1))
    if frames is None:
        return [_item(one, name) for one in _each_camera(job, name)], notes
    jobs = [_at_frame(job, frame, name) for frame in frames]
    if is_framed(job.camera) or orbit is not None:
        jobs, said = _filmed(jobs, expansion)
        notes += said
    return [_item(one, name) for made in jobs for one in each_camera(made)], notes


def _each_camera(job: Job, name: str) -> list[Job]:
    """The jobs of one without frames: one for each camera of its ``transforms``, if it says all.

    The number of a camera is the frame's, where the name of the output has a place for it.
    """
    output = job.output.image
    assert output is not None
    if job.camera.frame == "all" and (numbered.has_place(output) or "{frame" in str(output)):
        nameless = job.model_copy(update={"output": job.output.model_copy(update={"image": None})})
        return [
            _named(job.model_copy(update={"camera": one.camera}), frame, name)
            for frame, one in enumerate(each_camera(nameless))
        ]
    return list(each_camera(_named(job, None, name)))


def _filmed(jobs: list[Job], expansion: Expansion) -> tuple[list[Job], list[str]]:
    """The frames of a sequence with one camera for all of it, going around if it is to."""
    camera, orbit = jobs[0].camera, expansion.orbit
    box = None
    notes = []
    if is_framed(camera):
        volumes = {job.density.file: job for job in jobs}
        box = box_of(volumes.values())
        if box is None:  # nothing can be read, and every job will say why
            return jobs, []
        if len(jobs) > 1:
            notes.append("no camera: one was chosen that shows all of the volume in every frame")
    if orbit is not None:
        cameras = on_orbit(camera, orbit, len(jobs), box)
    else:
        assert box is not None
        cameras = [framing(camera, box)] * len(jobs)
    filmed = [
        job.model_copy(update={"camera": camera}) for job, camera in zip(jobs, cameras, strict=True)
    ]
    return filmed, notes


def _at_frame(job: Job, frame: int, where: str) -> Job:
    """A job with its frame's number put into its paths."""
    paths = {
        key: numbered.with_frame(path, frame)
        for key, path in paths_of(job).items()
        if key != _OUTPUT and numbered.has_place(path) and not path.exists()
    }
    return _named(with_paths(job, paths), frame, where)


def _named(job: Job, frame: int | None, where: str) -> Job:
    """A job with the name of its output worked out."""
    if job.output.image is not None:
        output = fill(job.output.image, job, frame, where)
        if frame is not None:
            output = numbered.with_frame(output, frame)
        job = with_paths(job, {_OUTPUT: output})
    return job


def _item(job: Job, where: str) -> Item:
    paths = {key: Path(os.path.abspath(path)) for key, path in paths_of(job).items()}  # noqa: PTH100
    job = with_paths(job, paths)
    assert job.output.image is not None
    if job.output.image.suffix.lower() not in IMAGES:
        raise UsageError(f"{where}: {job.output.image.name}: must end in {' or '.join(IMAGES)}")
    inputs = [path for key, path in paths_of(job).items() if key != _OUTPUT]
    return Item(job, next((path for path in inputs if not path.exists()), None))


def _refuse_equal_outputs(items: Sequence[Item], where: Any) -> None:
    """Raise a UsageError if two jobs write one file."""
    seen: dict[str, int] = {}
    for number, item in enumerate(items, 1):
        for path in outputs(item.job).values():
            other = seen.setdefault(os.path.realpath(path), number)
            if other != number:
                first, second = (items[n - 1].job.density.file for n in (other, number))
                raise UsageError(
                    f"{where}: {path}: two jobs write it ({other}, of {_name(first)}, and "
                    f"{number}, of {_name(second)}); tell them apart in output.image by a field, "
                    "such as {stem}, {frame:04d} or {density.scale}"
                )


def _name(path: Path | None) -> str:
    return "no volume" if path is None else path.name


def _beside(items: Sequence[Item], path: Path) -> Path:
    """Where the manifest of a batch is if the file does not say: in the folder of all outputs."""
    folders = [str(item.output.parent) for item in items]
    return Path(os.path.commonpath(folders)) / f"{path.stem}.manifest.jsonl"
