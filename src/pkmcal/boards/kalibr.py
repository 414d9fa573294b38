"""Kalibr's ``target.yaml`` as a board file: checkerboard, aprilgrid and circlegrid.

Kalibr's aprilgrid has tags with a border of two bits. Seen upright as OpenCV has its AprilTags,
the first tag is at the upper right, and ids go on to the left, row by row downward.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from pkmcal.errors import InputError
from pkmcal.files import Document, closest
from pkmcal.wording import listed


def is_kalibr_target(document: Document) -> bool:
    """Whether a document is a target file of Kalibr."""
    return "target_type" in document.data


def board_fields(document: Document) -> dict[str, Any]:
    """Fields of a board file for a target; raises InputError."""
    kind = str(document.data["target_type"])
    if kind not in _TARGETS:
        raise InputError(
            "no such type of target",
            where=document.where("target_type"),
            found=kind,
            expected=closest(kind, _TARGETS) or listed(list(_TARGETS)),
        )
    keys, fields = _TARGETS[kind]
    for key in keys:
        value = document.data.get(key)
        if not isinstance(value, int | float) or (isinstance(value, bool) != (key == _ASYMMETRIC)):
            raise InputError(
                "a field is missing or has no number"
                if key != _ASYMMETRIC
                else "a field is missing or is neither true nor false",
                where=document.where(key),
                found="nothing" if value is None else str(value),
                expected=f"a value of {key}, as Kalibr has it",
                next_step=f"Write {key} into the target file",
            )
    sides = [document.data[key] for key in keys if key in ("rowSpacingMeters", "colSpacingMeters")]
    if len(set(sides)) > 1:
        raise InputError(
            "the board's squares are not square",
            where=document.where("rowSpacingMeters"),
            found=f"{sides[0]:g} m beside colSpacingMeters {sides[1]:g} m",
            expected="one length for both",
            next_step="Measure a square along both sides, or print a board with square ones",
        )
    return fields(document.data)


_ASYMMETRIC = "asymmetricGrid"


def _checkerboard(data: Mapping[str, Any]) -> dict[str, Any]:
    counts = [data["targetCols"], data["targetRows"]]
    return {"type": "chessboard", "corners": counts, "square": data["rowSpacingMeters"]}


def _aprilgrid(data: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "type": "aruco_grid",
        "markers": [data["tagCols"], data["tagRows"]],
        "marker": data["tagSize"],
        "gap": data["tagSize"] * data["tagSpacing"],
        "dictionary": "DICT_APRILTAG_36h11",
        "border": 2,
        "leftward": True,
    }


def _circlegrid(data: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "type": "circle_grid",
        "circles": [data["targetCols"], data["targetRows"]],
        "spacing": data["spacingMeters"],
        "asymmetric": data[_ASYMMETRIC],
    }


_TARGETS: dict[str, tuple[tuple[str, ...], Callable[[Mapping[str, Any]], dict[str, Any]]]] = {
    "checkerboard": (
        ("targetCols", "targetRows", "rowSpacingMeters", "colSpacingMeters"), _checkerboard,
    ),
    "aprilgrid": (("tagCols", "tagRows", "tagSize", "tagSpacing"), _aprilgrid),
    "circlegrid": (("targetCols", "targetRows", "spacingMeters", _ASYMMETRIC), _circlegrid),
}  # fmt: skip
"""Fields of each type of target, and the board's fields made of them."""
