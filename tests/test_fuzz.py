"""Damaged files, and that the harness that makes them would find what it is there to find."""

import pytest

from fuzz.mutate import case, seeds
from fuzz.runner import fuzz

pytestmark = pytest.mark.needs_jit


def test_damaged_files_end_with_an_image_or_an_error_in_little_time_and_memory():
    tally = fuzz(range(150))
    assert tally.findings == []
    assert tally.cases == 150
    assert len(tally.codes) > 2, "some are read, some are refused"


@pytest.mark.parametrize(
    ("check", "found"),
    [
        ("need", "please report it"),
        ("crash", "the process ended: SIGABRT"),
        ("endless", "no answer in"),
        ("memory", "does not fit into memory"),
    ],
)
def test_without_one_check_of_the_reader_the_harness_finds_something(check, found):
    seconds = 2.0 if check == "endless" else 10.0
    tally = fuzz(range(400), kinds="vdb", plant=check, seconds=seconds, enough=1)
    assert tally.findings
    assert found in tally.findings[0].what


def test_a_case_is_the_same_file_each_time_and_there_are_seeds_of_each_kind():
    assert case(7).raw == case(7).raw != case(8).raw
    assert {seed.kind for seed in seeds()} == {
        "vdb",
        "npy",
        "npz",
        "exr",
        "png",
        "job",
        "batch",
        "json",
    }
