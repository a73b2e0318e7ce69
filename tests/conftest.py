"""Settings of the whole suite."""

import os

import pytest
from hypothesis import settings

# Reproducible, and nothing is written into the checkout; a busy machine makes no failures.
settings.register_profile("volcli", database=None, deadline=None, derandomize=True)
settings.load_profile("volcli")

JIT = os.environ.get("NUMBA_DISABLE_JIT", "0") in ("", "0")


def pytest_configure(config):
    config.addinivalue_line(
        "markers", "needs_jit: too large for kernels run as Python (NUMBA_DISABLE_JIT=1)"
    )


def pytest_collection_modifyitems(items):
    if JIT:
        return
    skip = pytest.mark.skip(reason="too large for kernels that are not compiled")
    for item in items:
        if item.get_closest_marker("needs_jit"):
            item.add_marker(skip)
