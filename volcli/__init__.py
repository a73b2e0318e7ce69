"""volcli: render OpenVDB and other grid volumes to images, with opacity right to rounding."""

from importlib.metadata import version as _version

__version__ = _version("volcli")
