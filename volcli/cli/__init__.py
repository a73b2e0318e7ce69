"""The command line: one file a command; each parses, calls one function and prints.

This is the only place that prints and exits. Results go to stdout; progress, notes and errors to
stderr.
"""

from __future__ import annotations

import sys

import typer

from volcli import __version__
from volcli.cli import info, render
from volcli.errors import VolcliError

app = typer.Typer(
    name="volcli",
    help="Render OpenVDB and other grid volumes to images, with opacity right to rounding.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
app.command(name="render")(render.render)
app.command(name="info")(info.info)


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"volcli {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: bool = typer.Option(
        False,
        "--version",
        callback=_show_version,
        is_eager=True,
        help="Print the version and exit.",
    ),
) -> None:
    pass


def main() -> None:
    """Run the command line; the entry point of the installed script."""
    try:
        app()
    except VolcliError as error:
        print(f"volcli: {error}", file=sys.stderr)
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        print("volcli: interrupted", file=sys.stderr)
        sys.exit(130)
