"""Job files and settings to jobs: every field, in every way that it can be written."""

import re
import tomllib
from itertools import combinations
from pathlib import Path

import pytest
import tomli_w
from hypothesis import given
from hypothesis import strategies as st

from volcli.config import job_as_toml, load_job, make_job, parse_setting
from volcli.errors import UsageError
from volcli.schema import MAPS, Job, field, keys

finite = st.floats(allow_nan=False, allow_infinity=False)
positive = st.floats(min_value=1e-300, allow_infinity=False)
light = st.floats(min_value=0, allow_infinity=False)
vectors = st.lists(finite, min_size=3, max_size=3)
colours = st.lists(light, min_size=3, max_size=3)
# What TOML can hold; a path of no letters is the folder, which is nothing to write to.
texts = st.text(st.characters(exclude_categories=["Cs", "Cc"]), min_size=1, max_size=12)
paths = texts.map(lambda text: str(Path(text)))
pixels = st.integers(1, 65536)

ascending = st.lists(finite, min_size=1, max_size=4, unique=True).map(sorted)
density_stops = ascending.flatmap(lambda v: st.tuples(*(st.tuples(st.just(x), light) for x in v)))
colour_stops = ascending.flatmap(
    lambda v: st.tuples(*(st.tuples(st.just(x), light, light, light) for x in v))
)


def listed(stops):
    return [list(stop) for stop in stops]


ranges = st.lists(finite, min_size=2, max_size=2, unique=True).map(sorted)
ramps = st.one_of(
    st.fixed_dictionaries({}, optional={"grid": texts, "map": texts, "range": ranges}),
    st.fixed_dictionaries({"stops": colour_stops.map(listed)}, optional={"grid": texts}),
)
blackbodies = st.fixed_dictionaries(
    {"grid": texts, "scale": finite, "offset": finite, "normalized": st.booleans()}
)

FIELDS = {
    "density.file": paths,
    "density.grid": texts,
    "density.scale": positive,
    "density.tint": colours.filter(any),
    "density.ramp": density_stops.map(lambda stops: {"stops": listed(stops)}),
    "density.level_set": st.just("fog"),
    "density.interpolation": st.sampled_from(["linear", "nearest"]),
    "density.nonfinite": st.sampled_from(["error", "zero"]),
    "density.reader": st.sampled_from(["volcli", "openvdb"]),
    "color.constant": colours,
    "color.grid": texts,
    "color.ramp": ramps,
    "color.blackbody": blackbodies,
    "color.strength": light,
    "color.file": paths,
    "emission.grid": texts,
    "emission.constant": colours,
    "emission.ramp": ramps,
    "emission.blackbody": blackbodies,
    "emission.strength": light,
    "emission.file": paths,
    "camera.type": st.sampled_from(["perspective", "orthographic", "panorama"]),
    "camera.eye": vectors,
    "camera.target": vectors,
    "camera.up": vectors.filter(any),
    "camera.fov": st.floats(0, 180, exclude_min=True, exclude_max=True),
    "camera.width": positive,
    "camera.focal": st.lists(st.floats(1e-6, 1e300), min_size=2, max_size=2),
    "camera.principal": st.lists(finite, min_size=2, max_size=2),
    "camera.transforms": paths,
    "camera.frame": st.one_of(st.integers(0, 10**9), st.just("all")),
    "camera.resolution": st.lists(pixels, min_size=2, max_size=2),
    "camera.samples": st.integers(1, 4096),
    "quadrature.rule": st.sampled_from(["exact", "midpoint"]),
    "quadrature.step": positive,
    "quadrature.max_error": st.one_of(st.just(0.0), st.floats(1e-6, 1, exclude_max=True)),
    "quadrature.target_error": st.one_of(st.just(0.0), st.floats(1e-6, 1, exclude_max=True)),
    "background.color": colours,
    "background.image": paths,
    "output.image": paths,
    # not those of errors, which come with some rules alone
    "output.maps": st.lists(
        st.sampled_from(sorted({*MAPS} - {"error_bound", "error_estimate"})), max_size=4
    ),
    "output.bits": st.sampled_from([8, 16]),
}

POSE = ("type", "eye", "target", "up", "fov", "width", "focal", "principal")

NEEDS = {
    "camera.width": ("camera.type", "orthographic"),
    "camera.fov": ("camera.type", "perspective"),
    "camera.focal": ("camera.type", "perspective"),
    "quadrature.step": ("quadrature.rule", "midpoint"),
    "quadrature.max_error": ("quadrature.rule", "exact"),
    "quadrature.target_error": ("quadrature.rule", "exact"),
}
EXCLUDES = [
    *combinations(["color.constant", "color.grid", "color.ramp", "color.blackbody"], 2),
    *combinations(["emission.grid", "emission.ramp", "emission.blackbody"], 2),
    ("emission.ramp", "emission.constant"),
    ("emission.blackbody", "emission.constant"),
    *combinations(["quadrature.step", "quadrature.max_error", "quadrature.target_error"], 2),
    ("background.color", "background.image"),
    *combinations(["camera.fov", "camera.focal", "camera.width"], 2),
    ("camera.principal", "camera.fov"),
    ("camera.principal", "camera.width"),
    *(("camera.transforms", f"camera.{name}") for name in POSE),
    ("camera.frame", "camera.eye"),
]
COMPANIONS = [
    ("emission.constant", "emission.grid"),
    ("camera.focal", "camera.eye"),
    ("camera.focal", "camera.target"),
    ("camera.principal", "camera.focal"),
    ("camera.frame", "camera.transforms"),
]


@st.composite
def settings_of_a_job(draw):
    """Some fields with values that go together."""
    chosen = draw(st.sets(st.sampled_from(sorted(FIELDS))))
    for one, other in EXCLUDES:
        if {one, other} <= chosen:
            chosen.remove(draw(st.sampled_from([one, other])))
    for key, other in COMPANIONS:
        if other not in chosen:
            chosen.discard(key)
    settings = {key: draw(FIELDS[key]) for key in sorted(chosen)}
    for key, (other, value) in NEEDS.items():
        if key in settings:
            settings[other] = value
    return settings


def plain(job, key):
    part, name = key.split(".")
    value = job.model_dump(mode="json")[part][name]
    if isinstance(value, dict):
        return {n: v for n, v in value.items() if v is not None}
    return value


def test_every_field_is_tried():
    known = {
        f"{part}.{n}" for part, i in Job.model_fields.items() for n in i.annotation.model_fields
    }
    assert set(FIELDS) == known


@given(settings_of_a_job())
def test_a_job_written_as_toml_reads_back_as_the_same_job(settings):
    job = make_job({}, list(settings.items()))
    for key, value in settings.items():
        assert plain(job, key) == value
    assert make_job(tomllib.loads(job_as_toml(job))) == job


@given(settings_of_a_job(), settings_of_a_job())
def test_a_setting_wins_over_the_file_and_the_file_over_the_default(written, settings):
    file = {}
    for key, value in written.items():
        part, name = key.split(".")
        file.setdefault(part, {})[name] = value
    for key, (other, value) in NEEDS.items():  # what the settings leave without its companion
        needed = any(k in settings and needs[0] == other for k, needs in NEEDS.items())
        if key in written and settings.get(other, value) != value and not needed:
            settings.pop(other)
    if "camera.transforms" in written and "camera.eye" not in settings:  # an eye replaces them
        settings = {k: v for k, v in settings.items() if k not in {f"camera.{n}" for n in POSE}}
    job = make_job(file, list(settings.items()))
    dropped = {b for a, b in EXCLUDES if a in settings} | {a for a, b in EXCLUDES if b in settings}
    if "emission.constant" in settings:
        dropped.discard("emission.constant")
    for key in FIELDS:
        if key in settings:
            assert plain(job, key) == settings[key]
        elif key in written and key not in dropped:
            assert plain(job, key) == written[key]
        else:
            assert plain(job, key) == plain(Job(), key)


@given(st.data())
def test_a_setting_is_written_as_in_a_job_file(data):
    tables = {
        "density.ramp",
        "color.ramp",
        "color.blackbody",
        "emission.ramp",
        "emission.blackbody",
    }
    key = data.draw(st.sampled_from(sorted(FIELDS.keys() - tables)))
    value = data.draw(FIELDS[key])
    text = tomli_w.dumps({"v": value}, multiline_strings=False).removeprefix("v = ").strip()
    assert parse_setting(f"{key}={text}") == (key, value)
    assert parse_setting(f" {key} = {text}") == (key, value)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("density.grid=smoke", ("density.grid", "smoke")),
        ("density.grid='3'", ("density.grid", "3")),
        ("density.scale=2", ("density.scale", 2)),
        ("density.file=a=b.vdb", ("density.file", "a=b.vdb")),
        ("camera.eye=", ("camera.eye", None)),
    ],
)
def test_a_setting_that_is_no_toml_is_text(text, expected):
    assert parse_setting(text) == expected


@pytest.mark.parametrize("text", ["", "=", "scale=2", "density.=", "a.b.c=1", ".x=1", "a.b"])
def test_a_setting_without_a_field_is_refused(text):
    with pytest.raises(UsageError):
        make_job({}, [parse_setting(text)])


@given(st.text(max_size=30))
def test_any_text_is_a_setting_or_a_usage_error_of_one_line(text):
    try:
        make_job({}, [parse_setting(text)])
    except UsageError as error:
        assert str(error)


@given(st.sampled_from(sorted(FIELDS)), st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=5),
    st.lists(st.one_of(st.integers(), st.text(max_size=3), st.floats()), max_size=4),
    st.dictionaries(st.text(max_size=3), st.integers(), max_size=2),
))  # fmt: skip
def test_a_value_of_any_type_is_taken_or_refused_by_the_name_of_its_field(key, value):
    part, name = key.split(".")
    try:
        make_job({part: {name: value}}, source="a.toml")
    except UsageError as error:
        text = str(error)
        if "nothing to see" in text or "exclude each other" in text:
            return
        assert re.match(rf"a\.toml: (unknown key ')?{re.escape(key)}(: | is for |[.'])", text)
        said = ("must be", "must not be", "is for", "is missing", "unknown key", "must hold")
        assert any(words in text for words in said)


def test_a_volume_is_its_own_job(tmp_path):
    job = load_job(tmp_path / "smoke.vdb")
    assert job == make_job({"density": {"file": tmp_path / "smoke.vdb"}})


def test_the_command_line_wins_in_the_order_setting_flag_file(tmp_path):
    path = tmp_path / "job.toml"
    path.write_text("[density]\nfile = 'a.vdb'\nscale = 1.5\n")
    assert load_job(path).density.scale == 1.5
    assert load_job(path, [("density.scale", 2.5)]).density.scale == 2.5
    assert load_job(path, [("density.scale", 2.5)], ["density.scale=3.5"]).density.scale == 3.5


def test_a_field_that_is_unknown_has_no_help():
    with pytest.raises(KeyError):
        field("density.colour")


@pytest.mark.parametrize("value", [True, "2"])
@pytest.mark.parametrize("key", ["density.scale", "camera.fov"])
def test_a_number_is_written_as_one(key, value):
    with pytest.raises(UsageError, match=f"^a.toml: {key}: must be a number, not "):
        part, name = key.split(".")
        make_job({part: {name: value}}, source="a.toml")


STOPS = [[0, 0, 0, 0], [1, 1, 1, 1]]


@pytest.mark.parametrize(
    ("file", "settings", "expected"),
    [
        ({"grid": "Cd"}, [("color.ramp.map", "jet")], {"ramp": {"map": "jet"}}),
        ({"grid": "Cd"}, [("color.blackbody.grid", "T")], {"blackbody": {"grid": "T"}}),
        ({"ramp": {"map": "jet"}}, [("color.grid", "Cd")], {"grid": "Cd"}),
        ({"ramp": {"map": "jet"}}, [("color.constant", [1, 0, 0])], {"constant": (1, 0, 0)}),
        (
            {"ramp": {"grid": "T", "map": "jet", "range": [0, 1]}},
            [("color.ramp.stops", STOPS)],
            {"ramp": {"grid": "T", "stops": STOPS}},
        ),
        (
            {"ramp": {"grid": "T", "stops": STOPS}},
            [("color.ramp.range", [0, 2])],
            {"ramp": {"grid": "T", "range": [0, 2]}},
        ),
        (
            {"ramp": {"grid": "T", "map": "jet"}},
            [("color.ramp.map", None)],
            {"ramp": {"grid": "T"}},
        ),
        ({"ramp": {"map": "jet"}, "strength": 2}, [("color.ramp", None)], {"strength": 2}),
    ],
)
def test_a_setting_inside_a_table_drops_what_the_table_excludes(file, settings, expected):
    before = repr(file)
    job = make_job({"color": file}, settings)
    assert job == make_job({"color": expected})
    assert repr(file) == before, "what was given is left alone"


@pytest.mark.parametrize("key", ["color.ramp.map", "density.ramp.stops", "color.blackbody.scale"])
def test_a_field_inside_a_table_has_help(key):
    assert field(key)[0].endswith(".")


def test_every_field_is_described_those_of_tables_too():
    for key in keys():
        if "." in key:
            assert field(key)[0].endswith("."), key
