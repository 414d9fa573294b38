"""Blocks of a section of a page: what the viewer draws, as plain data.

A new kind of block is a file here with its class, an entry of ``Block``, and a file of the same
name in ``viewer/src/blocks``, which draws it.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from pkmcal.outcome.blocks.images import Images
from pkmcal.outcome.blocks.log_bar import LogBar
from pkmcal.outcome.blocks.plot import Panels, Plot
from pkmcal.outcome.blocks.space import Space
from pkmcal.outcome.blocks.table import DataTable
from pkmcal.outcome.blocks.text import Downloads, Facts, Hint, Listing, Paragraph
from pkmcal.outcome.blocks.tool_map import ToolMapBlock

Block = Annotated[
    Paragraph
    | Hint
    | Listing
    | Facts
    | Downloads
    | DataTable
    | LogBar
    | Plot
    | Panels
    | Images
    | Space
    | ToolMapBlock,
    Field(discriminator="kind"),
]
"""Block of a section."""
