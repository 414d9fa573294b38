"""Visible cylinders for machines whose drawing has none, as those known from boards alone."""

from __future__ import annotations

import numpy as np

from pkmcal.mechanisms import Machine, machine_from_document
from pkmcal.mechanisms.closure import limb_ends
from pkmcal.mechanisms.document import Tube

RADIUS = 0.02
"""Of a rod, in its length: 10 mm for half a metre, as carbon tubes of such machines have."""
MARGIN = 0.07
"""Share of the rod's length at either end that fork and joint hide."""


def with_forearms(machine: Machine) -> Machine:
    """The machine with one cylinder a rod where its drawing gives no leg any; else unchanged.

    A forearm is two rods where it is a parallelogram; here it is the one that stands for them.
    """
    document = machine.document
    if any(leg.tubes for leg in document.legs):
        return machine
    home = machine.home()
    readings = machine.inverse(home[None])[0]
    ends = limb_ends(machine.layout, machine.values, readings, home)
    lengths = np.linalg.norm(ends.b - ends.a, axis=1)
    legs = tuple(
        leg.model_copy(update={"tubes": (_tube(float(length)),)})
        for leg, length in zip(document.legs, lengths, strict=True)
    )
    return machine_from_document(document.model_copy(update={"legs": legs}))


def _tube(length: float) -> Tube:
    """A rod's, in whole millimetres and half ones of the radius."""
    return Tube.model_validate(
        {
            "radius": max(round(2000 * RADIUS * length) / 2000, 0.001),
            "from": round(MARGIN * length, 3),
            "to": round((1 - MARGIN) * length, 3),
        }
    )
