"""Types that the blocks share: texts, points, and keys of what a reader can select."""

from __future__ import annotations

from typing import Annotated

from pydantic import BeforeValidator

from pkmcal.errors import legible

Text = Annotated[str, BeforeValidator(lambda text: legible(text, keep="\n"))]
"""Text of a user's file: control characters are made visible."""
Vector = tuple[float, float, float]
Line = tuple[Vector, ...]
"""Points of a polyline; empty where there is nothing to draw."""
PoseRow = tuple[float, float, float, float]
Pose = tuple[PoseRow, PoseRow, PoseRow, PoseRow]
Key = Text
"""What an element belongs to, for the selection that all blocks of a page share: ``leg:3``,
``station:left``, ``configuration:c07`` or ``image:left/c07``; empty for nothing. Elements with the
same key are highlighted together, and a click on one leads to the image of its key.
"""


def leg_key(leg: int | None) -> Key:
    """Key of a leg, from 1; empty for no leg."""
    return f"leg:{leg}" if leg else ""


def station_key(name: str) -> Key:
    """Key of a station."""
    return f"station:{name}"


def configuration_key(name: str) -> Key:
    """Key of a configuration."""
    return f"configuration:{name}"


def image_key(station: str, configuration: str) -> Key:
    """Key of the image of a configuration at a station."""
    return f"image:{station}/{configuration}"
