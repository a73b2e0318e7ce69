"""volcli: render OpenVDB and other grid volumes to images, with opacity right to rounding."""

from typing import Any


def __getattr__(name: str) -> Any:
    if name == "__version__":  # looked up when it is asked for: importlib.metadata is slow to load
        from importlib.metadata import version

        return version("volcli")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
