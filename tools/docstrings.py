"""Parameters of short docstrings for the documentation's site (a griffe extension).

Short docstrings state a parameter, or an attribute of a class, in their text: ``name :
description``, without a heading of numpydoc. The site shows those in the same tables as the others.
"""

from __future__ import annotations

import re
from typing import Any

from griffe import Class, Extension, Function


class ShortSections(Extension):
    """Gives docstrings a section for the names that their text describes."""

    def on_function(self, *, func: Function, **_: Any) -> None:
        """Parameters of a function."""
        if func.docstring:
            names = [parameter.name for parameter in func.parameters]
            func.docstring.value = with_section(func.docstring.value, "Parameters", names)

    def on_class(self, *, cls: Class, **_: Any) -> None:
        """Attributes of a class."""
        if cls.docstring:
            names = [name for name, member in cls.members.items() if member.is_attribute]
            cls.docstring.value = with_section(cls.docstring.value, "Attributes", names)


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
