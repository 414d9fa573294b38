"""Parameters of functions for the documentation's site (griffe extensions).

Short docstrings state a parameter, or an attribute of a class, in their text: ``name :
description``, without a heading of numpydoc. The site shows those in the same tables as the others.
Defaults that the sources take from a table, and choices that they name, are shown as their values.
"""

from __future__ import annotations

import inspect
import re
from importlib import import_module
from typing import Any, Literal, get_args, get_origin

from griffe import Class, Extension, Function

SHARED = re.compile(r"^(\w+(?:, \w+)+) :\n((?:    .*\n)+)", re.MULTILINE)
"""Entry of several names in a section of numpydoc, and its text."""


class ShortSections(Extension):
    """Gives docstrings a section for the names that their text describes."""

    def on_function(self, *, func: Function, **_: Any) -> None:
        """Parameters of a function."""
        if func.docstring:
            names = [parameter.name for parameter in func.parameters]
            text = with_section(func.docstring.value, "Parameters", names)
            # an entry for each name: griffe gives all names of one entry the first one's default
            func.docstring.value = SHARED.sub(
                lambda entry: "".join(f"{name} :\n{entry[2]}" for name in entry[1].split(", ")),
                text + "\n",
            )

    def on_class(self, *, cls: Class, **_: Any) -> None:
        """Attributes of a class."""
        if cls.docstring:
            names = [name for name, member in cls.members.items() if member.is_attribute]
            cls.docstring.value = with_section(cls.docstring.value, "Attributes", names)


class Values(Extension):
    """Gives the parameters of the public functions their defaults and choices as values."""

    def on_function(self, *, func: Function, **_: Any) -> None:
        """Defaults, and annotations that name a ``Literal``, of a function of a module."""
        if not func.path.startswith("pkmcal.api.") or not func.parent.is_module:
            return
        module = import_module(func.module.path)
        actual = inspect.signature(getattr(module, func.name)).parameters
        for parameter in func.parameters:
            if actual[parameter.name].default is not inspect.Parameter.empty:
                parameter.default = repr(actual[parameter.name].default)
            for name in set(re.findall(r"\b[A-Z]\w+\b", str(parameter.annotation))):
                if get_origin(choice := getattr(module, name, None)) is Literal:
                    choices = " | ".join(map(repr, get_args(choice)))
                    parameter.annotation = re.sub(
                        rf"\b{name}\b", choices, str(parameter.annotation)
                    )


def with_section(text: str, heading: str, names: list[str]) -> str:
    """Docstring whose ``name : description`` sentences are moved into a section of numpydoc; as it
    is where it has that section, or no such sentence.
    """
    line = "-" * len(heading)
    one = "(?:" + "|".join(map(re.escape, names)) + ")"
    parts = re.split(rf"(?:^|(?<=\s))({one}(?:, {one})*) : ", text)
    if f"{heading}\n{line}" in text or not names or len(parts) < 3:
        return text
    rest, section = [parts[0].rstrip()], [heading, line]
    for name, description in zip(parts[1::2], parts[2::2], strict=True):
        # what the function returns and raises follows the last parameter
        end = re.search(r"\n\n|(?<=\.)\s+(?=(?:Raises|Returns) )", description)
        own, after = (
            (description[: end.start()], description[end.end() :]) if end else (description, "")
        )
        own = own.strip()
        section += [f"{name} :", "    " + " ".join((own[:1].upper() + own[1:]).split())]
        rest.append(after.strip())
    return "\n\n".join([*filter(None, rest), "\n".join(section)])
