"""Nominal models of Klipper's rotary deltas and winches.

Semantics: Klipper's klippy/kinematics/rotary_delta.py, winch.py and deltesian.py. A rotary delta's
arm turns about a horizontal axis at ``shoulder_radius`` and ``shoulder_height``, in the direction
``angle``; its position is the arm's angle above the horizontal. A winch's cable leads from its
anchor to the nozzle; its position is the cable's length, and home is the origin.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from configparser import ConfigParser
from itertools import takewhile
from pathlib import Path
from string import ascii_lowercase
from typing import ClassVar, final

import numpy as np

from pkmcal.errors import InputError, legible
from pkmcal.files import quoted
from pkmcal.firmware.cables import ANCHOR_SIGMA, anchors_from_origin, check_millimetres
from pkmcal.firmware.klipper import ROTARY_ANGLES, Klipper, homed, klipper_arm_angles
from pkmcal.firmware.klipper_config import KlipperConfig, read_config
from pkmcal.firmware.klipper_probing import KLIPPER_STEPPERS
from pkmcal.starter.nominal import NominalLeg, NominalModel
from pkmcal.starter.sources import StarterSource

ARM_MARGIN_BELOW = 5.0
"""Margin below the arms' lowest positions above the bed, degrees."""
STEEPEST_ARM = 90.0
UP = np.array([0.0, 0.0, 1.0])
OTHER_KINEMATICS: Mapping[str, str] = {
    "delta": "a linear delta is read with --printer FILE",
    "deltesian": "a deltesian moves along y on a stage of its own, which is no limb between a base"
    " and a platform, so pkmcal has no nominal model of it",
}
"""What there is for kinematics that are read elsewhere, or not at all."""


@final
class KlipperMachine(StarterSource):
    """printer.cfg of a rotary delta or a winch, and the files that it includes."""

    title: ClassVar = "Klipper's configuration"
    recognised: ClassVar = (
        "Klipper's section [printer] with kinematics: rotary_delta or kinematics: winch"
    )

    def claims(self, text: str, path: Path) -> bool:
        """Whether a file shows that it is a configuration of Klipper."""
        return bool(Klipper().evidence(text, path.name))

    def read(
        self, text: str, path: Path, unit: str | None, given: Mapping[str, float]
    ) -> NominalModel:
        """Nominal model. Raises InputError for other kinematics, and for missing or impossible
        values.
        """
        del unit, given
        config = read_config(text, path)
        name, where = config.entries.get("printer", {}).get("kinematics", ("", ""))
        if name not in _MODELS:
            raise InputError(
                OTHER_KINEMATICS.get(name, "these kinematics are not those of a parallel machine"),
                where=where or f"{config.label}, [printer]",
                found=quoted(name),
                expected=" or ".join(f"kinematics: {one}" for one in _MODELS),
            )
        return _MODELS[name](config)


def _rotary_delta(config: KlipperConfig) -> NominalModel:
    """Rotary delta, in Klipper's frame."""
    names = ("upper_arm_length", "lower_arm_length")
    arm, rod = (config.by_stepper(KLIPPER_STEPPERS, name, positive=True) for name in names)
    ends = config.by_stepper(KLIPPER_STEPPERS, "position_endstop", positive=False)
    angle = [
        config.number(f"stepper_{s}", "angle", default)
        for s, default in zip(KLIPPER_STEPPERS, ROTARY_ANGLES, strict=True)
    ]
    radius = config.positive("printer", "shoulder_radius")
    height = config.positive("printer", "shoulder_height")
    check_millimetres(max(radius, height, *arm, *rod), f"{config.label}, [printer]")
    # the export's formulas read a ConfigParser; values are text there
    parser = ConfigParser()
    printer = {"shoulder_radius": repr(radius), "shoulder_height": repr(height)}
    parser.read_dict({"printer": {"kinematics": "rotary_delta", **printer}})
    for k, s in enumerate(KLIPPER_STEPPERS):
        values = {**dict(zip(names, (arm[k], rod[k]), strict=True)), "angle": angle[k]}
        values["position_endstop"] = ends[k]
        parser.read_dict({f"stepper_{s}": {name: repr(value) for name, value in values.items()}})
    # the workspace: a disc on the bed, as far out as Klipper goes
    low = config.number("printer", "minimum_z_position", 0.0)
    reach = min(radius + min(arm), min(rod) - radius)
    turn = np.linspace(0, 2 * np.pi, 36, endpoint=False)
    disc = np.column_stack([np.cos(turn), np.sin(turn), 0 * turn])
    top = min(ends)
    with np.errstate(all="ignore"):
        highest = homed(parser)
        angles = klipper_arm_angles(parser, reach * disc + low * UP)
    lowest = np.min(angles, axis=0, where=np.isfinite(angles), initial=np.inf)
    if not (reach > 0 and low < top and np.isfinite([highest, lowest]).all()):
        raise InputError(
            "the arms of this rotary delta do not reach its bed, or its end switches",
            where=f"{config.label}, [printer]",
            found=f"shoulders {radius:g} mm out and {height:g} mm high, arms of {min(arm):g} mm,"
            f" rods of {min(rod):g} mm, position_endstop {top:g} mm",
            expected="values in mm, as Klipper takes them",
        )
    lowest = np.maximum(lowest - ARM_MARGIN_BELOW, -STEEPEST_ARM)
    legs = []
    for k, degrees in enumerate(angle):
        out = np.array([np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees)), 0.0])
        center = 1e-3 * (radius * out + height * UP)
        legs.append(
            NominalLeg.crank(
                center, np.cross(out, UP), out, 1e-3 * arm[k], np.zeros(3), 1e-3 * rod[k],
                (lowest[k], highest[k]),
            )
        )  # fmt: skip
    return NominalModel(
        "klipper-rotary-delta",
        (
            f"A rotary delta by the values in {legible(config.label)}, in Klipper's frame. A"
            " firmware has only the difference of the shoulders' radius and the tool's, so the"
            " rods' lower ends stand in the platform's origin, the nozzle.",
            "Leg 1 is stepper_a. Arms are level at 0 and rise with their readings; ranges end"
            " at the end switches.",
            *config.remarks(),
        ),
        (),
        "translation",
        tuple(legs),
        1e-3 * UP * (low + top) / 2,
    )


def _winch(config: KlipperConfig) -> NominalModel:
    """Cables from anchors to one point."""
    names = [f"stepper_{letter}" for letter in ascii_lowercase]
    # Klipper has three winches, and others as far as there are sections
    more = takewhile(lambda name: name in config.entries, names[3:])
    anchors = np.array([
        [config.number(name, f"anchor_{c}") for c in "xyz"] for name in (*names[:3], *more)
    ])  # fmt: skip
    places = [f"{config.label}, [{name}]" for name in names]
    return NominalModel(
        "klipper-winch",
        (
            f"A winch by the values in {legible(config.label)}: {len(anchors)} cables from"
            " anchors to one point, the nozzle, each taken as straight. A reading is the"
            " cable's length from the anchor's point to the nozzle.",
            "Leg 1 is stepper_a. Home is Klipper's: the origin.",
            *config.remarks(),
        ),
        (),
        "translation",
        tuple(
            NominalLeg.telescope(one, np.zeros(3), None)
            for one in anchors_from_origin(anchors, places)
        ),
        np.zeros(3),
        sigma=ANCHOR_SIGMA,
    )


_MODELS: Mapping[str, Callable[[KlipperConfig], NominalModel]] = {
    "rotary_delta": _rotary_delta,
    "winch": _winch,
}
