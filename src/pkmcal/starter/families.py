"""Nominal models of common families of machines from few numbers: radii of the joint circles,
lengths of legs and arms, direction of the arms.

Every family has a rigid platform with joints on one circle, in the plane z = 0 of its frame, and
the base joints on another, in the plane z = 0 of the base frame.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import product
from types import MappingProxyType

import numpy as np

from pkmcal.arrays import Array
from pkmcal.errors import InputError
from pkmcal.files import closest
from pkmcal.ranges import FAMILY_DIMENSIONS
from pkmcal.starter.nominal import NominalLeg, NominalModel, millimetres, option_of
from pkmcal.wording import listed

DIMENSIONS: Mapping[str, tuple[str, str]] = MappingProxyType(
    {
        "platform_radius": (
            "Radius of the circle through the platform joints' centres. Measure the distances of",
            "three joints from each other: of joints 120 degrees apart, they are sqrt(3) radii.",
        ),
        "leg": (
            "Distance between the two joint centres of a leg: of its rod, or at home where legs",
            "change their lengths. Measure between the middles of the balls or crosses.",
        ),
        "arm": (
            "Length of a crank: from the motor's axis to the centre of the joint at the arm's end.",
            "Measure it square to the axis.",
        ),
        "base_spacing": (
            "Distance between the two base joints of a pair, of which there are three, 120 degrees",
            "apart; of servos, between their arms' pivots.",
        ),
        "platform_spacing": (
            "Distance between the two platform joints of a pair, of which there are three, 120",
            "degrees apart, each pair opposite the gap between two pairs of the base.",
        ),
        "arm_angle": (
            "Direction of a level arm, seen from above, from outwards at its pair (0) towards away",
            "from the other arm (90 deg); -90 deg: the arms of a pair point at each other.",
        ),
        "travel": (
            "How far a motor moves, from stop to stop: a leg's length about that at home, a",
            "carriage from the height that the bed needs. Without it the file has no range.",
        ),
        "tube_radius": (
            "Radius of the cylinder of a leg that the camera sees, by calipers: it matters most.",
            "Without it the file has no tubes, and a board on the platform is observed.",
        ),
    }
)
"""What each number is and how it is measured, two lines each; base_radius is that of a family."""
ASSUMED_SPACING_SHARE = 0.2
"""Distance between the joints of a pair, relative to their circle's radius, if it is not given."""
AWAY = np.pi / 2
"""Angle of an arm, if it is not given."""
PAIRED = (0.0, 120.0, 240.0)
ROTARY_DELTA, LINEAR_DELTA = (90.0, 210.0, 330.0), (210.0, 330.0, 90.0)
"""Directions of pairs, arms and towers in the base frame, degrees anticlockwise from x."""

Numbers = Mapping[str, float]


@dataclass(frozen=True)
class Family:
    """Machines of one kind.

    title : what they are. base : what base_radius is, two lines. layout : sentences on legs and
    readings, for the file. needs, takes : names of the numbers that are required, and optional.
    legs : nominal legs of the numbers. height : height of the platform at home, m, of the numbers
    and the horizontal distance of a leg's joints there. Numbers are in m and rad.
    """

    title: str
    base: tuple[str, str]
    layout: str
    motion: str
    needs: tuple[str, ...]
    takes: tuple[str, ...]
    legs: Callable[[Numbers], list[NominalLeg]]
    height: Callable[[Numbers, float], float]


def on_circle(radius: float, degrees: float, across: float = 0.0) -> Array:
    """Point (3,) of a circle about z; across : distance from the direction ``degrees``, along the
    chord and anticlockwise.
    """
    phi = np.deg2rad(degrees) + np.arcsin(across / radius)
    return radius * np.array([np.cos(phi), np.sin(phi), 0.0])


def _tangent(degrees: float) -> Array:
    """Unit vector (3,) of a circle about z, anticlockwise."""
    phi = np.deg2rad(degrees)
    return np.array([-np.sin(phi), np.cos(phi), 0.0])


def _pairs(numbers: Numbers) -> Iterator[tuple[float, int, Array, Array]]:
    """Direction of the pair, side (-1 or 1), base point and platform joint of each of six legs,
    anticlockwise.
    """
    for pair, side in product(PAIRED, (-1, 1)):
        base = on_circle(numbers["base_radius"], pair, side * numbers["base_spacing"] / 2)
        # the platform's pairs are opposite the gaps, so a leg reaches for the nearer joint of one
        platform = on_circle(
            numbers["platform_radius"], pair + 60 * side, -side * numbers["platform_spacing"] / 2
        )
        yield pair, side, base, platform


def _hexapod(numbers: Numbers) -> list[NominalLeg]:
    half = numbers.get("travel", 0.0) / 2
    sweep = (numbers["leg"] - half, numbers["leg"] + half) if half else None
    return [NominalLeg.telescope(base, platform, sweep) for _, _, base, platform in _pairs(numbers)]


def _rotary_hexapod(numbers: Numbers) -> list[NominalLeg]:
    legs = []
    for pair, side, base, platform in _pairs(numbers):
        # mirrored at the plane of the pair, and both rise with their readings
        out = on_circle(1.0, pair + side * np.rad2deg(numbers["arm_angle"]))
        axis = np.cross(out, [0.0, 0.0, 1.0])
        legs.append(NominalLeg.crank(base, axis, out, numbers["arm"], platform, numbers["leg"]))
    return legs


def _delta(numbers: Numbers) -> list[NominalLeg]:
    legs = []
    for arm in ROTARY_DELTA:
        base = on_circle(numbers["base_radius"], arm)
        out = base / numbers["base_radius"]
        platform = on_circle(numbers["platform_radius"], arm)
        # arms turn downwards with their readings
        legs.append(
            NominalLeg.crank(base, _tangent(arm), out, numbers["arm"], platform, numbers["leg"])
        )
    return legs


def _linear_delta(numbers: Numbers) -> list[NominalLeg]:
    sweep = None
    if "travel" in numbers:
        across = numbers["base_radius"] - numbers["platform_radius"]
        low = float(np.sqrt(max(numbers["leg"] ** 2 - across**2, 0.0)))
        sweep = (low, low + numbers["travel"])
    return [
        NominalLeg.slider(
            on_circle(numbers["base_radius"], tower),
            np.array([0.0, 0.0, 1.0]),
            sweep,
            on_circle(numbers["platform_radius"], tower),
            numbers["leg"],
        )
        for tower in LINEAR_DELTA
    ]


def _rise(numbers: Numbers, across: float) -> float:
    """Vertical distance of a leg's joints of the horizontal one."""
    return float(np.sqrt(numbers["leg"] ** 2 - across**2))


def _above_bed(numbers: Numbers, across: float) -> float:
    """Middle of the tool's heights above the bed, which the carriages reach."""
    del across
    return numbers.get("travel", numbers["leg"]) / 2


_SPACINGS = ("base_spacing", "platform_spacing")
FAMILIES: Mapping[str, Family] = MappingProxyType(
    {
        "hexapod": Family(
            "A hexapod (Gough-Stewart platform): six legs of variable length",
            (
                "Radius of the circle through the base joints' centres. Measure the distances of",
                "three joints from each other: 120 degrees apart, they are sqrt(3) radii.",
            ),
            "Legs are numbered anticlockwise, seen from above; legs 1 and 2 start at the pair on x,"
            " leg 1 at its clockwise joint. A reading is the leg's length.",
            "spatial",
            ("base_radius", "platform_radius", "leg"),
            (*_SPACINGS, "travel", "tube_radius"),
            _hexapod,
            _rise,
        ),
        "rotary-hexapod": Family(
            "A rotary hexapod: six servos in mirrored pairs, with arms and rods of constant length",
            (
                "Radius of the circle through the pivots of the arms: where a servo's axis",
                "meets the plane in which the end of its arm moves.",
            ),
            "Legs are numbered anticlockwise, seen from above; legs 1 and 2 start at the pair on x,"
            " leg 1 at its clockwise servo. The servos of a pair are mirrored: its arms, level at"
            " 0, both rise with their readings, so one of two equal servos has the other sign.",
            "spatial",
            ("base_radius", "platform_radius", "arm", "leg"),
            (*_SPACINGS, "arm_angle", "tube_radius"),
            _rotary_hexapod,
            _rise,
        ),
        "delta": Family(
            "A rotary delta: three motors with arms above, rods in pairs, each taken as one rod",
            (
                "Radius of the circle through the pivots of the arms, on the motors' axes.",
                "Measure their distances from each other: sqrt(3) radii.",
            ),
            "Leg 1 is on y, the others follow anticlockwise. Arms point outwards, level at 0, and"
            " fall with their readings.",
            "translation",
            ("base_radius", "platform_radius", "arm", "leg"),
            ("tube_radius",),
            _delta,
            lambda numbers, across: -_rise(numbers, across),
        ),
        "linear-delta": Family(
            "A linear delta: carriages on three towers, rods in pairs, each taken as one rod",
            (
                "Radius of the circle through the carriages' joints, seen from above.",
                "Measure their distances from each other: sqrt(3) radii.",
            ),
            "Towers are at 210, 330 and 90 degrees from x, anticlockwise. A reading is the"
            " carriage's height above the bed.",
            "translation",
            ("base_radius", "platform_radius", "leg"),
            ("travel", "tube_radius"),
            _linear_delta,
            _above_bed,
        ),
    }
)


def family_model(name: str | None, given: Numbers) -> NominalModel:
    """Nominal model of a family's numbers, m and rad.

    Raises InputError for another family, missing numbers, numbers of other families, and numbers
    of which no machine can be made.
    """
    if name not in FAMILIES:
        raise InputError(
            "dimensions are taken for a family of machines",
            where="--machine",
            found=name,
            expected=closest(name or "", FAMILIES) or listed(list(FAMILIES)),
        )
    family = FAMILIES[name]
    if missing := [option_of(number) for number in family.needs if number not in given]:
        raise InputError(
            f"a {name} needs more dimensions",
            where="--machine",
            found=f"no {' and no '.join(missing)}",
            expected=", ".join(f"{option_of(number)} LENGTH" for number in family.needs),
        )
    if extra := [number for number in given if number not in (*family.needs, *family.takes)]:
        raise InputError(
            f"a {name} has no such dimension",
            where=option_of(extra[0]),
            expected=listed([option_of(number) for number in (*family.needs, *family.takes)], 9),
        )
    numbers = dict(given)
    assumed: list[str] = []
    for end in ("base", "platform"):
        if f"{end}_spacing" in family.takes and f"{end}_spacing" not in given:
            numbers[f"{end}_spacing"] = ASSUMED_SPACING_SHARE * given[f"{end}_radius"]
            assumed.append(f"{end}_spacing")
    if "arm_angle" in family.takes and "arm_angle" not in given:
        numbers["arm_angle"] = AWAY
        assumed.append("arm_angle")
    _check_numbers(numbers)
    legs = family.legs(numbers)
    # by symmetry all legs are alike: the first stands for them
    across = float(np.hypot(*(legs[0].platform - legs[0].start)[:2]))
    if across >= numbers["leg"]:
        raise InputError(
            "the legs do not reach the platform at home",
            where="--leg",
            found=f"{millimetres(numbers['leg'])}; the two joints of a leg are"
            f" {millimetres(across)} apart horizontally",
            expected="a longer leg, or circles whose joints are nearer to each other",
        )
    model = NominalModel(
        name,
        (family.title + ".", family.layout),
        tuple(
            (f"{number}: {_written(number, numbers[number])}"
             + ("  (assumed, not given: measure it)" if number in assumed else ""),
             *(family.base if number == "base_radius" else DIMENSIONS[number]))
            for number in FAMILY_DIMENSIONS if number in numbers
        ),
        family.motion,
        tuple(legs),
        np.array([0.0, 0.0, family.height(numbers, across)]),
        numbers.get("tube_radius"),
        tuple(assumed),
    )  # fmt: skip
    model.check_home(
        "--machine",
        "base and platform of different shapes, such as smaller spacings of the pairs",
    )
    return model


def _written(name: str, value: float) -> str:
    """Number with its unit."""
    return f"{np.rad2deg(value):.10g} deg" if name == "arm_angle" else millimetres(value)


def _check_numbers(numbers: Numbers) -> None:
    """Raise InputError for numbers that contradict each other."""
    for end in ("base", "platform"):
        spacing, radius = numbers.get(f"{end}_spacing"), numbers[f"{end}_radius"]
        most = float(np.sqrt(3) * radius)
        if spacing is not None and spacing >= most:
            raise InputError(
                "the joints of two pairs would coincide",
                where=option_of(f"{end}_spacing"),
                found=millimetres(spacing),
                expected=f"less than {millimetres(most)} on a circle of {millimetres(radius)}",
            )
    if numbers.get("tube_radius", 0.0) >= numbers["leg"] / 2:
        raise InputError(
            "the legs are thicker than they are long",
            where="--tube-radius",
            found=millimetres(numbers["tube_radius"]),
            expected=f"less than half of the leg's {millimetres(numbers['leg'])}",
        )
    # of a hexapod; carriages may travel as far as their towers are high
    if "base_spacing" in numbers and numbers.get("travel", 0.0) >= 2 * numbers["leg"]:
        raise InputError(
            "the shortest leg would have no length",
            where="--travel",
            found=millimetres(numbers["travel"]),
            expected=f"less than {millimetres(2 * numbers['leg'])}",
        )
