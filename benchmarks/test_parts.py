"""Times each of `parts`: ``python -m pytest benchmarks/test_parts.py``, with pytest-benchmark."""

import pytest

from benchmarks.parts import parts


@pytest.fixture(scope="module")
def ready(tmp_path_factory):
    return parts(tmp_path_factory.mktemp("parts"))


NAMES = ("read", "build", "traversal", "cell integral", "encode EXR")
LOOPS = ("rays in packets", "rays one by one")


@pytest.mark.parametrize("name", (*NAMES, *LOOPS))
def test_part(benchmark, ready, name):
    ready[name]()  # compiles
    benchmark(ready[name])
