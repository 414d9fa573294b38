"""Parameters of short docstrings for the documentation's site (a griffe extension).

Short docstrings state a parameter in their text, ``name : description``, without the heading of
numpydoc. The site shows those in the same table as the others.
"""

from __future__ import annotations

import re
from typing import Any

from griffe import Extension, Function


class ShortParameters(Extension):
    """Gives docstrings a Parameters section for the parameters that their text describes."""

    def on_function(self, *, func: Function, **_: Any) -> None:
        """Rewrite the docstring of a function without a Parameters section."""
        if func.docstring and "Parameters\n---" not in func.docstring.value:
            func.docstring.value = with_section(
                func.docstring.value, [p.name for p in func.parameters]
            )


def with_section(text: str, names: list[str]) -> str:
    """Docstring whose ``name : description`` sentences are moved into a Parameters section."""
    one = "(?:" + "|".join(map(re.escape, names)) + ")"
    parts = re.split(rf"(?:^|(?<=\s))({one}(?:, {one})*) : ", text)
    if len(parts) < 3 or not names:
        return text
    rest, section = [parts[0].rstrip()], ["Parameters", "----------"]
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
