"""A joint at a limb's end as it stands in the file: a centre, and perhaps an axis."""

from __future__ import annotations

from typing import Literal

from pkmcal.files import Schema
from pkmcal.mechanisms.carriers.contract import Direction


class JointDocument(Schema):
    """``{joint: revolute, center: [x, y, z], axis: [x, y, z]}``: metres, the body's frame."""

    joint: Literal["spherical", "universal", "revolute"]
    center: tuple[float, float, float]
    axis: Direction | None = None
