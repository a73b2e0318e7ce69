"""The commands as one application, and what becomes of an error: one line and an exit code."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Any

import typer

from volcli.cli.table import in_short
from volcli.errors import VolcliError

_ParserError: Any = typer.BadParameter.__mro__[2]
"""What the parser of the command line raises; typer has it under no name of its own."""

_LONGEST = 1000
"""Letters of an error, which may quote what a file holds."""

COMMANDS = {
    "render": "Render a picture of a volume.",
    "batch": "Render many pictures: sequences, sweeps, turntables.",
    "info": "List the grids of a volume.",
    "inspect": "Look at the opacity of images.",
    "probe": "Follow rays through a scene.",
    "tradeoff": "Measure speed against accuracy on a picture of one's own.",
    "compare": "Compare two images, channel by channel.",
    "recomposite": "Put another background behind a rendered picture.",
}
"""The commands, each a function of its name in the module of its name, and their summaries."""


def build_app(wanted: str | None) -> typer.Typer:
    """The application with the one command that is wanted; the others are known by name alone.

    So `volcli --help` need not load the schema that the options of a command come from.
    """
    app = typer.Typer(
        name="volcli",
        help="Render OpenVDB and other grid volumes to images, with opacity right to rounding.",
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,  # importing rich takes longer than all the rest of --help
    )
    app.callback()(_root)
    for name, summary in COMMANDS.items():
        if name == wanted:
            app.command(name)(getattr(import_module(f"volcli.cli.{name}"), name))
        else:
            app.command(name, help=summary)(_not_loaded)
    return app


def _not_loaded() -> None:
    raise AssertionError("the command that is called is loaded")


def _show_version(wanted: bool) -> None:
    if wanted:
        from volcli import __version__

        typer.echo(f"volcli {__version__}")
        raise typer.Exit


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


def run_app(arguments: Sequence[str]) -> int:
    """Run one command; returns the exit code. Errors that are foreseen print one line to stderr,
    and only a defect of volcli itself a traceback.

    Raises
    ------
    KeyboardInterrupt
        If the user interrupts, where the parser does not turn it into exit code 130 itself.
    """
    wanted = next((a for a in arguments if not a.startswith("-")), None)
    try:
        app = build_app(wanted)
        code = app(list(arguments) or ["--help"], prog_name="volcli", standalone_mode=False)
    except VolcliError as error:
        return _fail(str(error), error.exit_code)
    except _ParserError as error:
        return _fail(_usage(error), 2)
    except MemoryError as error:
        return _fail(f"out of memory ({error}); a smaller picture (--size) takes less", 1)
    except SystemExit:  # what the parser makes of a reader of its help that has gone away
        return 0
    except typer.Abort as error:
        raise KeyboardInterrupt from error
    except Exception as error:  # a defect of volcli: whoever mends it needs to see where
        import traceback

        traceback.print_exc()
        return _fail(f"unexpected {type(error).__name__}: {error}; please report it", 1)
    if code == 130:
        raise KeyboardInterrupt
    if not arguments:
        return 2
    return code if isinstance(code, int) else 0


def _fail(message: str, code: int) -> int:
    """Say what went wrong in one line that does not fill the screen, with nothing that a terminal
    would obey.
    """
    message = " ".join(message.split())
    shown = "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in message)
    print(f"volcli: {in_short(shown, _LONGEST)}", file=sys.stderr)
    return code


def _usage(error: Any) -> str:
    """What the parser has to say, and where help is."""
    said = error.format_message().rstrip(".").removeprefix("Invalid value for ")
    said = said.replace("': Input should be", ": must be").removeprefix("'")
    path = error.ctx.command_path if getattr(error, "ctx", None) else "volcli"
    return f"{said}; see {path} --help"
