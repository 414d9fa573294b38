"""Cylinders of a nominal model without any: a machine known from boards alone gets one for each
rod.
"""

from __future__ import annotations

import numpy as np

from pkmcal.errors import InputError, PkmcalError
from pkmcal.mechanisms import Machine, machine_from_document
from pkmcal.mechanisms.document import Leg, Tube

ROD_RADIUS = 0.02
"""Radius of a rod relative to its length: 10 mm for half a metre, as the carbon tubes of such
machines."""
ROD_MARGIN = 0.07
"""Share of the rod's length at either end that fork and joint hide."""


def to_simulate(nominal: Machine, where: str) -> Machine:
    """Nominal model with cylinders (:func:`with_forearms`), checked to assemble at home.

    where : source of the nominal model, for the message. Raises InputError.
    """
    try:
        machine = with_forearms(nominal)
        machine.home()
    except PkmcalError as error:
        raise error.as_input(where) from None
    return machine


def with_forearms(machine: Machine) -> Machine:
    """Machine with one cylinder for each rod, if its nominal model has no tubes.

    A machine with any tube is returned unchanged. A forearm that is a parallelogram has two rods;
    here one rod in their middle stands for both. Raises InputError if a limb does not reach the
    platform at home.
    """
    document = machine.document
    if any(leg.tubes for leg in document.legs):
        return machine
    home = machine.home()
    readings = machine.inverse(home[None])[0]
    if not np.isfinite(readings).all():
        joint = int(np.flatnonzero(~np.isfinite(readings))[0]) + 1
        raise InputError(
            f"mechanism {machine.name!r} cannot take its home pose: joint {joint} cannot reach it",
            expected="arms and rods that reach the platform at home",
            next_step="Check the nominal model's lengths and centres, and home",
        )
    ends = machine.ends_at(readings, home)
    lengths = np.linalg.norm(ends.b - ends.a, axis=1)
    legs: list[Leg] = []
    for leg, length in zip(document.legs, lengths.tolist(), strict=True):
        # in millimetres; the radius in half millimetres
        tube = {
            "radius": max(round(2000 * ROD_RADIUS * length) / 2000, 0.001),
            "from": round(ROD_MARGIN * length, 3),
            "to": round((1 - ROD_MARGIN) * length, 3),
        }
        legs.append(leg.model_copy(update={"tubes": (Tube.model_validate(tube),)}))
    return machine_from_document(document.model_copy(update={"legs": tuple(legs)}))
