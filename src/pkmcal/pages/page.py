"""The one page of all commands: an outcome as HTML that needs no network and no other file."""

from __future__ import annotations

import json
from functools import cache
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

from pkmcal.errors import legible
from pkmcal.files import json_value, remember, remembered
from pkmcal.wording import count

if TYPE_CHECKING:
    from datetime import datetime

    import jinja2
    from markupsafe import Markup

    from pkmcal.outcome import Outcome

N_COLOURS = 8
"""Leg colours in the style sheet; machines with more legs use them again."""


def page_html(outcome: Outcome, made: datetime | None = None) -> str:
    """The page: verdict, what to look at, cards, then the parts, each with its navigation.

    made : when, for its head.
    """
    plots = [plot for part in outcome.parts for plot in part.plots]
    warnings = [finding.text for finding in outcome.findings if finding.level != "note"]
    template = environment().get_template("page.html.j2")
    return template.render(
        o=outcome,
        verdict=outcome.verdict,
        warnings=(*outcome.verdict.warnings, *warnings),
        origin=(
            *((f"{made.day} {made:%B %Y, %H:%M}",) if made else ()),
            f"pkmcal {version('pkmcal')}",
            *outcome.origin,
        ),
        remarks=[finding.text for finding in outcome.findings if finding.level == "note"],
        plots=plots,
        plotly=plotly_script() if plots else "",
    )


def filled_template(template: str, **views: Any) -> Markup:
    """A template filled; every value in it is escaped, so that the whole is safe in another one."""
    from markupsafe import Markup

    return Markup(environment().get_template(template).render(**views))


@cache
def environment() -> jinja2.Environment:
    """Templates of this package, each compiled once a machine."""
    import jinja2
    from markupsafe import Markup

    class Compiled(jinja2.BytecodeCache):
        """Templates' code between runs; Jinja checks that it is the template's."""

        def load_bytecode(self, bucket: jinja2.bccache.Bucket) -> None:
            code = remembered(f"legible-template-{bucket.key}")
            if code is not None:
                bucket.bytecode_from_string(code)

        def dump_bytecode(self, bucket: jinja2.bccache.Bucket) -> None:
            remember(f"legible-template-{bucket.key}", bucket.bytecode_to_string())

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("pkmcal.pages"),
        bytecode_cache=Compiled(),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        finalize=lambda value: (
            legible(value, keep="\n\t")
            if isinstance(value, str) and not isinstance(value, Markup)
            else value
        ),
        trim_blocks=True,
        lstrip_blocks=True,
    )
    shared: dict[str, Any] = {"count": count}
    environment.globals.update(shared)
    environment.filters["leg"] = _colour_class
    environment.policies["json.dumps_function"] = _as_json
    return environment


def _as_json(value: Any, **options: Any) -> str:
    """What a page's scripts read: browsers stop at NaN, and would then draw no plot at all."""
    return json.dumps(_legible_texts(json_value(value)), allow_nan=False, **options)


def _legible_texts(value: Any) -> Any:
    if isinstance(value, str):
        return legible(value, keep="\n\t")
    if isinstance(value, dict):
        return {legible(key): _legible_texts(item) for key, item in value.items()}
    if isinstance(value, list) and not {float, int}.issuperset(map(type, value)):
        return [_legible_texts(item) for item in value]
    return value


@cache
def plotly_script() -> str:
    """Plotly's script, compressed (gzip, base64): a fifth of the page's size without it."""
    import base64
    import gzip
    from importlib import metadata, resources

    name = f"plotly-{metadata.version('plotly')}"
    packed = remembered(name)
    if packed is None:
        source = resources.files("plotly") / "package_data" / "plotly.min.js"
        packed = gzip.compress(source.read_bytes(), 6, mtime=0)
        remember(name, packed)
    return base64.b64encode(packed).decode("ascii")


def _colour_class(leg: int | None) -> str:
    """The style sheet's name of a leg's colour; legs from 1, none for a chart without legs."""
    return f"leg-{(leg - 1) % N_COLOURS + 1}" if leg else "no-leg"
