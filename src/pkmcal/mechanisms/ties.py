"""Parameters that move together, or not at all, by what a machine is, whatever its file says."""

from __future__ import annotations

from collections.abc import Iterator

from pkmcal.mechanisms.carriers.contract import base_carriers, platform_carriers
from pkmcal.mechanisms.motors import motor_columns
from pkmcal.mechanisms.schema import MechanismDocument

Group = tuple[str, ...]


def built_in_ties(document: MechanismDocument) -> tuple[Group, ...]:
    """Entries that change together.

    Legs on one motor turn about one axis and legs on one bar hang on one hinge. A leg of a planar
    machine stays in its plane, so both of its ends have one height.
    """
    return (*_heights(document), *_shared(document))


def built_in_fixed(document: MechanismDocument) -> tuple[str, ...]:
    """Entries that are no unknowns: what leaves a planar machine's plane."""
    if document.motion != "planar":
        return ()
    held = {"crank": "axis", "slider": "axis.z"}
    legs = enumerate(document.legs, start=1)
    return tuple(
        f"legs[{j}].base.{held[leg.base.joint]}" for j, leg in legs if leg.base.joint in held
    )


def sharing(document: MechanismDocument) -> Iterator[tuple[str, tuple[int, ...], tuple[str, ...]]]:
    """Sides with the legs (from 0) that stand on one motor or one bar, and what they share."""
    columns = motor_columns(document)
    for column in range(columns.max(initial=-1) + 1):
        legs = tuple(j for j in range(len(columns)) if columns[j] == column)
        kinds = {base_carriers()[document.legs[j].base.joint] for j in legs}
        if len(legs) > 1 and len(kinds) == 1:
            yield "base", legs, kinds.pop().shared
    nodes = [leg.platform for leg in document.legs]
    for bar in dict.fromkeys(getattr(node, "bar", None) for node in nodes):
        legs = tuple(j for j, node in enumerate(nodes) if getattr(node, "bar", None) == bar)
        if bar is not None and len(legs) > 1:
            yield "platform", legs, platform_carriers()[nodes[legs[0]].joint].shared


def _shared(document: MechanismDocument) -> Iterator[Group]:
    for side, legs, fields in sharing(document):
        for field in fields:
            if all(getattr(getattr(document.legs[j], side), field) is not None for j in legs):
                yield tuple(f"legs[{j + 1}].{side}.{field}" for j in legs)


def _heights(document: MechanismDocument) -> Iterator[Group]:
    if document.motion != "planar":
        return
    for j in range(1, len(document.legs) + 1):
        yield f"legs[{j}].base.center.z", f"legs[{j}].platform.center.z"
