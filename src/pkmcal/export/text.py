"""Numbers and comments as other programs read them."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Sequence

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.export.source import Source


def exact(value: float) -> str:
    """Seventeen significant digits: a double comes back as it was."""
    return f"{value:.17g}"


def c_number(value: float) -> str:
    """A C constant of type double."""
    text = exact(value)
    return text if any(mark in text for mark in ".en") else text + ".0"


def c_array(
    kind: str, name: str, shape: str, values: Array | Integers | Booleans, note: str = ""
) -> str:
    """A C constant array of one or two dimensions, with a comment above."""
    number = c_number if kind == "double" else (lambda v: str(int(v)))
    rows = [
        "{" + ", ".join(number(v) for v in row) + "}" if values.ndim > 1 else number(row)
        for row in values
    ]
    separator = ",\n    " if values.ndim > 1 or kind == "double" else ", "
    body = separator.join(rows)
    above = f"/* {safe(note)} */\n" if note else ""
    return f"{above}static const {kind} {name}{shape} = {{\n    {body}\n}};\n"


def c_comment(lines: Iterable[str]) -> str:
    """Lines as one C comment; nothing in them ends it, or joins lines."""
    wrapped = [part for line in lines for part in textwrap.wrap(safe(line), 96) or [""]]
    body = "\n".join(f" * {line}".rstrip() for line in wrapped)
    return f"/*\n{body}\n */\n"


def safe(text: str) -> str:
    """Text that cannot end a C comment."""
    return text.replace("*/", "* /").replace("/*", "/ *").replace("\\", "/").replace("?", ".")


def commented(lines: Iterable[str], mark: str) -> str:
    """Lines behind a mark each, such as ``#`` or ``;``."""
    return "".join(f"{mark} {line}".rstrip() + "\n" for line in lines)


def sigma_lines(source: Source, kinds: Sequence[str] = ()) -> list[str]:
    """One line a parameter: name, value, unit and standard deviation; all kinds unless named."""
    machine = source.machine
    table = machine.parameters
    values = table.unit_axes(machine.values)
    out: list[str] = []
    for k, name in enumerate(table.names):
        if kinds and table.kinds[k] not in kinds:
            continue
        sigma = source.sigma_of(name)
        unit = "" if table.units[k] == "1" else f" {table.units[k]}"
        told = "" if sigma is None else f", sigma {sigma:.3g}{unit}" if sigma else ", held"
        out.append(f"{name} = {values[k]:.9g}{unit}{told}")
    return out
