"""Numbers that options take, checked."""

from __future__ import annotations

from pkmcal.errors import InputError


def check_positive(option: str, value: float, most: float) -> None:
    """Raise `InputError` where an option's number is not above zero, or above ``most``."""
    if not 0 < value <= most:
        raise InputError(
            "this number cannot be used",
            where=option,
            found=f"{value:g}",
            expected=f"more than 0 and at most {most:g}",
        )
