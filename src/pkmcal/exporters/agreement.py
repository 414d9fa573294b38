"""Comparison of an exported multibody model, read again, with its machine."""

from __future__ import annotations

import numpy as np

from pkmcal.arrays import Array
from pkmcal.exporters.contract import Difference, largest
from pkmcal.exporters.read_model import ReadModel
from pkmcal.exporters.samples import samples
from pkmcal.geometry.rigid import pose_difference
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.closure import limb_ends

AGREEMENT_POSES = 8
MODEL_GEOMETRY_ROUNDING = 1e-12
MODEL_POSE_ROUNDING = 1e-9
"""Tolerance of poses, m and rad: rounding of 1e-14 in a length, amplified near singular poses."""


def differences(model: ReadModel, machine: Machine) -> list[Difference]:
    """Differences of joint centres at home, loop closure, radii, and platform poses by readings."""
    # platform of the model, closed at the machine's readings; NaN where its loops do not close
    poses, readings = samples(machine, AGREEMENT_POSES)
    x = model.at(readings, poses)
    away: Array = pose_difference(model.places(x)["platform"], poses)
    away[np.abs(model.gaps(x)).max(axis=1) > MODEL_GEOMETRY_ROUNDING] = np.nan
    turned, shifted, n = largest(away[:, :3]), largest(away[:, 3:]), len(poses)
    tube_radii = {
        f"leg{j + 1}_tube{t + 1}": float(radius)
        for j, radii in enumerate(machine.radii())
        for t, radius in enumerate(radii)
    }
    radii_read = [model.radii.get(name, np.nan) for name in tube_radii]
    loops = largest(model.gaps(model.key))
    return [
        *_centres(model, machine),
        Difference("loops at home", loops, MODEL_GEOMETRY_ROUNDING),
        Difference(
            "tubes' radii",
            largest(radii_read, list(tube_radii.values())),
            MODEL_GEOMETRY_ROUNDING,
        ),
        Difference(f"platform's place at {n} poses", shifted, MODEL_POSE_ROUNDING),
        Difference(f"platform's turn at {n} poses", turned, MODEL_POSE_ROUNDING, "rad"),
    ]


def _centres(model: ReadModel, machine: Machine) -> list[Difference]:
    """Differences of joint centres and readings at the pose of the model's keyframe."""
    T = model.places(model.key)["platform"]
    fk = machine.forward_result(model.ctrl, T)
    ends = limb_ends(machine.layout, machine.values, model.ctrl, T, fk.internal)
    places = model.site_places(model.key)
    what_is = {"base": "joint centres on the base", "platform": "joint centres on the platform"}
    what_is["tip"] = "ends of the rods"
    out: list[Difference] = []
    for site, what in what_is.items():
        read_again = np.array([places[f"leg{j + 1}_{site}"] for j in range(machine.n_legs)])
        gap = largest(read_again, ends.a if site == "base" else ends.b)
        out.append(Difference(f"{what} at home", gap, MODEL_GEOMETRY_ROUNDING))
    readings = largest(model.gear * model.key[model.actuated], model.ctrl)
    return [*out, Difference("readings at home", readings, MODEL_GEOMETRY_ROUNDING)]
