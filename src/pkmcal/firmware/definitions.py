"""Definitions of a C header that is edited by hand, such as Marlin's Configuration.h.

Comments, conditions of the preprocessor (``#if``, ``ENABLED(...)``) and expressions of numbers and
other definitions are read as a compiler reads them, as far as the file itself decides.
"""

from __future__ import annotations

import ast
import math
import operator
import re
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from pkmcal.arrays import Array
from pkmcal.errors import InputError
from pkmcal.files import quoted
from pkmcal.firmware.contract import LARGEST_PRINTER_VALUE, missing_value

NO_CONSTANTS: Mapping[str, str] = MappingProxyType(dict[str, str]())
LONGEST_EXPRESSION = 200
"""Bound on the characters of a value or a condition."""
DEEPEST_DEFINITION = 10
"""Bound on names that are defined by other names."""

_DIRECTIVE = re.compile(r"#\s*(\w+)(\W.*)?")
_DEFINE = re.compile(r"([A-Za-z_]\w*)(?:\s(.*))?")
_COMMENT_MARK = re.compile(r"(//|/\*|\*/)")
_NOT = re.compile(r"!(?!=)")
_COMPARISONS: Mapping[type[ast.cmpop], Callable[[float, float], bool]] = {
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
}
_MACROS: Mapping[str, Callable[[list[bool]], bool]] = {
    "defined": all,
    **dict.fromkeys(("ENABLED", "BOTH", "ALL"), all),
    **dict.fromkeys(("ANY", "EITHER"), any),
    **dict.fromkeys(("DISABLED", "NONE"), lambda on: not any(on)),
}
"""Marlin's macros of conditions: whether all, any or none of several names are on."""
_OPERATORS: Mapping[type[ast.operator], Callable[[float, float], float]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    # integers as in C, towards zero
    ast.Div: lambda a, b: (
        abs(a) // abs(b) * (1 if a * b >= 0 else -1)
        if isinstance(a, int) and isinstance(b, int)
        else a / b
    ),
}


@dataclass(frozen=True)
class Define:
    """Definition with its line's number."""

    line: int
    name: str
    value: str


def _code_lines(text: str) -> Iterator[tuple[int, str]]:
    """Number and code of each line, without comments."""
    within = False  # a comment /* */
    for n, line in enumerate(text.splitlines(), 1):
        code: list[str] = []
        for mark in _COMMENT_MARK.split(line):
            if mark == "//" and not within:
                break
            if mark in ("/*", "*/"):
                within = mark == "/*"
            elif not within:
                code.append(mark)
        yield n, "".join(code).strip()


def active_definitions(text: str, constants: Mapping[str, str] = NO_CONSTANTS) -> Iterator[Define]:
    """Definitions that hold: not commented out, and in no branch of a condition that is false.

    A condition that cannot be evaluated may hold, and so may all branches after it.

    constants : values by name of what another header defines.
    """
    values = dict(constants)
    # of each enclosing condition: whether this branch holds, and whether one before it did; None
    # where unknown
    branches: list[tuple[bool | None, bool | None]] = []
    for n, code in _code_lines(text):
        directive = _DIRECTIVE.fullmatch(code)
        if not directive:
            continue
        word, rest = directive[1], (directive[2] or "").strip()
        if word in ("if", "ifdef", "ifndef"):
            call = {"if": rest, "ifdef": f"defined({rest})", "ifndef": f"!defined({rest})"}[word]
            branches.append((_condition(call, values), False))
        elif word in ("elif", "else") and branches:
            now, before = branches.pop()
            held = True if True in (now, before) else None if None in (now, before) else False
            own = True if word == "else" else _condition(rest, values)
            other = None if held is None and own is not False else own and held is False
            branches.append((other, held))
        elif word == "endif" and branches:
            branches.pop()
        possible = all(holds is not False for holds, _ in branches)
        if word == "define" and possible and (match := _DEFINE.fullmatch(rest)):
            values[match[1]] = (match[2] or "").strip()
            yield Define(n, match[1], values[match[1]])


def _condition(text: str, values: dict[str, str]) -> bool | None:
    """Whether a condition of the preprocessor holds with definitions before it; None if unknown."""

    def holds(node: ast.expr) -> float:
        match node:
            case ast.Call(func=ast.Name(id=macro), args=names) if macro in _MACROS:
                of_each = [name.id for name in names if isinstance(name, ast.Name)]
                if len(of_each) != len(names):
                    raise ValueError(ast.dump(node))
                on = [values.get(name, "0") in ("", "1", "true") for name in of_each]
                if macro == "defined":
                    on = [name in values for name in of_each]
                return _MACROS[macro](on)
            case ast.BoolOp(op=op, values=parts):
                return (any if isinstance(op, ast.Or) else all)([holds(part) for part in parts])
            case ast.UnaryOp(op=ast.Not(), operand=operand):
                return not holds(operand)
            case ast.Compare(left=left, ops=[op], comparators=[right]) if type(op) in _COMPARISONS:
                return _COMPARISONS[type(op)](holds(left), holds(right))
            case ast.Name(id=name):
                return float(values.get(name, "0"))
            case ast.Constant(value=int() as number):
                return number
            case _:
                raise ValueError(ast.dump(node))

    if len(text) > LONGEST_EXPRESSION:
        return None
    python = text.replace("&&", " and ").replace("||", " or ")
    try:
        return bool(holds(ast.parse(_NOT.sub(" not ", python).strip(), mode="eval").body))
    except (SyntaxError, ValueError, ArithmeticError, MemoryError, RecursionError):
        return None


class Definitions:
    """Definitions of a header.

    by_name : all that may hold, in the order of the file. label : the file's name, for messages.
    legal : the names that are read. constants : as for :func:`active_definitions`.
    """

    def __init__(
        self,
        text: str,
        label: str,
        legal: Collection[str] = (),
        constants: Mapping[str, str] = NO_CONSTANTS,
    ) -> None:
        self.label, self.legal = label, legal
        self.by_name: dict[str, list[Define]] = {}
        for define in active_definitions(text, constants):
            self.by_name.setdefault(define.name, []).append(define)
        self._results: dict[str, float] = {}

    def place(self, name: str) -> str:
        """The line of a definition, for messages."""
        return f"{self.label}, line {self.by_name[name][-1].line}"

    @property
    def places(self) -> dict[str, str]:
        """Lines of all definitions, by name."""
        return {name: f"line {found[-1].line}" for name, found in self.by_name.items()}

    def numbers(self, name: str, size: int, *default: float) -> Array:
        """Numbers (size,) of a definition; further ones, of extruders, are not looked at.

        Raises InputError for a missing definition without default, and for anything else.
        """
        if name not in self.by_name and default:
            return np.array(default)
        one = self._single(name)
        inside = one.value.removeprefix("{").removesuffix("}") if size > 1 else one.value
        parts = inside.split(",")[:size] if size > 1 else [inside]
        if len(parts) < size:
            raise InputError(
                f"{name} does not give one number for each tower",
                where=self.place(name),
                found=quoted(one.value),
                expected="numbers in braces, such as { 0.0, -0.5, -1.2 }",
            )
        return np.array([self._evaluated(part, one) for part in parts])

    def _single(self, name: str) -> Define:
        """The definition of a name. Raises InputError for none, and for several that differ."""
        all_of_it = self.by_name.get(name, [])
        if not all_of_it:
            raise missing_value(
                name, self.label, f"#define {name} with a number", self.places, self.legal
            )
        other = next((d for d in all_of_it if d.value != all_of_it[0].value), None)
        if other is not None:
            raise InputError(
                f"{name} is defined twice, and which one counts depends on other settings",
                where=f"{self.label}, lines {all_of_it[0].line} and {other.line}",
                found=f"{quoted(all_of_it[0].value)} and {quoted(other.value)}",
                expected="one definition",
                next_step="Remove the one that is not your printer's",
            )
        return all_of_it[0]

    def _evaluated(self, text: str, at: Define, depth: int = 0) -> float:
        """Number of an expression of numbers, other definitions, + - * / and parentheses.

        Raises InputError for anything else.
        """

        def value_of(node: ast.expr) -> float:
            match node:
                case ast.Constant(value=int() | float() as number) if not isinstance(number, bool):
                    return number
                case ast.Call(func=ast.Name(id="double" | "float"), args=[argument], keywords=[]):
                    return float(value_of(argument))
                case ast.Name(id=name) if depth < DEEPEST_DEFINITION:
                    # each definition is evaluated once, however often others name it
                    if name not in self._results:
                        one = self._single(name)
                        self._results[name] = self._evaluated(one.value, one, depth + 1)
                    return self._results[name]
                case ast.UnaryOp(op=ast.USub(), operand=operand):
                    return -value_of(operand)
                case ast.UnaryOp(op=ast.UAdd(), operand=operand):
                    return value_of(operand)
                case ast.BinOp(left=left, op=op, right=right) if type(op) in _OPERATORS:
                    return _OPERATORS[type(op)](value_of(left), value_of(right))
                case _:
                    raise ValueError(ast.dump(node))

        value = math.nan
        if len(text) <= LONGEST_EXPRESSION:
            try:
                value = value_of(ast.parse(text.strip(), mode="eval").body)
            except (SyntaxError, ValueError, ArithmeticError, MemoryError, RecursionError):
                value = math.nan
        if not abs(value) <= LARGEST_PRINTER_VALUE:
            raise InputError(
                f"{at.name} is no number that a printer can have",
                where=f"{self.label}, line {at.line}",
                found=quoted(at.value),
                expected="a number in mm, or degrees, or other definitions with + - * / between",
            )
        return value
