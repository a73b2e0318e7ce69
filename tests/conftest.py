"""Settings of the whole suite."""

import numba
import pytest
from hypothesis import settings

# Reproducible, and nothing is written into the checkout; a busy machine makes no failures.
settings.register_profile("volcli", database=None, deadline=None, derandomize=True)
settings.load_profile("volcli")


def pytest_configure(config):
    config.addinivalue_line(
        "markers", "needs_jit: too large for kernels run as Python (NUMBA_DISABLE_JIT=1)"
    )


def pytest_collection_modifyitems(items):
    if not numba.config.DISABLE_JIT:
        return
    skip = pytest.mark.skip(reason="too large for kernels that are not compiled")
    # Compiled kernels divide by 0 in silence (a ray along an axis has 1/d = inf), and go beyond all
    # numbers where a scale does; NumPy would warn.
    quiet = pytest.mark.filterwarnings(
        "ignore:(divide by zero|overflow encountered):RuntimeWarning"
    )
    for item in items:
        item.add_marker(quiet)
        if item.get_closest_marker("needs_jit"):
            item.add_marker(skip)
