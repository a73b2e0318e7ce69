"""What a job reads: each grid once, none that no term needs, and a plan that says so."""

import json
from pathlib import Path

import numpy as np
import pytest
from commandline import volcli
from vdbwriter import Grid, write_vdb

from volcli.config import make_job
from volcli.errors import VolumeError
from volcli.grids import BrickGrid, open_volume
from volcli.grids.vdb import VdbFile
from volcli.plan import make_plan
from volcli.render import Scene, Source
from volcli.run import load, prepare
from volcli.scene import make_scene, open_volumes, read_grids, scene_box

FULL = np.ones((8, 8, 8), bool)
RAMP = {"stops": [[0, 0, 0, 0], [1, 1, 1, 1]]}


def leaf(low, high, channels=()):
    values = np.linspace(low, high, 512).reshape(8, 8, 8)
    return np.stack([values] * 3, axis=-1) if channels else values


@pytest.fixture
def fire(tmp_path):
    """Density, temperature, flame, a mask, and a colour, and far from them all a light."""
    path = tmp_path / "fire.vdb"
    floats = {"density": (-0.1, 1.0), "temperature": (300.0, 3000.0), "flame": (0.0, 1.0)}
    grids = [
        Grid(name=name, leaves={(0, 0, 0): (leaf(*ends), FULL)}) for name, ends in floats.items()
    ]
    grids.append(
        Grid(name="hot", value_type="bool", leaves={(0, 0, 0): (np.ones((8, 8, 8)), FULL)})
    )
    grids.append(
        Grid(
            name="Cd",
            value_type="vec3s",
            background=(0, 0, 0),
            leaves={(0, 0, 0): (leaf(-1, 2, (3,)), FULL)},
        )
    )
    grids.append(Grid(name="light", leaves={(80, 0, 0): (leaf(1, 2), FULL)}))
    write_vdb(path, grids)
    return path


@pytest.fixture
def read(monkeypatch):
    """The labels of the grids that are read from here on."""
    labels = []
    whole = VdbFile.read_tree

    def counted(self, header, progress=None):
        labels.append(header.label)
        return whole(self, header, progress)

    monkeypatch.setattr(VdbFile, "read_tree", counted)
    return labels


def scene_of(path, **tables):
    tables["density"] = {"file": path, **tables.get("density", {})}
    job = make_job(tables)
    volumes = open_volumes(job)
    plan = make_plan(job, volumes.density, frozenset({"picture"}), volumes.color, volumes.emission)
    grids, warnings = read_grids(job, plan, volumes)
    scene, notes = make_scene(job, plan, volumes, grids)
    return scene, plan, [*plan.warnings, *warnings, *notes]


JOBS = {
    "nothing": ({}, ["density"]),
    "a constant": ({"color": {"constant": [1, 0, 0]}}, ["density"]),
    "a Vec3 grid": ({"color": {"grid": "Cd"}}, ["Cd", "density"]),
    "a ramp": ({"color": {"ramp": {"grid": "flame", **RAMP}}}, ["density", "flame"]),
    "a blackbody": ({"color": {"blackbody": {"grid": "temperature"}}}, ["density", "temperature"]),
    "a ramp of the density": ({"color": {"ramp": RAMP}}, ["density"]),
    "emission of the colour's grid": (
        {"color": {"grid": "Cd"}, "emission": {"grid": "Cd"}},
        ["Cd", "density"],
    ),
    "everything of the density": (
        {"color": {"ramp": RAMP}, "emission": {"ramp": {"grid": "density"}}},
        ["density"],
    ),
    "emission of no strength": ({"emission": {"grid": "flame", "strength": 0}}, ["density"]),
    "emission alone": ({"density": {"scale": 0}, "emission": {"grid": "flame"}}, ["flame"]),
    "no density, and a colour": (
        {"density": {"scale": 0}, "emission": {"grid": "flame"}, "color": {"grid": "Cd"}},
        ["flame"],
    ),
}


@pytest.mark.parametrize(("tables", "expected"), JOBS.values(), ids=JOBS)
def test_what_is_read_is_what_the_plan_says_and_each_grid_once(fire, read, tables, expected):
    _, plan, _ = scene_of(fire, **tables)
    assert sorted(read) == expected
    named = [term for term in plan.terms if term.wanted and term.grid is not None]
    assert sorted({term.grid for term in named}) == expected
    sizes = {h.label: h.file_bytes for h in open_volume(fire).headers}
    told = sum(term.bytes_read for term in plan.terms)
    assert told == sum(sizes[label] for label in expected)


@pytest.mark.parametrize(("tables", "expected"), JOBS.values(), ids=JOBS)
def test_no_byte_of_a_grid_that_no_term_needs_is_looked_at(fire, tables, expected):
    """Its leaves, its table of nodes and all: everything behind its header is overwritten."""
    data = bytearray(fire.read_bytes())
    volume = open_volume(fire)
    for grid in volume._grids:
        if grid.header.label not in expected:
            end = grid.descriptor.end
            data[grid.root_at : end] = b"\xff" * (end - grid.root_at)
    whole, *_ = scene_of(fire, **tables)
    fire.write_bytes(data)
    damaged, *_ = scene_of(fire, **tables)
    np.testing.assert_array_equal(damaged.density.arrays.atlas, whole.density.arrays.atlas)
    with pytest.raises(VolumeError):
        scene_of(fire, density={"grid": "light"})  # the test itself: this is what is overwritten


def test_the_sizes_of_grids_add_up_to_the_file(fire):
    volume = open_volume(fire)
    sizes = [h.file_bytes for h in volume.headers]
    assert 0.95 * fire.stat().st_size < sum(sizes) < fire.stat().st_size


def test_a_grid_that_is_the_density_and_a_source_is_held_once(fire):
    scene, _, warnings = scene_of(fire, density={"grid": "flame"}, color={"ramp": RAMP})
    assert scene.density is scene.color.grid
    assert warnings == []


def test_values_below_0_are_clamped_for_the_density_and_kept_for_the_source(fire):
    alone, *_ = scene_of(fire)
    scene, _, warnings = scene_of(fire, color={"ramp": RAMP})
    assert scene.density.field_range[0] == 0
    assert scene.color.grid.field_range[0] == pytest.approx(-0.1)
    assert any("has values below 0, down to -0.1, taken as 0" in w for w in warnings)
    # Bricks that hold nothing but what was below 0 are left out where values are clamped first.
    kept = scene.density.arrays.atlas.any(axis=1)
    np.testing.assert_array_equal(scene.density.arrays.atlas[kept], alone.density.arrays.atlas)


def test_a_transfer_function_sees_values_below_0(fire):
    scene, plan, warnings = scene_of(fire, density={"ramp": {"stops": [[-0.1, 1], [0, 0]]}})
    assert plan.transfer
    assert scene.density.field_range[0] == pytest.approx(-0.1)
    assert scene.transfer.at(-0.1) == 1
    assert warnings == []


def test_a_transfer_function_of_the_background_is_cut_with_a_warning(fire):
    *_, warnings = scene_of(fire, density={"ramp": {"stops": [[0, 0.5], [1, 1]]}})
    assert any("is 0.5 outside its voxels; cut at its active box" in w for w in warnings)


def test_emission_outside_its_voxels_is_cut_with_a_warning(fire):
    ramp = {"grid": "flame", "stops": [[0, 1, 0, 0], [1, 1, 1, 1]]}
    *_, warnings = scene_of(fire, emission={"ramp": ramp})
    assert any("emits outside its voxels" in w for w in warnings)
    *_, warnings = scene_of(fire, emission={"ramp": {"grid": "flame", "map": "inferno"}})
    assert not any("emits" in w for w in warnings), "a map that begins nearly black"


def test_a_ramp_takes_the_range_of_the_active_values(fire):
    scene, *_ = scene_of(fire, color={"ramp": {"grid": "temperature"}})
    assert (scene.color.table.knots[0], scene.color.table.knots[-1]) == (300, 3000)


def test_a_mask_is_coloured_from_its_outside_to_its_inside(fire):
    scene, *_ = scene_of(fire, color={"ramp": {"grid": "hot", "map": "gray"}})
    np.testing.assert_allclose(scene.color.table.at([0, 1]), [[0] * 3, [1] * 3], atol=1e-12)


def test_a_source_comes_out_of_the_cache_with_its_range(fire, tmp_path, read):
    job = make_job({"density": {"file": fire}, "color": {"ramp": {"grid": "temperature"}}})
    prepared = prepare(job, writes=False)
    scenes = [load(prepared, cache=tmp_path / "cache").scene for _ in range(2)]
    assert sorted(read) == ["density", "temperature"]
    first, second = (scene.color for scene in scenes)
    np.testing.assert_array_equal(first.table.knots, second.table.knots)
    assert first.grid.active_range == second.grid.active_range == (300, 3000)


def test_colour_and_emission_may_lie_in_other_files(fire, tmp_path, read):
    other = tmp_path / "other.vdb"
    write_vdb(other, [Grid(name="heat", leaves={(8, 0, 0): (leaf(0, 1), FULL)})])
    scene, *_ = scene_of(fire, emission={"file": other, "grid": "heat"}, color={"grid": "Cd"})
    assert sorted(read) == ["Cd", "density", "heat"]
    assert scene.emission.grid.active_box[0][0] == 8
    _, plan, _ = scene_of(fire, color={"file": other, "ramp": RAMP})
    assert plan.color.label == "heat", "the only scalar grid of that file"


def test_one_file_under_two_names_is_opened_and_read_once(fire, read, monkeypatch):
    monkeypatch.chdir(fire.parent)
    spelled = Path("..") / fire.parent.name / fire.name
    scene_of(fire, color={"file": spelled, "grid": "Cd"}, emission={"grid": "Cd"})
    assert sorted(read) == ["Cd", "density"]


def test_what_is_framed_is_what_absorbs_and_what_emits(fire):
    scene, *_ = scene_of(fire, emission={"grid": "light"})
    np.testing.assert_allclose(scene_box(scene), [[0, 0, 0], [43.5, 3.5, 3.5]])
    scene, *_ = scene_of(fire, density={"scale": 0}, emission={"grid": "light"})
    np.testing.assert_allclose(scene_box(scene), [[40, 0, 0], [43.5, 3.5, 3.5]])


def test_nothing_is_framed_where_nothing_is(tmp_path):
    path = tmp_path / "empty.vdb"
    write_vdb(path, [Grid(), Grid(name="flame")])
    scene, _, warnings = scene_of(path, emission={"grid": "flame"})
    assert scene_box(scene) is None
    assert any("is empty; it absorbs nothing" in w for w in warnings)


def test_emission_alone_has_an_empty_density_on_its_own_lattice(fire):
    scene, plan, _ = scene_of(fire, density={"scale": 0}, emission={"grid": "light"})
    assert plan.density is None
    assert scene.density.is_empty
    np.testing.assert_array_equal(
        scene.density.world_from_index, scene.emission.grid.world_from_index
    )


def test_a_colour_grid_keeps_its_strength_apart_from_its_values(fire):
    scene, *_ = scene_of(fire, color={"grid": "Cd", "strength": 3})
    assert (scene.color.table, scene.color.scale) == (None, 3)
    assert scene.color.grid.field_range == (-1, 2)


def test_a_tint_and_a_level_set_are_told_by_the_plan(fire):
    _, plan, _ = scene_of(fire, density={"tint": [1, 0.5, 0], "level_set": "fog"})
    assert (plan.tint, plan.level_set, plan.transfer) == (True, True, False)


def test_a_level_set_that_is_a_source_too_is_read_for_each(fire, read):
    """As fog it is another grid; the source has the distances as they are stored."""
    scene, plan, _ = scene_of(fire, density={"level_set": "fog"}, color={"ramp": RAMP})
    assert read == ["density", "density"]
    first, colour = (t for t in plan.terms if t.grid == "density")
    assert first.bytes_read == colour.bytes_read > 0
    assert scene.density.field_range == (0, 1)
    assert scene.color.grid.field_range[1] == 1
    assert scene.color.grid.field_range[0] == pytest.approx(-0.1)


def test_scenes_of_a_grid_alone_need_no_more_than_before():
    grid = object.__new__(BrickGrid)
    assert Scene(grid, 1.0, Source(grid)).emission is None


def test_the_plan_as_json_has_the_bytes_read_and_those_held(fire):
    flags = ("--set", "color.ramp.grid=flame", "--set", "emission.grid=flame")
    ran = volcli("render", fire, "--explain", "--json", *flags)
    assert ran.code == 0, ran.err
    plan = {term["name"]: term for term in json.loads(ran.out)["plan"]}
    sizes = {h.label: h.file_bytes for h in open_volume(fire).headers}
    assert plan["colour"]["bytes_read"] == sizes["flame"]
    assert plan["emission"]["bytes_read"] == plan["emission"]["bytes_held"] == 0
    assert "read once" in plan["emission"]["why"]
    assert plan["colour"]["bytes_held"] > 729 * 4
    assert plan["optical depth"]["evaluations"] == 1
    assert plan["hit depth"]["wanted"], "as if for an EXR"
