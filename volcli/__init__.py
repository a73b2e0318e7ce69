"""volcli: render OpenVDB and other grid volumes to images, with opacity right to rounding."""

from typing import Any


def __getattr__(name: str) -> Any:
    if name == "__version__":  # looked up when it is asked for: importlib.metadata is slow to load
        from importlib.metadata import version

        globals()[name] = version("volcli")  # the next look-up does not come here
        return globals()[name]
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
