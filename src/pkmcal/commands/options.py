"""Declaration of commands: their arguments and options, each a line of the help.

A command's options have the names of the arguments of its function in ``pkmcal.api``, to which they
are passed on. Ranges, choices and defaults are those of :mod:`pkmcal.ranges`.
"""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from contextlib import suppress
from math import pi
from pathlib import Path
from typing import Any, get_args

import click

from pkmcal.errors import InputError
from pkmcal.ranges import RANGES, Range

OUTPUT_GROUP = "Output"
"""Heading of the options of outputs, the last in the help."""
UNIT_EXAMPLES = {
    "m": "2 mm",
    "rad": "30 deg",
    "deg": "0.5 deg",
    "m or rad": "3 um or 0.001 deg",
    "m/s or rad/s": "100 mm/s or 30 deg/s",
    "px": "0.5 px",
    "s": "10 s",
    "1/s": "25 Hz",
    "K": "5 K",
    "share": "1 %",
}
"""Numbers with a unit, by the unit of a number without one."""


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


class _NumberOption(_Option):
    """Option with a number in a range."""

    def __init__(self, flags: list[str], group: str, allowed: Range, **settings: Any) -> None:
        super().__init__(flags, group, type=str, **settings)
        self.allowed = allowed


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
        ranges = [one.allowed for one in self.params if isinstance(one, _NumberOption)]
        if units := dict.fromkeys(one.unit for one in ranges if one.unit):
            examples = " or ".join(UNIT_EXAMPLES[unit] for unit in units).split(" or ")
            plain = " or ".join(one.plain_unit for one in ranges if one.plain_unit).split(" or ")
            names = (
                f" Without one they are in {', '.join(dict.fromkeys(plain))}." if plain[0] else ""
            )
            with formatter.section("Units"):
                formatter.write_text(
                    f"Numbers may have a unit, as in files: {', '.join(dict.fromkeys(examples))}."
                    f"{names}"
                )

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

    flags : names; by default ``--name``. into : argument that it becomes; by default ``name``.
    usual : the default as text, if it is a rule.
    """
    allowed = RANGES[command][name]
    words = flags.split() or [f"--{name.replace('_', '-')}"]

    def check(_context: Any, _parameter: Any, value: Any) -> Any:
        return value if value is None else parsed_number(value, allowed, words[-1])

    # ranges of angles are shown in degrees
    factor, unit = (pi / 180, "deg") if allowed.unit == "rad" else (1, None)
    facts = [allowed.text(factor, unit)]
    if usual or allowed.default is not None:
        own = allowed.plain_unit if " or " not in allowed.plain_unit else ""
        facts.append(f"default: {usual or f'{allowed.default:g} {own}'.rstrip()}")
    return _NumberOption(
        [*words, into or name], group, allowed, metavar=metavar, callback=check,
        default=allowed.default, help=f"{described} [{'; '.join(facts)}]",
    )  # fmt: skip


def parsed_number(text: str, allowed: Range, where: str) -> float | str:
    """Number of an option, as in files with or without a unit; InputError for another text and for
    a number outside the range.

    A text with a unit of a joint stays as it is, because only the machine determines whether its
    joints have that unit. where : the option.
    """
    with suppress(ValueError, InputError):
        value = int(text) if allowed.whole else float(text)
        allowed.check(value, where)
        return value  # such as every default: units are loaded for others alone
    example = f", such as {UNIT_EXAMPLES[allowed.unit]}" if allowed.unit else ""
    expected = f"{'a whole number, ' if allowed.whole else ''}{allowed.text()}{example}"
    if allowed.unit:
        from pkmcal.files.quantities import read_with_unit

        with suppress(ValueError):
            value, unit = read_with_unit(text, allowed.unit)
            expected = allowed.text(unit.factor, unit.name) if unit else expected
            with suppress(InputError):
                allowed.check(value, where)
                return text if " or " in allowed.unit else value
    raise InputError(
        "this number cannot be used", where=where, found=text.strip(),
        expected=expected,
    )  # fmt: skip


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
        "--session",
        "DIR",
        "Session with the cameras, if it has moved since the calibration. [default: where it was]",
        Path,
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
