"""Every example of the README runs and does what the text says."""

import contextlib
import io
import json
import re
import shlex
import shutil
import tomllib

import pytest
from commandline import ROOT, volcli, write_ball

from volcli.config import make_job
from volcli.schema import Job

README = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(language):
    return re.findall(rf"^```{language}\n(.*?)^```", README, re.MULTILINE | re.DOTALL)


def commands():
    """The volcli commands of the shell blocks, lines that end in a backslash joined."""
    lines = [line for block in blocks("sh") for line in block.replace("\\\n", " ").splitlines()]
    return [line for line in lines if line.startswith("volcli ")]


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    """A folder with the samples and configs of the checkout, to stand in."""
    for folder in ("samples", "configs"):
        (tmp_path / folder).symlink_to(ROOT / folder)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_readme_has_examples():
    assert len(commands()) >= 7


@pytest.mark.needs_jit
@pytest.mark.parametrize("command", commands())
def test_each_command_of_the_readme_does_what_the_text_beside_it_says(command, checkout):
    words = shlex.split(command)[1:]
    if words[0] == "batch":
        _run_in_small(words, checkout)
        return
    if "--frames" in words:
        (checkout / "sim").mkdir()
        for frame in (1, 2, 3):
            write_ball(checkout / words[1].replace("####", f"{frame:04d}"))
    if words[0] in ("render", "tradeoff"):  # small: what is tested is that it runs, not the picture
        words += ["--size", "64x48"]
    else:  # pictures that an earlier example made
        for name in (word for word in words[1:] if word.endswith(".exr")):
            volcli("render", "samples/cloud.vdb", "-o", name, "--size", "64x48")
    ran = volcli(*words)
    assert ran.code == 0, ran.err
    if "-o" in words:
        written = checkout / words[words.index("-o") + 1]
        if "--frames" in words:
            written = checkout / words[words.index("-o") + 1].replace("####", "0003")
        if "camera.frame=all" in words:
            written = written.with_name(f"{written.stem}.0002{written.suffix}")
        assert written.stat().st_size > 0
    for flag in ("--heatmap", "--html", "--plot", "--csv", "--difference"):
        if flag in words:
            assert (checkout / words[words.index(flag) + 1]).stat().st_size > 0
    if "--maps" in words:
        for name in words[words.index("--maps") + 1].split(","):
            assert written.with_suffix(f".{name}.png").stat().st_size > 0
    if "--json" in words:
        assert json.loads(ran.out)
    elif "--explain" in words:
        assert ran.out.startswith("term")
    else:
        assert ran.out
    if "--eye" not in words and words[1].endswith(".vdb") and words[0] == "render":
        assert "camera chosen: --eye" in ran.err


def _run_in_small(words, checkout):
    """A batch of the README, in a folder where none was before, or one was interrupted."""
    (checkout / "configs").unlink()
    shutil.copytree(ROOT / "configs", checkout / "configs")  # outputs lie beside it
    small = ("--set", "camera.resolution=[24,18]")
    ran = volcli(*words, *small)
    assert ran.code == 0, ran.err
    assert ran.out
    if "--contact-sheet" in words:
        assert (checkout / words[words.index("--contact-sheet") + 1]).stat().st_size > 0
    pictures = list((checkout / "out").rglob("*.exr"))
    assert bool(pictures) == ("--dry-run" not in words)


def test_the_job_file_of_the_readme_is_a_job_that_names_every_part():
    (text,) = blocks("toml")
    tables = tomllib.loads(text)
    job = make_job(tables, source="README.md")
    assert set(tables) == set(Job.model_fields)
    assert job.density.scale == 16.0


def test_the_python_of_the_readme_prints_what_its_comment_says():
    (code,) = blocks("python")
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(code, "README.md", "exec"), {})
    assert printed.getvalue().strip() == code.rsplit("# ", 1)[1].strip()


@pytest.mark.parametrize("picture", re.findall(r"\]\((docs/[^)]+\.png)\)", README))
def test_each_picture_of_the_readme_is_there(picture):
    assert (ROOT / picture).read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("picture", sorted((ROOT / "docs").rglob("*.png")), ids=lambda p: p.name)
def test_no_picture_of_the_docs_carries_the_job_and_its_paths(picture):
    assert b"volcli:job" not in picture.read_bytes()


def test_each_make_target_of_the_readme_exists():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    named = set(re.findall(r"`?make (\w+)", README)) - {"a", "it"}
    assert named
    for target in named:
        assert re.search(rf"^{target}:", makefile, re.MULTILINE), target
