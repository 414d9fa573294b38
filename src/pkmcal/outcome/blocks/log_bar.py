"""Block of a few magnitudes of one quantity on a common logarithmic scale."""

from __future__ import annotations

from typing import Literal

from pkmcal.files import Schema
from pkmcal.outcome.blocks.base import Text


class Magnitude(Schema):
    """Positive magnitude with its text; role decides the colour."""

    label: Text
    value: float
    text: Text
    role: Literal["prior", "nominal", "calibrated", "test"]


class LogBar(Schema):
    """Magnitudes of one quantity, such as the tool's error before and after a calibration.

    unit : of the values. note : small print.
    """

    kind: Literal["log_bar"] = "log_bar"
    title: Text
    unit: Text
    magnitudes: tuple[Magnitude, ...]
    note: Text = ""
