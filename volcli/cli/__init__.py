"""The command line: one file a command; each parses, calls one function and prints.

This is the only place that prints and exits. Results go to stdout; progress, notes and errors to
stderr. Here is the entry point alone, so that even an interrupt while modules load ends in order.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and exit; the entry point of the installed script."""
    try:
        from volcli.cli.app import run_app

        code = run_app(sys.argv[1:] if arguments is None else arguments)
    except KeyboardInterrupt:
        print("volcli: interrupted", file=sys.stderr)
        code = 130
    sys.exit(code)
