"""docs/farms.md: commands that there are, scripts and files that are sound."""

import re
import shlex
import subprocess
import sys
import tomllib

import pytest
from commandline import ROOT, volcli

from volcli.config import make_job

TEXT = (ROOT / "docs" / "farms.md").read_text(encoding="utf-8")


def blocks(language):
    return re.findall(rf"^```{language}\n(.*?)^```", TEXT, re.MULTILINE | re.DOTALL)


def commands(program):
    """The commands of a program, as lists of words: in scripts, in lines of tables, in YAML."""
    lines = [line for block in blocks("sh") for line in block.replace("\\\n", " ").splitlines()]
    lines += re.findall(r"\| `([^`]+)`", TEXT)
    lines += [line.strip().removeprefix("- ") for line in TEXT.splitlines() if "- volcli" in line]
    found = [shlex.split(line, comments=True) for line in lines if f"{program} " in line]
    found += [
        [word.strip(' "') for word in re.sub(r"\s+", " ", text).split(",")]
        for text in re.findall(r"args: \[([^\]]+)\]", TEXT)
    ]
    found = [words[words.index(program) :] for words in found if program in words]
    return [[word for word in words if word != "&"] for words in found]


def flags(words):
    return {word for word in words if word.startswith("--")}


@pytest.mark.parametrize("words", commands("volcli"), ids=" ".join)
def test_each_option_of_volcli_is_one_that_there_is(words):
    helped = volcli(words[1], "--help").out
    assert flags(words) <= set(re.findall(r"--[a-z-]+", helped))


def test_there_are_commands_for_each_way():
    assert len(commands("volcli")) >= 9
    assert len(commands("dask")) >= 5


@pytest.mark.parametrize("kind", ["scheduler", "worker"])
def test_each_option_of_dask_is_one_that_there_is(kind):
    pytest.importorskip("distributed", reason="the extra 'farm' is not installed")
    command = [sys.executable, "-m", f"distributed.cli.dask_{kind}", "--help"]
    helped = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    known = set(re.findall(r"--[a-z-]+", helped))
    used = [flags(words) for words in commands("dask") if words[1] == kind]
    assert len(used) >= 2
    for options in used:
        assert options <= known


@pytest.mark.parametrize("script", [b for b in blocks("sh") if b.startswith("#!")])
def test_each_script_is_sound(script, tmp_path):
    path = tmp_path / "script.sh"
    path.write_text(script)
    assert subprocess.run(["bash", "-n", str(path)], capture_output=True).stderr == b""


def test_the_job_is_a_job():
    (text,) = blocks("toml")
    assert make_job(tomllib.loads(text)).output.image.name == "smoke.####.exr"


@pytest.mark.parametrize("text", blocks("yaml"))
def test_each_manifest_of_kubernetes_is_sound(text):
    yaml = pytest.importorskip("yaml", reason="PyYAML comes with the extra 'farm'")
    for document in yaml.safe_load_all(text):
        assert {"apiVersion", "kind", "metadata", "spec"} == set(document)
        template = document["spec"].get("template")
        if template is None:
            continue
        pod = template["spec"]
        mounted = {m["name"] for c in pod["containers"] for m in c.get("volumeMounts", [])}
        assert mounted == {volume["name"] for volume in pod.get("volumes", [])}
