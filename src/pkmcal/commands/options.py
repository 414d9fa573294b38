"""Declaration of commands: their arguments and options, each a line of the help.

A command's options have the names of the arguments of its function in ``pkmcal.api``, to which they
are passed on. Ranges, choices and defaults are those of :mod:`pkmcal.ranges`.
"""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, get_args

import click

from pkmcal.errors import InputError
from pkmcal.ranges import RANGES, check_number

OUTPUT_GROUP = "Output"
"""Heading of the options of outputs, the last in the help."""
UNIT_EXAMPLES = {"m": "0.001 or 1 mm", "rad": "0.01 or 0.5 deg", "deg": "3 or 3 deg"}
"""Numbers by the unit of one that has none."""
OTHER_UNIT_EXAMPLES = "3e-6 or 3 um"
MOST_IN_HELP = 1e12
"""Limits above are not shown in the help."""


class _Option(click.Option):
    """Option with the heading of its group in the help.

    earlier : a former name, which is accepted and not in the help.
    """

    def __init__(self, flags: list[str], group: str, earlier: str = "", **settings: Any) -> None:
        super().__init__([*flags, earlier] if earlier else flags, **settings)
        self.group, self.earlier = group, earlier

    def get_help_record(self, ctx: click.Context) -> tuple[str, str] | None:
        """Names without the earlier one, and description."""
        record = super().get_help_record(ctx)
        if record is None or not self.earlier:
            return record
        return record[0].replace(f", {self.earlier}", ""), record[1]


class _Argument(click.Argument):
    """Argument with a line in the help."""

    group = "Arguments"

    def __init__(self, name: str, described: str, **settings: Any) -> None:
        super().__init__([name], **settings)
        self.described = described

    def get_help_record(self, ctx: click.Context) -> tuple[str, str]:
        """Name and description."""
        del ctx
        return self.metavar or self.human_readable_name, self.described


class Command(click.Command):
    """Command whose help has its options in groups and ends in examples."""

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write arguments and options by groups, those of outputs last."""
        groups: dict[str, list[tuple[str, str]]] = {}
        for parameter in self.get_params(ctx):
            if record := parameter.get_help_record(ctx):
                groups.setdefault(getattr(parameter, "group", "Options"), []).append(record)
        last = groups.pop(OUTPUT_GROUP)
        for title, records in {**groups, OUTPUT_GROUP: last}.items():
            with formatter.section(title):
                formatter.write_dl(records)

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the examples as they are."""
        del ctx
        formatter.write(f"\n{self.epilog}")


def command(
    examples: str, *parameters: click.Parameter, more: str = ""
) -> Callable[[Callable[..., int]], Command]:
    """Command of a function, which returns the exit code; its docstring is the description.

    examples : three lines to be run. more : end of the help.
    """

    def build(function: Callable[..., int]) -> Command:
        description = " ".join((function.__doc__ or "").split())
        return Command(
            function.__name__,
            callback=function,
            params=list(parameters),
            help=description,
            short_help=description,
            epilog=f"Examples:\n{textwrap.indent(examples, '  ')}{more and chr(10)}{more}",
            context_settings={"help_option_names": ["-h", "--help"]},
        )

    return build


def argument(name: str, metavar: str, described: str, kind: Any = str, **settings: Any) -> Any:
    """Argument of a command. kind : ``str`` or ``Path``."""
    return _Argument(name, described, metavar=metavar, type=_type(kind), **settings)


def option(
    flags: str, metavar: str, described: str, kind: Any = str, *, group: str = "Options",
    **settings: Any,
) -> Any:  # fmt: skip
    """Option with a value. flags : names, such as ``-o --out``, and the argument's if it has
    another. kind : ``str`` or ``Path``.
    """
    return _Option(
        flags.split(), group, metavar=metavar, help=described, type=_type(kind), **settings
    )


def _type(kind: Any) -> Any:
    return click.Path(path_type=Path) if kind is Path else kind


def flag(flags: str, described: str, *, group: str = "Options", **settings: Any) -> Any:
    """Option without a value."""
    return _Option(flags.split(), group, is_flag=True, help=described, **settings)


def choice(name: str, values: Any, described: str, *, group: str = "Options") -> Any:
    """Option with the values of a ``Literal``, the first of which is the default."""
    first, *_ = names = get_args(values)
    return _Option(
        [f"--{name}"], group, type=click.Choice(names), default=first, metavar="NAME",
        help=f"{described} [{', '.join(names)}; default: {first}]",
    )  # fmt: skip


def choices(name: str, values: Any, described: str) -> Any:
    """Option with some of the values of a ``Literal``, one each time that it is given."""
    names = get_args(values)
    return _Option(
        [f"--{name}"], "Options", type=click.Choice(names), multiple=True, metavar="NAME",
        help=f"{described} [{', '.join(names)}]",
    )  # fmt: skip


def number(
    command: str,
    name: str,
    metavar: str,
    described: str,
    *,
    flags: str = "",
    into: str = "",
    usual: str = "",
    group: str = "Options",
) -> Any:
    """Numeric option, with its range, unit and default in :data:`pkmcal.ranges.RANGES`.

    Lengths and angles may have a unit, such as ``0.1 deg``, as in files.
    flags : names; by default ``--name``. into : argument that it becomes; by default ``name``.
    usual : the default as text, if it is a rule.
    """
    allowed = RANGES[command][name]
    words = flags.split() or [f"--{name.replace('_', '-')}"]

    def check(_context: Any, _parameter: Any, value: Any) -> Any:
        if isinstance(value, str):
            value = quantity(value, allowed.unit, words[-1])
        check_number(command, name, value, words[-1])
        return value

    facts = [str(allowed)] if allowed.most < MOST_IN_HELP else []
    if allowed.unit:
        facts.insert(0, f"such as {UNIT_EXAMPLES.get(allowed.unit, OTHER_UNIT_EXAMPLES)}")
    if usual or allowed.default is not None:
        facts.append(f"default: {usual or format(allowed.default, 'g')}")
    return _Option(
        [*words, into or name], group, metavar=metavar, callback=check, default=allowed.default,
        type=str if allowed.unit else int if allowed.whole else float,
        help=f"{described} [{'; '.join(facts)}]",
    )  # fmt: skip


def quantity(text: str, unit: str, where: str) -> float:
    """Number of an option, with or without a unit; InputError for another text.

    unit : that of a number without one, m, rad, "m or rad" or deg. where : the option.
    """
    with suppress(ValueError):
        return float(text)  # such as every default: units are loaded for others alone
    from pkmcal.files.quantities import read_quantity

    try:
        return read_quantity(text, unit)
    except ValueError:
        kinds = {"m": "a length", "rad": "an angle", "deg": "an angle"}
        raise InputError(
            "this number cannot be used",
            where=where,
            found=text,
            expected=f"{kinds.get(unit, 'a length or an angle')}, such as"
            f" {UNIT_EXAMPLES.get(unit, OTHER_UNIT_EXAMPLES)}",
        ) from None


def seed(command: str) -> Any:
    """Option of the seed."""
    return number(command, "seed", "N", "Seed for all random numbers.")


def session(described: str = "Folder of the session.") -> Any:
    """Argument of a session's folder."""
    return argument("session", "SESSION", described, Path)


def calibration() -> Any:
    """Argument of a calibration's folder."""
    return argument("calibration", "CALIBRATION", "Folder that calibrate wrote.", Path)


def cameras_session() -> Any:
    """Option of a calibration's session."""
    return option(
        "--session", "DIR", "Session with the cameras, if it has moved since the calibration.", Path
    )


def out(usual: str, described: str = "Folder for the results.", metavar: str = "DIR") -> Any:
    """Option of the output. usual : the default, as text."""
    return option("-o --out", metavar, f"{described} [default: {usual}]", Path, group=OUTPUT_GROUP)


def force() -> Any:
    """Option to replace an earlier result."""
    return flag(
        "--force", "Replace an earlier result instead of keeping it in a dated folder.",
        group=OUTPUT_GROUP,
    )  # fmt: skip


def as_json() -> Any:
    """Option of output for programs."""
    return flag("--json as_json", "Print one JSON object and nothing else.", group=OUTPUT_GROUP)
