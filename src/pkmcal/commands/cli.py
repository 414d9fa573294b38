"""Command line: entry point, lazy commands, errors and exit codes. Each command is a module of
:mod:`pkmcal.commands`.

Exit codes: 0 done; 1 ran, but the result should not be used; 2 the input is wrong; 70 a defect of
pkmcal; 130 interrupted. No mistake of a user ends in a traceback.
"""

from __future__ import annotations

import atexit
import gc
import json
import os
import re
import sys
import textwrap
import traceback
import warnings
from collections.abc import Sequence
from functools import cache
from importlib import import_module
from typing import Annotated, Any, cast

import typer
import typer.core
import typer.main

from pkmcal.commands.console import OUTPUT_GROUP, print_error
from pkmcal.commands.streams import LostOutput, withstanding
from pkmcal.errors import InputError, PkmcalError, legible

INTERNAL_ERROR_EXIT = 70
"""EX_SOFTWARE of sysexits.h: an internal error, not one of the user."""
INTERRUPTED_EXIT = 130
"""Exit code that shells give to a program ended by Ctrl-C."""
DEBUG_VARIABLE = "PKMCAL_DEBUG"
UNCOLLECTED_OBJECTS_ALLOWED = 20_000
"""Threshold of Python's garbage collector, instead of 700: loading a command creates 80,000 objects
that live until it ends.
"""

_UsageError = cast("type[Exception]", typer.BadParameter.__bases__[0])
"""Base class of typer's errors about options, which has no public name."""

CONTEXT_SETTINGS = {"help_option_names": ["-h", "--help"]}

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


class _Command(typer.core.TyperCommand):
    """Command whose help groups options by their panels and ends in examples."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        groups: dict[str, list[tuple[str, str]]] = {"Arguments": [], "Options": []}
        for parameter in self.get_params(ctx):
            if record := parameter.get_help_record(ctx):
                panel = getattr(parameter, "rich_help_panel", None) or "Options"
                title = "Arguments" if parameter.param_type_name == "argument" else panel
                groups.setdefault(title, []).append(record)
        last = groups.pop(OUTPUT_GROUP, [])
        for title, records in {**groups, OUTPUT_GROUP: last}.items():
            if not records:
                continue
            with formatter.section(title):
                formatter.write_dl(records)

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        del ctx
        if self.epilog:
            formatter.write_paragraph()
            formatter.write(self.epilog)


class _Commands(typer.core.TyperGroup):
    """Group of commands, each imported when it is used."""

    def list_commands(self, ctx: Any) -> list[str]:
        return [*COMMANDS_IN_ORDER, *super().list_commands(ctx)]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        return (
            _typer_command(cmd_name)
            if cmd_name in COMMANDS_IN_ORDER
            else super().get_command(ctx, cmd_name)
        )


@cache
def _typer_command(name: str) -> Any:
    """A command as typer's object; building those of all commands would take 20 ms."""
    alone = typer.Typer(rich_markup_mode=None, add_completion=False)
    module = import_module(f"pkmcal.commands.{name}")
    examples = textwrap.indent(getattr(module, "EXAMPLES", ""), "  ")
    epilog = f"Examples:\n{examples}" if examples else ""
    if further := getattr(module, "FURTHER_HELP", ""):
        epilog += f"\n{further}"
    alone.command(name, cls=_Command, epilog=epilog, context_settings=CONTEXT_SETTINGS)(
        getattr(module, name)
    )
    return typer.main.get_command(alone)


app = typer.Typer(
    name="pkmcal",
    cls=_Commands,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings=CONTEXT_SETTINGS,
    epilog="Begin with: pkmcal demo. With your own machine: pkmcal new my-machine.",
)


def _show_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(f"pkmcal {version('pkmcal')}")
        raise typer.Exit


@app.callback()
def _top(
    version: Annotated[
        bool,
        typer.Option(
            "-V",
            "--version",
            callback=_show_version,
            is_eager=True,
            help="Show the version, and exit.",
        ),
    ] = False,
) -> None:
    """Calibrate parallel machines from images of their own legs."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; return its exit code."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    # in a process of our own, reference cycles need not be collected at the end
    if arguments is None:
        gc.set_threshold(UNCOLLECTED_OBJECTS_ALLOWED)
        atexit.register(gc.freeze)
    # pkmcal reports itself what OpenCV cannot read.
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    with withstanding(), warnings.catch_warnings():
        warnings.filterwarnings("ignore", module=r"PIL\.")  # such as of EXIF that is cut short
        try:
            code = _run(words or ["--help"])
            sys.stdout.flush()
        except KeyboardInterrupt:
            code = INTERRUPTED_EXIT
        except Exception as error:  # noqa: BLE001 - the last resort: a defect, or a user's mistake
            return _report_error(error, words)
        if code == INTERRUPTED_EXIT:  # typer turns Ctrl-C into this code
            return _report_error(KeyboardInterrupt(), words)
        return code if isinstance(code, int) else 0


def _run(words: list[str]) -> Any:
    """Exit code of the program's arguments, None for 0.

    A command runs without the group of all, whose own options would load another tenth of a second.
    """
    if words[0] not in COMMANDS_IN_ORDER:
        return app(words, prog_name="pkmcal", standalone_mode=False)
    command = _typer_command(words[0])
    return command(words[1:], prog_name=f"pkmcal {words[0]}", standalone_mode=False)


def _report_error(error: BaseException, words: list[str]) -> int:
    """Report an error as text, or as JSON with ``--json``; return the exit code."""
    if os.environ.get(DEBUG_VARIABLE):
        sys.stderr.write(legible("".join(traceback.format_exception(error)), keep="\n"))
    message, code = _as_pkmcal_error(error, words)
    if "--json" in words and not isinstance(error, LostOutput):
        try:
            typer.echo(json.dumps({**message.as_dict(), "exit_code": code}, ensure_ascii=False))
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
    if isinstance(error, _UsageError):
        command = words[0] + " " if words and words[0] in COMMANDS_IN_ORDER else ""
        message = InputError(_usage_message(error), next_step=f"See pkmcal {command}--help")
        return message, message.exit_code
    if isinstance(error, KeyboardInterrupt | typer.Abort):
        return PkmcalError("interrupted; what was not finished was not written"), INTERRUPTED_EXIT
    if isinstance(error, MemoryError):
        message = InputError(
            "there is not enough memory",
            next_step="Close other programs, or use fewer or smaller images",
        )
        return message, message.exit_code
    if isinstance(error, OSError):  # no space, no permission, a disk taken away
        from pkmcal.files import next_step_after

        reason = (error.strerror or str(error) or type(error).__name__).lower()
        message = InputError(
            f"the operating system refused: {reason}",
            where=str(error.filename) if error.filename else None,
            next_step=next_step_after(error),
        )
        return message, message.exit_code
    defect = PkmcalError(
        f"this is a defect of pkmcal, not of your session: {type(error).__name__}: {error}",
        next_step=f"Set {DEBUG_VARIABLE}=1, run the command again, and report what it then prints",
    )
    return defect, INTERNAL_ERROR_EXIT


_SUGGESTION = re.compile(r"(Did you mean|\(Possible options:).*")
_TYPER_PHRASES = (
    (r"Value error, ", ""),
    (r"Input should be", "it should be"),
    (r", unable to .*", ""),
)
"""Replacements in the messages of typer's own checks, which name internals."""


def _usage_message(error: Exception) -> str:
    """Message of an error about the command line, with the closest known word.

    typer's own suggestions are removed, because they include words of little similarity.
    """
    from pkmcal.files import closest

    message = " ".join(getattr(error, "format_message", error.__str__)().split())
    message = _SUGGESTION.sub("", message).rstrip("?. ")
    for inside, instead in _TYPER_PHRASES:
        message = re.sub(inside, instead, message)
    guess: str | None = None
    if option := re.match(r"No such option:? '?-*([^\s']+)", message):
        names = [name for p in vars(error)["ctx"].command.params for name in p.opts]
        bare = {name.lstrip("-"): name for name in names if name.startswith("--")}
        guess = bare.get(closest(option[1], bare) or "")
    elif command := re.match(r"No such command '(.+)'", message):
        guess = closest(command[1], COMMANDS_IN_ORDER)
    elif choice := re.search(r"'([^']*)' is not one of (.+)", message):
        guess = closest(choice[1], re.findall(r"'([^']+)'", choice[2]))
    return f"{message}, did you mean {guess}" if guess else message
