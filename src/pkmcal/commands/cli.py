"""Command line: entry point, lazy commands, errors and exit codes. Each command is a module of
:mod:`pkmcal.commands`.

Exit codes: 0 done; 1 ran, but the result should not be used; 2 the input is wrong; 70 a defect of
pkmcal; 130 interrupted. No mistake of a user ends in a traceback.
"""

from __future__ import annotations

import json
import os
import re
import sys
import traceback
import warnings
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any

import click

from pkmcal.commands.console import print_error
from pkmcal.commands.streams import LostOutput, withstanding
from pkmcal.errors import InputError, PkmcalError, legible

INTERNAL_ERROR_EXIT = 70
"""EX_SOFTWARE of sysexits.h: an internal error, not one of the user."""
INTERRUPTED_EXIT = 130
"""Exit code that shells give to a program ended by Ctrl-C."""
DEBUG_VARIABLE = "PKMCAL_DEBUG"

WIDEST_HELP = 120
"""Largest width of the help in characters; longer lines are hard to read."""
SHELLS = ("bash", "zsh", "fish")
"""Shells that can complete commands and options."""

COMMANDS_IN_ORDER = (
    "demo",
    "new",
    "show",
    "check",
    "view",
    "board",
    "camera",
    "plan",
    "calibrate",
    "validate",
    "servo",
    "export",
    "watch",
    "diff",
    "simulate",
    "study",
    "reproduce",
)
"""Commands in the order of the help, which is that in which a newcomer needs them. Each is the
function of its name in the module of its name.
"""


class _Commands(click.Group):
    """Group of commands, each imported when it is used."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return [*COMMANDS_IN_ORDER, *super().list_commands(ctx)]

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name in COMMANDS_IN_ORDER:
            return command_named(cmd_name)
        return super().get_command(ctx, cmd_name)


def command_named(name: str) -> click.Command:
    """A command, from the module of its name."""
    return getattr(import_module(f"pkmcal.commands.{name}"), name)


def _print_and_exit(text: Callable[[str], str]) -> Callable[..., None]:
    """Callback of an option that prints a text from its value, and ends the program."""

    def print_text(ctx: click.Context, _parameter: click.Parameter, value: Any) -> None:
        if value and not ctx.resilient_parsing:
            click.echo(text(value))
            ctx.exit()

    return print_text


def _version(_: str) -> str:
    from importlib.metadata import version

    return f"pkmcal {version('pkmcal')}"


def _completion(shell: str) -> str:
    from click.shell_completion import get_completion_class

    kind = get_completion_class(shell)
    return kind(app, {}, "pkmcal", "_PKMCAL_COMPLETE").source() if kind else ""


app = _Commands(
    "pkmcal",
    help="Calibrate parallel machines from images of their own legs.",
    epilog="Begin with: pkmcal demo. With your own machine: pkmcal new my-machine.",
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": WIDEST_HELP},
    params=[
        click.Option(
            ["-V", "--version"],
            is_flag=True,
            is_eager=True,
            expose_value=False,
            callback=_print_and_exit(_version),
            help="Show the version and exit.",
        ),
        click.Option(
            ["--completion"],
            type=click.Choice(SHELLS),
            metavar="SHELL",
            is_eager=True,
            expose_value=False,
            callback=_print_and_exit(_completion),
            help="Print the completion script for bash, zsh or fish and exit.",
        ),
    ],
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; return its exit code."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    # pkmcal reports itself what OpenCV cannot read.
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    with withstanding(), warnings.catch_warnings():
        warnings.filterwarnings("ignore", module=r"PIL\.")  # such as of EXIF that is cut short
        try:
            code = app(words or ["--help"], prog_name="pkmcal", standalone_mode=False)
            sys.stdout.flush()
        except KeyboardInterrupt:
            code = INTERRUPTED_EXIT
        except Exception as error:  # noqa: BLE001 - the last resort: a defect, or a user's mistake
            return _report_error(error, words)
        return code if isinstance(code, int) else 0


def _report_error(error: BaseException, words: list[str]) -> int:
    """Report an error as text, or as JSON with ``--json``; return the exit code."""
    if os.environ.get(DEBUG_VARIABLE):
        sys.stderr.write(legible("".join(traceback.format_exception(error)), keep="\n"))
    message, code = _as_pkmcal_error(error, words)
    if "--json" in words and not isinstance(error, LostOutput):
        try:
            click.echo(json.dumps({**message.as_dict(), "exit_code": code}, ensure_ascii=False))
            sys.stdout.flush()
        except LostOutput:
            pass  # report the first error on standard error, if possible
        else:
            return code
    print_error(str(message))
    return code


def _as_pkmcal_error(error: BaseException, words: list[str]) -> tuple[PkmcalError, int]:
    """Any error as a PkmcalError, with its exit code."""
    if isinstance(error, PkmcalError):
        return error, error.exit_code
    if isinstance(error, click.UsageError):
        command = words[0] + " " if words and words[0] in COMMANDS_IN_ORDER else ""
        message = InputError(_usage_message(error), next_step=f"See pkmcal {command}--help")
        return message, message.exit_code
    if isinstance(error, KeyboardInterrupt | click.Abort):
        return PkmcalError("interrupted; what was not finished was not written"), INTERRUPTED_EXIT
    if isinstance(error, MemoryError):
        message = InputError(
            "there is not enough memory",
            next_step="Close other programs, or use fewer or smaller images",
        )
        return message, message.exit_code
    if isinstance(error, OSError):
        from pkmcal.files import refused_by_system

        message = refused_by_system(error)
        return message, message.exit_code
    defect = PkmcalError(
        f"this is a defect of pkmcal, not of your session: {type(error).__name__}: {error}",
        next_step=f"Set {DEBUG_VARIABLE}=1, run the command again, and report what it then prints",
    )
    return defect, INTERNAL_ERROR_EXIT


def _usage_message(error: click.UsageError) -> str:
    """Message of an error about the command line, with the closest word.

    The library's own suggestions are not used: they include words of little similarity.
    """
    from pkmcal.files import closest

    guess: str | None = None
    if isinstance(error, click.NoSuchOption):
        message = f"No such option: {error.option_name}"
        names = [name for p in error.ctx.command.params for name in p.opts] if error.ctx else []
        bare = {name.lstrip("-"): name for name in names if name.startswith("--")}
        guess = bare.get(closest(error.option_name.lstrip("-"), bare) or "")
        return f"{message}, did you mean {guess}" if guess else message
    message = " ".join(error.format_message().split()).partition(" Did you mean")[0].rstrip(". ")
    if command := re.match(r"No such command '(.+)'", message):
        guess = closest(command[1], COMMANDS_IN_ORDER)
    elif choice := re.search(r"'([^']*)' is not one of (.+)", message):
        guess = closest(choice[1], re.findall(r"'([^']+)'", choice[2]))
    return f"{message}, did you mean {guess}" if guess else message
