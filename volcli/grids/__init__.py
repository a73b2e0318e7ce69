"""Volume files in, `BrickGrid`s out: opening a file by its kind, and choosing and reading a grid.

open_volume(path)          a `Volume`: headers are read, voxels are not
density_grid, source_grid  which grid a job means
load_density, load_source  that grid as bricks, fit to be rendered
"""

from volcli.grids.brick import BrickGrid
from volcli.grids.choosing import density_grid, source_grid
from volcli.grids.loading import Cache, density_of_source, empty_grid, load_density, load_source
from volcli.grids.opening import open_volume
from volcli.grids.tree import GridHeader, Progress, Tree, Volume

__all__ = [
    "BrickGrid",
    "Cache",
    "GridHeader",
    "Progress",
    "Tree",
    "Volume",
    "density_grid",
    "density_of_source",
    "empty_grid",
    "load_density",
    "load_source",
    "open_volume",
    "source_grid",
]
