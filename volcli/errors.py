"""The exceptions of volcli and the exit code that each one ends the process with.

    VolcliError          1   unexpected, or a comparison that failed
    ├── UsageError       2   the command line or a job file asks for something impossible
    ├── VolumeError      3   a volume file is missing, damaged or not what was asked for
    ├── OutputError      4   a result could not be written
    ├── NonFiniteError   5   the result holds NaN or Inf
    └── BatchError       6   some jobs of a batch failed

A message is one line: what, where, what to do. The library raises; only ``volcli.cli`` prints and
exits. This module imports nothing.
"""


class VolcliError(Exception):
    """Base of every error that volcli raises on purpose."""

    exit_code = 1


class UsageError(VolcliError):
    """The command line or a job file asks for something impossible."""

    exit_code = 2


class VolumeError(VolcliError):
    """A volume file is missing, damaged, or does not hold what was asked for."""

    exit_code = 3


class OutputError(VolcliError):
    """A result could not be written."""

    exit_code = 4


class NonFiniteError(VolcliError):
    """The result holds NaN or Inf; ``pixel`` is the first (x, y) that does, where it is known."""

    exit_code = 5
    pixel: "tuple[int, int] | None" = None


class BatchError(VolcliError):
    """Some jobs of a batch failed."""

    exit_code = 6
