"""Cylinders of a nominal model without any: a machine known from boards alone gets one for each
rod.
"""

from __future__ import annotations

import numpy as np

from pkmcal.arrays import Array
from pkmcal.errors import InputError, PkmcalError
from pkmcal.mechanisms import Machine, machine_from_document
from pkmcal.mechanisms.document import Leg, Tube
from pkmcal.placement.configurations import leg_distances, touching_legs

ROD_RADIUS = 0.02
"""Radius of a rod relative to its length: 10 mm for half a metre, as the carbon tubes of such
machines."""
MOST_HALVINGS = 6
"""Most times that a rod's radius is halved: to 2 mm for 6 m."""
HOME_CLEARANCE = 2.0
"""Distance between the axes of two rods at home over the sum of their radii, at least, once a rod
is made thinner."""
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

    A machine with any tube is returned unchanged. Rods that would touch another one at home, as
    crossed cables do, are thinner. A forearm that is a parallelogram has two rods;
    here one rod in their middle stands for both. Raises InputError if a limb does not reach the
    platform at home, or if thin rods still touch there.
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
    radii = _radii_apart(machine.name, (ends.a[None], ends.b[None]), lengths)
    legs: list[Leg] = []
    rods = zip(document.legs, lengths.tolist(), radii.tolist(), strict=True)
    for leg, length, radius in rods:
        tube = {
            "radius": radius,
            "from": round(ROD_MARGIN * length, 3),
            "to": round((1 - ROD_MARGIN) * length, 3),
        }
        legs.append(leg.model_copy(update={"tubes": (Tube.model_validate(tube),)}))
    return machine_from_document(document.model_copy(update={"legs": tuple(legs)}))


def _radii_apart(name: str, ends: tuple[Array, Array], lengths: Array) -> Array:
    """Radii (L,), m, of rods that do not touch at home. Raises InputError if thin ones do."""
    # in half millimetres
    radii = np.maximum(np.round(2000 * ROD_RADIUS * lengths) / 2000, 0.001)
    nearest = leg_distances(ends)
    close = touching_legs(ends, nearest, radii)[0]
    for _ in range(MOST_HALVINGS):
        if close.any():
            radii = np.where((close | close.T).any(axis=0), radii / 2, radii)
            # at other poses the rods come nearer than at home
            close = touching_legs(ends, nearest / HOME_CLEARANCE, radii)[0]
    if not close.any():
        return radii
    i, j = np.argwhere(close)[0].tolist()
    raise InputError(
        f"the legs of mechanism {name!r} cross at home, so that cylinders for them would touch",
        found=f"legs {j + 1} and {i + 1}, {1e3 * nearest[0, i, j]:.2g} mm apart, taken"
        f" {2e3 * radii[i]:.2g} mm thick",
        expected="legs that pass each other at home, or tubes with their true radii",
        next_step="Give the legs tubes in the mechanism file, such as"
        " tubes: [{radius: 1 mm, from: 0.1, to: 0.4}]",
        code="mechanism.legs_touch",
    )
