"""Checks of a mechanism file beyond its schema: whether the legs allow the stated motion.

Checks that concern one kind of joint are in its carrier's ``check``.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from statistics import median
from typing import TypeAlias

import numpy as np

from pkmcal.errors import InputError
from pkmcal.files.documents import field_path
from pkmcal.levels import ROUNDING
from pkmcal.mechanisms.carriers.contract import (
    IN_PLANE,
    PLANAR_MOTIONS,
    Site,
    Winding,
    base_carriers,
    platform_carriers,
)
from pkmcal.mechanisms.document import (
    MOTION_DIRECTIONS,
    ConstantLength,
    Leg,
    MechanismDocument,
    PassiveLength,
)
from pkmcal.mechanisms.joints import equations, joint_offsets, screws
from pkmcal.mechanisms.motors import bodies, motor_columns, sharing
from pkmcal.wording import listed

PlaceInDocument: TypeAlias = Callable[..., str]


def check_nominal(document: MechanismDocument, where: PlaceInDocument | None = None) -> None:
    """Raise InputError for a nominal model whose joints and rods do not allow its motion.

    where : function that returns a field's location in the file from its keys.
    """
    place = where or (lambda *keys: field_path(keys))
    for j, leg in enumerate(document.legs):
        base, platform = base_carriers()[leg.base.joint], platform_carriers()[leg.platform.joint]
        for side, carrier in (("base", base), ("platform", platform)):
            site = Site(j + 1, side, document.motion, partial(place, "legs", j, side))
            carrier.check(getattr(leg, side), site)
        if document.motion in PLANAR_MOTIONS:
            _check_plane(document, j, leg, place)
        if document.motion in ("translation", "planar-translation"):
            _check_parallel(j, leg, place)
        _check_screw(document, j, leg, place)
        _check_offsets(document, j, leg, place)
        if base.driven and not isinstance(leg.length, ConstantLength):
            raise InputError(
                f"leg {j + 1} is moved by its {leg.base.joint}, so its rod has one length",
                where=place("legs", j, "length"),
                expected="length: {actuated: false, constant: the rod's length in metres}",
            )
    if document.steps_per_mm is not None and len(document.steps_per_mm) != len(document.legs):
        raise InputError(
            "there is not one number of motor steps for each leg",
            where=place("steps_per_mm"),
            found=f"{len(document.steps_per_mm)} numbers",
            expected=f"{len(document.legs)}, in the order of the legs",
        )
    _check_motors(document, place)
    _check_scales(document, place)
    _check_load(document, place)
    for side, legs, fields in sharing(document):
        for field in fields:
            _check_equal(document, side, legs, field, place)


def _check_screw(document: MechanismDocument, j: int, leg: Leg, place: PlaceInDocument) -> None:
    """Check that a screw which its joints turn has two axes on a machine that rotates."""
    if j not in screws(document):
        return
    roles = (
        base_carriers()[leg.base.joint].axis_role(leg.base),
        platform_carriers()[leg.platform.joint].axis_role(leg.platform),
    )
    if document.motion != "spatial" or roles != ("twist", "twist"):
        raise InputError(
            f"leg {j + 1} has a screw's lead, but no two joints that turn the screw",
            where=place("legs", j, "length", "lead"),
            found=f"{leg.base.joint} and {leg.platform.joint}, motion: {document.motion}",
            expected="motion: spatial, and joint: universal with axis: [x, y, z] at both ends",
            next_step="Give both joints' axes, or leave out lead",
        )


def _check_offsets(document: MechanismDocument, j: int, leg: Leg, place: PlaceInDocument) -> None:
    """Check that a leg with joints whose axes do not meet is a rod between fixed joints of a
    spatial machine.
    """
    if j not in joint_offsets(document):
        return
    base = base_carriers()[leg.base.joint]
    if document.motion != "spatial" or base.driven or issubclass(base, Winding):
        raise InputError(
            f"leg {j + 1} has a joint whose axes do not meet, which only rods between fixed joints"
            " of spatial machines can have",
            where=place("legs", j),
            found=f"base: {leg.base.joint}, motion: {document.motion}",
            expected="motion: spatial, and a base joint that no motor moves",
        )


def _check_plane(document: MechanismDocument, j: int, leg: Leg, place: PlaceInDocument) -> None:
    """Check that a leg of a planar machine is in a plane z = const."""
    if document.home and np.hypot(*document.home.rotation_vector[:2]) > IN_PLANE:
        raise InputError(
            "the home pose of a planar machine is turned out of its plane",
            where=place("home", "rotation_vector"),
            expected="[0, 0, angle]",
        )
    # Height of the platform frame above the base frame: of the home pose, or the legs' median.
    rise = median(leg.base.center[2] - leg.platform.center[2] for leg in document.legs)
    if document.home is not None:
        rise = document.home.position[2]
    gap = leg.platform.center[2] + rise - leg.base.center[2]
    if abs(gap) > IN_PLANE:
        raise InputError(
            f"leg {j + 1} of a planar machine leaves its plane",
            where=place("legs", j, "platform", "center"),
            found=f"its platform joint {gap * 1e3:+.4g} mm above its base joint",
            expected="the same height (z) for both ends of a leg, at the home pose",
            next_step="Draw the leg in its plane, or write motion: spatial",
        )


def _check_parallel(j: int, leg: Leg, place: PlaceInDocument) -> None:
    """Check that a leg's two universal joints have parallel axes, without which the platform would
    rotate.
    """
    roles = (
        base_carriers()[leg.base.joint].axis_role(leg.base),
        platform_carriers()[leg.platform.joint].axis_role(leg.platform),
    )
    if roles != ("twist", "twist"):
        return
    if np.linalg.norm(np.cross(leg.base.axis, leg.platform.axis)) > IN_PLANE:
        raise InputError(
            f"the {leg.base.joint} joints of leg {j + 1} have axes that are not parallel, so they "
            "would turn the platform",
            where=place("legs", j, "platform", "axis"),
            expected="the axis of its base joint",
            next_step="Write motion: spatial, and the turn will be computed",
        )


def _check_motors(document: MechanismDocument, place: PlaceInDocument) -> None:
    """Check that motors are numbered without gaps."""
    used = {int(c) + 1 for c in motor_columns(document) if c >= 0}
    missing = sorted(set(range(1, max(used, default=0) + 1)) - used)
    if missing:
        raise InputError(
            f"motor{'s' if len(missing) > 1 else ''} {listed([str(m) for m in missing])} "
            "of the readings moves no leg",
            where=place("legs"),
            expected="motors numbered from 1 in the order of the readings' columns",
        )


def _check_scales(document: MechanismDocument, place: PlaceInDocument) -> None:
    """Check that only legs with a reading have a scale, and legs on one motor the same."""
    columns = motor_columns(document)
    for j, leg in enumerate(document.legs):
        first = document.legs[int(np.argmax(columns == columns[j]))]
        if columns[j] < 0 and leg.scale != 1:
            raise InputError(
                f"leg {j + 1} has no reading, but a scale of one",
                where=place("legs", j, "scale"),
                found=str(leg.scale),
                expected="scale on legs whose length, crank or slider a motor moves",
            )
        if columns[j] >= 0 and abs(leg.scale - first.scale) > ROUNDING:
            raise InputError(
                f"leg {j + 1} has another scale than the other legs on its motor",
                where=place("legs", j, "scale"),
                found=str(leg.scale),
                expected=str(first.scale),
            )


def _check_load(document: MechanismDocument, place: PlaceInDocument) -> None:
    """Check that a load's forces on the drives follow from statics, and that all drives have a
    stiffness or none, and all their legs an axial rigidity or none.
    """
    columns, legs = motor_columns(document), document.legs
    for key in ("stiffness", "axial_rigidity"):
        stated = any(getattr(leg, key) is not None for leg in legs)
        for j, leg in enumerate(legs):
            value, first = getattr(leg, key), legs[int(np.argmax(columns == columns[j]))]
            right = (value is not None) == (stated and columns[j] >= 0)
            if not right or (columns[j] >= 0 and value != getattr(first, key)):
                raise InputError(
                    f"the {key} of leg {j + 1} does not suit its drive",
                    where=place("legs", j, key),
                    found=str(value),
                    expected=f"{key} for each leg that a motor moves, equal for legs on one motor,"
                    " or for none",
                )
    if document.load is not None and n_equations(document) > n_freedoms(document):
        raise InputError(
            "a load's forces on more legs than the platform has freedoms do not follow from"
            " statics",
            where=place("load"),
            found=f"{n_equations(document)} equations for {n_freedoms(document)} freedoms",
            expected="as many equations as freedoms",
            next_step="Leave out load",
        )


def n_equations(document: MechanismDocument) -> int:
    """Number of closure equations: lengths of all but passive legs, and axes' equations."""
    passive = sum(isinstance(leg.length, PassiveLength) for leg in document.legs)
    return len(document.legs) - passive + len(equations(document))


def n_freedoms(document: MechanismDocument) -> int:
    """Number of freedoms of the platform and its hinges."""
    joints = [leg.platform.joint for leg in document.legs]
    turning = [j for j, joint in enumerate(joints) if platform_carriers()[joint].turns]
    hinges = len(set(bodies(document)[turning].tolist()))
    return MOTION_DIRECTIONS[document.motion].shape[1] + hinges


def _check_equal(
    document: MechanismDocument,
    side: str,
    legs: tuple[int, ...],
    field: str,
    place: PlaceInDocument,
) -> None:
    """Check that legs on one motor, or on one body of the platform, share an axis or hinge."""
    nodes = [getattr(document.legs[j], side) for j in legs]
    values = [getattr(node, field) for node in nodes]
    for j, value in zip(legs[1:], values[1:], strict=True):
        if (value is None) != (values[0] is None) or (
            value is not None and np.abs(np.subtract(value, values[0])).max() > ROUNDING
        ):
            body = platform_carriers()[document.legs[j].platform.joint].body
            raise InputError(
                f"legs {legs[0] + 1} and {j + 1} are on one "
                f"{'motor' if side == 'base' else body}, but differ in {field}",
                where=place("legs", j, side, field),
                found=str(value),
                expected=str(values[0]),
            )


def check_held(document: MechanismDocument, place: PlaceInDocument) -> None:
    """Raise InputError if there are fewer closure equations than freedoms of the platform and its
    hinges.
    """
    passive = [
        j + 1 for j, leg in enumerate(document.legs) if isinstance(leg.length, PassiveLength)
    ]
    count, freedoms = n_equations(document), n_freedoms(document)
    if count >= freedoms:
        return
    why = ""
    if passive:
        one = len(passive) == 1
        why = f"; passive {'leg' if one else 'legs'} {listed([str(j) for j in passive])} hold"
        why += "s nothing" if one else " nothing"
    joints = dict.fromkeys(leg.platform.joint for leg in document.legs)
    kinds = [f"{x.replace('-', ' ')}s" for x in joints if platform_carriers()[x].turns]
    raise InputError(
        "the legs do not hold the platform",
        where=place("legs"),
        found=f"{count} equations for {freedoms} freedoms{why}",
        expected="one equation a leg with a length, one a revolute joint, one a pair of universal "
        f"joints with axes; {freedoms} for motion: {document.motion}"
        f"{f' and its {listed(kinds)}' if kinds else ''}",
        next_step="Add legs or axes, or correct motion. Only a session in which a tracker measured"
        " every pose of the platform does without",
        code="mechanism.not_held",
    )
