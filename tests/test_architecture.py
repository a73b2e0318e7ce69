"""The shape of the code: who may import whom, what is heavy, where defaults live."""

import ast
import inspect
import subprocess
import sys
import typing
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "volcli"
FILES = sorted(PACKAGE.rglob("*.py"))

LAYERS = [
    {"errors", "fields", "srgb", "blackbody"},
    {"memory", "leftovers", "texts"},
    {"sources", "grids", "quadrature", "files"},
    {"schema"},
    {"plan", "camera", "transforms", "kernels", "tables", "columns"},
    {"bounds"},
    {"render"},
    {"trace"},
    {"config", "images", "warmup", "scene"},
    {"opacity", "estimate", "reproduce", "outputs", "calibrate"},
    {"run", "describe"},
    {"probe", "tradeoff"},
    {"batch"},
    {"cli"},
]
"""From the bottom to the top. A module may import those below it."""

HEAVY = {"numba", "OpenImageIO", "matplotlib", "dask", "distributed", "tqdm", "blosc", "rich"}
OWNERS = {
    "volcli.grids.vdb_codec": {"blosc"},
    "volcli.kernels": {"numba"},
}
"""Who may import what is heavy as it loads: modules that are themselves loaded only on use."""

LONG: dict[str, str] = {}
"""Files that may be longer, and why."""
LONGEST = 450
"""Lines of a file."""


def name_of(path):
    parts = ("volcli", *path.relative_to(PACKAGE).with_suffix("").parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def unit_of(module):
    """The part of the package that a module belongs to: its name below ``volcli``."""
    return [*module.split("."), ""][1]


def imports_of(path, *, only_on_load=False):
    """Full names of the modules that a file imports; ``only_on_load``: as it is loaded."""
    found = set()

    def visit(node, on_load):
        for child in ast.iter_child_nodes(node):
            inner = on_load
            if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
                inner = False
            if isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test):
                continue
            if on_load or not only_on_load:
                if isinstance(child, ast.Import):
                    found.update(alias.name for alias in child.names)
                if isinstance(child, ast.ImportFrom):
                    assert child.level == 0, f"{path}: relative imports hide where they lead"
                    found.add(child.module)
                    if child.module == "volcli" or (child.module or "").startswith("volcli."):
                        found.update(f"{child.module}.{alias.name}" for alias in child.names)
            visit(child, inner)

    visit(ast.parse(path.read_text(encoding="utf-8")), True)
    return found


def rank(unit):
    return next(i for i, layer in enumerate(LAYERS) if unit in layer)


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_imports_point_one_way(path):
    here = unit_of(name_of(path))
    if not here:  # the package itself
        assert not {m for m in imports_of(path) if m.startswith("volcli.")}
        return
    for module in imports_of(path):
        there = unit_of(module) if module.startswith("volcli.") else ""
        known = any(there in layer for layer in LAYERS)
        if not known or there == here:
            continue
        assert rank(there) < rank(here), f"{name_of(path)} imports {module}"


def test_every_module_has_its_layer():
    units = {unit_of(name_of(path)) for path in FILES} - {""}
    assert units <= set().union(*LAYERS)


def test_grids_know_of_nothing_but_errors_memory_and_leftovers():
    for path in FILES:
        if unit_of(name_of(path)) == "grids":
            units = {unit_of(m) for m in imports_of(path) if m.startswith("volcli.")}
            assert units <= {"grids", "errors", "memory", "leftovers"}, path


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_what_is_heavy_is_imported_where_it_is_used(path):
    loaded = {m.split(".")[0] for m in imports_of(path, only_on_load=True)}
    mine = set().union(
        *(heavy for owner, heavy in OWNERS.items() if name_of(path).startswith(owner))
    )
    assert not (loaded & HEAVY) - mine


def test_only_images_knows_of_openimageio():
    for path in FILES:
        if unit_of(name_of(path)) != "images":
            assert not any(m.startswith("OpenImageIO") for m in imports_of(path)), path


def test_kernels_and_their_oracle_do_not_know_each_other():
    for path in FILES:
        units = {unit_of(m) for m in imports_of(path) if m.startswith("volcli.")}
        if unit_of(name_of(path)) == "kernels":
            assert "quadrature" not in units
        if unit_of(name_of(path)) == "quadrature":
            assert "kernels" not in units


@pytest.mark.parametrize(
    ("arguments", "slow"),
    [
        (["--help"], HEAVY | {"numpy", "tomli_w", "pydantic"}),
        (["render", "--help"], HEAVY | {"numpy", "tomli_w"}),
        (["info", "--help"], HEAVY | {"numpy", "tomli_w"}),
        (["inspect", "--help"], HEAVY | {"numpy", "tomli_w"}),
        (["probe", "--help"], HEAVY | {"numpy", "tomli_w"}),
        (["compare", "--help"], HEAVY | {"numpy", "tomli_w"}),
        (["batch", "--help"], HEAVY | {"numpy", "tomli_w"}),
    ],
)
def test_help_loads_nothing_that_is_slow(arguments, slow):
    code = (
        "import sys, volcli.cli\n"
        f"try: volcli.cli.main({arguments!r})\n"
        "except SystemExit: pass\n"
        f"print(sorted({slow!r} & set(sys.modules)))"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert ended.stdout.splitlines()[-1] == "[]", ended.stderr


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_a_file_is_short_enough_to_be_read(path):
    lines = len(path.read_text(encoding="utf-8").splitlines())
    assert lines <= LONGEST or path.name in LONG, f"{lines} lines"


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_a_module_opens_with_what_lives_in_it(path):
    tree = ast.parse(path.read_text(encoding="utf-8"))
    assert not tree.body or ast.get_docstring(tree)


def test_only_the_command_line_prints_and_exits():
    for path in FILES:
        if unit_of(name_of(path)) == "cli" or path.name == "_openvdb_worker.py":
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call):
                called = ast.unparse(node.func)
                assert called not in ("print", "sys.exit", "exit"), f"{path}:{node.lineno}"


def render_options():
    """Parameter -> (default, typer's option) of `volcli render`."""
    from volcli.cli.render import render

    return options_of(render)


def options_of(command):
    """Parameter -> (default, typer's option) of a command."""
    hints = typing.get_type_hints(command, include_extras=True)
    return {
        name: (parameter.default, typing.get_args(hints[name])[1])
        for name, parameter in inspect.signature(command).parameters.items()
        if hasattr(hints[name], "__metadata__")
    }


def test_the_options_of_probe_that_set_a_field_are_those_of_render():
    from volcli.cli.probe import probe

    here, rendered = options_of(probe), render_options()
    shared = set(here) & set(rendered) - {"source", "step", "as_json", "overwrite"}
    assert len(shared) > 10
    for name in shared:
        assert here[name][0] == rendered[name][0]
        assert here[name][1].help == rendered[name][1].help
        assert here[name][1].param_decls == rendered[name][1].param_decls


def test_an_option_that_sets_a_field_has_the_help_of_the_schema_and_no_default_of_its_own():
    from volcli.schema import field

    fields = {
        "output": "output.image",
        "grid": "density.grid",
        "density_scale": "density.scale",
        "color": "color.constant",
        "color_grid": "color.grid",
        "eye": "camera.eye",
        "target": "camera.target",
        "up": "camera.up",
        "fov": "camera.fov",
        "ortho": "camera.width",
        "image_size": "camera.resolution",
        "step": "quadrature.step",
        "max_error": "quadrature.max_error",
        "target_error": "quadrature.target_error",
        "interpolation": "density.interpolation",
        "maps": "output.maps",
        "bits": "output.bits",
        "reader": "density.reader",
    }
    of_the_command = {
        "source",
        "background",
        "settings",
        "threads",
        "cache",
        "max_memory",
        "frames",
        "overwrite",
        "explain",
        "as_json",
        "quiet",
    }
    options = render_options()
    assert set(options) == set(fields) | of_the_command
    for name, key in fields.items():
        default, shown = options[name]
        assert default is None
        assert shown.help.startswith(field(key)[0])
        assert shown.help.endswith("]") == (field(key)[1] not in (None, ()))


def test_every_field_of_a_job_is_described():
    from volcli.schema import Job, field

    for part, info in Job.model_fields.items():
        for name in info.annotation.model_fields:
            assert field(f"{part}.{name}")[0].endswith("."), f"{part}.{name}"
