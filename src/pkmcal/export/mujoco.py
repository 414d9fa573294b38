"""MuJoCo: a model (MJCF) with the machine's closed loops, driven by its readings."""

from __future__ import annotations

from typing import ClassVar, final

import numpy as np

from pkmcal.arrays import Array
from pkmcal.export.contract import Difference, Exporter
from pkmcal.export.mujoco_model import mjcf
from pkmcal.export.mujoco_read import (
    ReadModel,
    State,
    body_pose,
    closed,
    constraints,
    platform_dofs,
    read,
    site_places,
    with_platform,
)
from pkmcal.export.samples import samples
from pkmcal.export.source import Source
from pkmcal.geometry.rigid import pose_difference
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.closure import limb_ends
from pkmcal.outcome import Finding, Level

POSES = 8
ROUNDING = 1e-12
FORWARD = 1e-9
"""m, rad: rounding of 1e-14 in a length, told through the poses' nearness to singular ones."""


@final
class MujocoExporter(Exporter):
    """One file, ``<name>.xml``."""

    name: ClassVar = "mujoco"
    title: ClassVar = "MuJoCo model (MJCF) with closed loops"

    def files(self, source: Source) -> dict[str, str]:
        """The model's text."""
        return {f"{_file_name(source.machine.name)}.xml": mjcf(source)}

    def check(self, files: dict[str, str], source: Source) -> list[Difference]:
        """Joint centres in the keyframe, loops there and at other poses, radii."""
        model = read(next(iter(files.values())))
        machine = source.machine
        turned, shifted, n = _forward(model, machine)
        return [
            *_centres(model, machine),
            Difference(
                "loops in the keyframe", _largest(constraints(model, model.key)[0]), ROUNDING
            ),
            Difference("tubes' radii", _radii(model, machine), ROUNDING),
            Difference(f"platform's place at {n} poses", shifted, FORWARD),
            Difference(f"platform's turn at {n} poses", turned, FORWARD, "rad"),
        ]

    def notes(self, files: dict[str, str], source: Source) -> tuple[Finding, ...]:
        """What the model does not know."""
        del files, source
        text = (
            "Masses, inertias, damping and gains in the model are placeholders: it is for "
            "kinematics. Gravity and contacts are off."
        )
        return (Finding(Level.NOTE, text),)


def _file_name(name: str) -> str:
    """A machine's name as a file's."""
    kept = "".join(c if c.isalnum() or c in "-_" else "-" for c in name).strip("-")
    return kept or "machine"


def _centres(model: ReadModel, machine: Machine) -> list[Difference]:
    """Limbs' ends in the keyframe beside the machine's at the keyframe's pose and readings."""
    T = body_pose(model, model.key, "platform")
    found = machine.forward_result(model.ctrl, T)
    ends = limb_ends(machine.layout, machine.values, model.ctrl, T, found.internal)
    places = site_places(model, model.key)
    out: list[Difference] = []
    told = {"base": "joint centres on the base", "platform": "joint centres on the platform"}
    told["tip"] = "ends of the rods"
    for site, what in told.items():
        read_again = np.array([places[f"leg{j + 1}_{site}"] for j in range(machine.n_legs)])
        gap = _largest(read_again - (ends.a if site == "base" else ends.b))
        out.append(Difference(f"{what} in the keyframe", gap, ROUNDING))
    actuated = model.key.x[list(model.actuated)]
    return [*out, Difference("readings in the keyframe", _largest(actuated - model.ctrl), ROUNDING)]


def _forward(model: ReadModel, machine: Machine) -> tuple[float, float, int]:
    """How far the model's platform is from the machine's where both have the same readings."""
    poses, readings = samples(machine, POSES)
    platform, drives = platform_dofs(model), np.zeros(model.n_dofs, dtype=bool)
    drives[list(model.actuated)] = True
    away = np.zeros((len(poses), 6))
    for k, (T, q) in enumerate(zip(poses, readings, strict=True)):
        x = model.key.x.copy()
        x[list(model.actuated)] = q
        near = with_platform(model, State(x, model.key.free), T)
        near = closed(model, near, drives | platform)  # the legs follow, then all are free
        found = closed(model, near, drives)
        away[k] = pose_difference(body_pose(model, found, "platform"), T)
        if _largest(constraints(model, found)[0]) > ROUNDING:
            away[k] = np.nan
    return _largest(away[:, :3]), _largest(away[:, 3:]), len(poses)


def _radii(model: ReadModel, machine: Machine) -> float:
    known = {f"leg{j + 1}_tube{t + 1}": float(r)
             for j, radii in enumerate(machine.radii()) for t, r in enumerate(radii)}  # fmt: skip
    return max((abs(model.radii.get(n, np.nan) - r) for n, r in known.items()), default=0.0)


def _largest(values: Array) -> float:
    return float(np.abs(values).max(initial=0.0))
