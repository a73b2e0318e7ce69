"""Times each of `parts`: ``python -m pytest benchmarks/test_parts.py``, with pytest-benchmark."""

import pytest

from benchmarks.parts import parts


@pytest.fixture(scope="module")
def ready(tmp_path_factory):
    return parts(tmp_path_factory.mktemp("parts"))


@pytest.mark.parametrize("name", ["read", "build", "traversal", "cell integral", "encode EXR"])
def test_part(benchmark, ready, name):
    ready[name]()  # compiles
    benchmark(ready[name])
