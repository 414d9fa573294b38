"""HTML page of all commands: an outcome in one file that needs no network."""

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
"""Leg colours in the style sheet; machines with more legs repeat them."""


def page_html(outcome: Outcome, made: datetime | None = None) -> str:
    """Page with verdict, warnings, cards and parts, and the navigation.

    made : time for the head of the page.
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
    """Filled template; all values are escaped, so that the result can be inserted into another."""
    from markupsafe import Markup

    return Markup(environment().get_template(template).render(**views))


@cache
def environment() -> jinja2.Environment:
    """Jinja environment of this package's templates; their bytecode is cached on disk."""
    import jinja2
    from markupsafe import Markup

    class Compiled(jinja2.BytecodeCache):
        """Cache of compiled templates between runs; Jinja checks that the source is the same."""

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
        # control characters in any printed text become visible
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
    """JSON for a page's scripts: without NaN, at which browsers stop and show no plot at all."""
    return json.dumps(_legible_texts(json_value(value)), allow_nan=False, **options)


def _legible_texts(value: Any) -> Any:
    """Value with control characters of all its texts made visible."""
    if isinstance(value, str):
        return legible(value, keep="\n\t")
    if isinstance(value, dict):
        return {legible(key): _legible_texts(item) for key, item in value.items()}
    if isinstance(value, list) and not {float, int}.issuperset(map(type, value)):
        return [_legible_texts(item) for item in value]
    return value


@cache
def plotly_script() -> str:
    """Plotly's script, gzip and base64: a fifth of the size of a page without compression."""
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
    """Style class of a leg's colour; leg : from 1, None for data without a leg."""
    return f"leg-{(leg - 1) % N_COLOURS + 1}" if leg else "no-leg"
