"""The pages' templates: one environment for all of them."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any

from pkmcal import wording
from pkmcal.report import charts

if TYPE_CHECKING:
    import jinja2

N_COLOURS = 8
"""Leg colours in the style sheet; machines with more legs use them again."""


def render(template: str, **views: Any) -> str:
    """A template filled; every value escaped unless the template says otherwise."""
    return environment().get_template(template).render(**views)


@cache
def environment() -> jinja2.Environment:
    """Templates of this package."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("pkmcal.report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    shared: dict[str, Any] = {"charts": charts, "count": wording.count}
    environment.globals.update(shared)
    environment.filters["leg"] = _colour_class
    return environment


def _colour_class(leg: int | None) -> str:
    """The style sheet's name of a leg's colour; legs from 1, none for a chart without legs."""
    return f"leg-{(leg - 1) % N_COLOURS + 1}" if leg else "no-leg"
