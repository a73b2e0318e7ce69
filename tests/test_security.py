"""What SECURITY.md says of the code: it reads no pickle, evaluates nothing, starts no shell, opens
no network; and each dependency has a lower bound.
"""

import ast
import re
import subprocess
import sys
import tomllib

import pytest
from commandline import ROOT, SAMPLES, write_ball

CODE = sorted((ROOT / "volcli").rglob("*.py"))
UNSAFE = {"pickle", "cPickle", "cloudpickle", "dill", "marshal", "shelve", "code", "runpy"}
NETWORK = {"urllib", "http", "ftplib", "smtplib", "requests", "httpx", "socketserver", "xmlrpc"}
CALLS = {"eval", "exec", "compile", "os.system", "os.popen", "__import__", "np.fromregex"}


def nodes_of(path):
    return list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))


@pytest.mark.parametrize("path", CODE, ids=lambda path: path.stem)
def test_the_code_runs_nothing_that_a_file_says(path):
    for node in nodes_of(path):
        names = set()
        if isinstance(node, ast.Import):
            names = {alias.name.split(".")[0] for alias in node.names}
        if isinstance(node, ast.ImportFrom):
            names = {(node.module or "").split(".")[0]}
        assert not names & (UNSAFE | NETWORK), f"{path}:{node.lineno}"
        if isinstance(node, ast.Call):
            assert ast.unparse(node.func) not in CALLS, f"{path}:{node.lineno}"
            given = {keyword.arg: ast.unparse(keyword.value) for keyword in node.keywords}
            assert given.get("shell", "False") == "False", f"{path}:{node.lineno}"
            assert given.get("allow_pickle", "False") == "False", f"{path}:{node.lineno}"


def test_sockets_are_asked_for_the_name_of_the_machine_alone():
    for path in CODE:
        for node in nodes_of(path):
            if isinstance(node, ast.Attribute) and ast.unparse(node.value) == "socket":
                assert node.attr == "gethostname", f"{path}:{node.lineno}"


WATCHED = """
import sys
from volcli.cli import main
watched = ("socket.connect", "socket.bind", "socket.getaddrinfo", "subprocess.Popen", "os.system",
           "os.exec", "os.posix_spawn", "os.fork")
def watch(event, arguments):
    if event in watched:
        print("FOUND", event, arguments)
sys.addaudithook(watch)
main(sys.argv[1:])
"""


@pytest.mark.parametrize(
    "command", ["render {cloud} -o {out} --size 16x12", "info {cloud} --stats", "inspect {picture}"]
)
def test_no_network_and_no_other_program_is_used_unless_asked_for(command, tmp_path):
    places = {"cloud": SAMPLES / "cloud.vdb", "out": tmp_path / "a.exr"}
    if "{picture}" in command:
        places["picture"] = tmp_path / "b.exr"
        made = f"render {{ball}} -o {places['picture']} --size 16x12"
        run(made.format(ball=write_ball(tmp_path / "ball.npz")))
    assert "FOUND" not in run(command.format(**places))


def run(command):
    ran = subprocess.run(
        [sys.executable, "-c", WATCHED, *command.split()], capture_output=True, text=True
    )
    assert ran.returncode == 0, ran.stderr
    return ran.stdout


def test_each_dependency_has_a_lower_bound():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"].values()
    every = [*project["dependencies"], *(wanted for extra in extras for wanted in extra)]
    assert len(every) > 15
    for wanted in every:
        assert wanted.startswith("volcli[") or re.fullmatch(r"[\w.-]+(\[\w+\])?>=[\d.]+", wanted)
